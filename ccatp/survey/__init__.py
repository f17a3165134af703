"""The survey of a mirror: one frozen state, pure steps, reactions to verdicts, behaviours, fix gate, route planning.

See ``statechart.Survey``.
"""
