"""Plausibility of the robot's samples. Safety and estimation share it; docs/architecture.md has the reason."""
