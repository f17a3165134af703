"""The command of the robot's computer."""
