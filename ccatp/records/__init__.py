"""What a run leaves on disk: mission database, checkpoint, MCAP recording, log, and summary.

Readers of run directories return plain values.
"""
