"""Pure. Wheel radii, wheel base and gyroscope bias out of a drive between fixes."""
