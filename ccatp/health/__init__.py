"""Pure. Monitors of sensors, wheels, fans, link and clock, and the ladder of severities."""
