"""Readers of recorded radio data: Plaza, MRCLAM, Labyrinth, own CSV, ROS bags, signal-strength tables.

``reader.read_run`` chooses the format; every message names the file and, if possible, the line.
"""
