"""Plausibility of the robot's samples, and means of the wheels. Safety and estimation share it; docs/architecture.md has the reason."""
