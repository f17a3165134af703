"""Pure. A run as general viewers want it: Foxglove's message types, scalars to plot, schemas that they can read."""
