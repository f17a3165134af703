"""The filter over poses and beacons, on arrays."""
