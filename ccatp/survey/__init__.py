"""The survey of a mirror: states, reactions to verdicts, behaviours, fix gate, route planning.

See ``mission.Mission``.
"""
