"""Pure. The true world of a robot among radio beacons."""
