"""Pure. Faults of the simulated robot by a timed plan, and the record of what was really injected."""
