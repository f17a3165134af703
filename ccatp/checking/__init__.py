"""Pure. What is asked before a mission, and what the answers mean."""
