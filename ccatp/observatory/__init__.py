"""The agent of the observatory control system."""
