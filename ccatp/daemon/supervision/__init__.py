"""A run of processes: process table, children, run directory, locks, collected messages, records."""
