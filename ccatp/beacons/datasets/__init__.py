"""Readers of recorded radio data: Plaza, MRCLAM, Labyrinth, own CSV, signal-strength tables.

``reader.read_recording`` chooses the format; every problem names file and line.
"""
