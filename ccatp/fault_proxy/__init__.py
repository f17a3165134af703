"""Edge. A TCP proxy that misbehaves on purpose, for tests and for simulated runs with a fault plan."""
