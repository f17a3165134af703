"""Pure. The simulated world: the truth that stands in for robot, mirror and laser system."""
