"""Replay of recorded runs: what was recorded goes through a localizer again."""
