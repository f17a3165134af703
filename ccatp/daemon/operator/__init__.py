"""What people and other systems see and use: page, terminal, streams, alarms, observatory."""
