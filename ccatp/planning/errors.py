"""Pure. Typed refusals of the path planner; each message carries its numbers."""


class PlanError(ValueError):
    """Base of every refusal of this room."""


class OutsideMirrorError(PlanError):
    """A path was asked for from or to a place that is not on the mirror, or too near its rim."""


class UnreachableError(PlanError):
    """No sequence of turns and straight legs leads there with the clearances asked for."""
