"""Report, figures and page of missions among beacons."""
