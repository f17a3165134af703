"""Campaigns of robots among beacons, recorded runs, and peers."""
