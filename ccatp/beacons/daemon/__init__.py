"""The mission among beacons in the main-loop process."""
