"""Pure. The parts of the danger loop: edge episodes against the map, the robot's origin, the latch of aborts."""
