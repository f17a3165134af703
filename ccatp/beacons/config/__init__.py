"""Configuration of the robots among beacons: models, checks and loading."""
