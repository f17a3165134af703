"""Pure. Whether a fix of the laser system may be believed, before it moves the pose or counts as a measurement."""
