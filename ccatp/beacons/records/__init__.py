"""Database and summary of a mission among beacons."""
