"""The simulated world: plant, sensors, faults, and the servers of the simulated robot and laser system.

The ground truth imports no filter, estimator, controller or planner of the code under test.
"""
