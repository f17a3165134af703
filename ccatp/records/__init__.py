"""Files of a run: mission database, checkpoint, MCAP recording, log, and summary."""
