"""Waypoint tracking of the survey robot: profiles, PID, leg tracker, velocity gate. Pure; time is an argument."""
