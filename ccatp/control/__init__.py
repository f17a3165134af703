"""Waypoint tracking of the survey robot: profiles, PID, the leg tracker, and the velocity gate before the wheels.

All functions are pure; time is an argument. Exports ``LegTracker``, ``DriveGate``, ``CommandPredictor``.
"""
