"""The survey of a mirror: mission states, reactions to verdicts, behaviours, the fix gate, and route planning.

``mission.Mission`` is the entry point; time is an argument.
"""
