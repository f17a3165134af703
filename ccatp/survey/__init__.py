"""The survey of a mirror, see ``statechart.Survey``."""
