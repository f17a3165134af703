"""The operator's web page of a mission among beacons."""
