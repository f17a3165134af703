"""Pure. The parts of the mission: its states, the journey along stops, the retreat from an edge."""
