"""What survives ``kill -9``: the databases of missions and their checkpoint."""
