"""Simulated robot and laser system behind their real protocols."""
