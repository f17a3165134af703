"""Pure. Path planning, thesis 3.2: the order of the points, the stops between them, the way home, the time it takes."""
