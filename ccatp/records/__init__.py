"""What a run leaves on disk: mission database, checkpoint, MCAP recording, log, and summary."""
