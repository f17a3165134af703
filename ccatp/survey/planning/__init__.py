"""Route planning: the order of the points, drivable legs between them, the way home, and time bounds."""
