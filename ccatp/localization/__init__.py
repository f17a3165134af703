"""Pure. The parts of the localizer: samples taken in, odometry, seam crossings, fixes."""
