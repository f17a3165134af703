"""Pure. Missions among beacons: map and visit waypoints, follow a radio, drive by ultrasonic motes."""
