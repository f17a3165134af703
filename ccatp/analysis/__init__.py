"""Runs as numpy tables, for analysis in Python; ``ccatp`` itself exports its functions."""
