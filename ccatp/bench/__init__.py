"""Glue. The project's benchmarks: its own parts against peers that do the same, timed by turns in one run."""
