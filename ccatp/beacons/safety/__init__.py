"""Rules of the danger loop for robots among beacons."""
