"""Pure. Positions from ranges."""
