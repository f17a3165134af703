"""What the supervisor is made of: children and their restarts, the folder of a run, what is collected and shown."""
