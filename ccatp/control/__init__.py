"""Pure. Waypoint tracking: profiles, PID controllers, kinematics, the last gate before the wheels."""
