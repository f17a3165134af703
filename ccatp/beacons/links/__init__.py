"""Messages of the robots among beacons."""
