"""Plausibility of samples, and means of the wheels. Safety and estimation share it; docs/architecture.md says why."""
