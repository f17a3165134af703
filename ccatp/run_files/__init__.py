"""What a run leaves behind, telemetry and log, and those who read it."""
