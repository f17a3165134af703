"""The on-board program: the robot's side of the robot link, and low-level control over a hardware interface.

The same core runs on the robot's computer and behind the link of every simulated robot.
"""
