"""Pure. Positions from what radios tell: ranges, bearings, signal strengths."""
