"""Glue. One module per operating-system process; each wires pure rooms to edges and decides nothing itself."""
