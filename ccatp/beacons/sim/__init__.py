"""The simulated robots, radios, motes and rooms. It imports no estimator."""
