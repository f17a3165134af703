"""Pure. Typed refusals of the mirror's geometry; each message carries its numbers."""


class MirrorError(ValueError):
    """Base of every refusal of this room."""


class LayoutError(MirrorError):
    """A mirror's configuration contradicts itself."""


class UnknownPanelError(MirrorError):
    """A panel or measurement point that the mirror does not have."""


class ConvergenceError(MirrorError):
    """An iteration on the surface did not converge: the point is far from the mirror or not finite."""


class PanelFitError(MirrorError):
    """The measured points do not determine a panel's piston, tip and tilt."""
