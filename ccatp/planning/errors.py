"""Pure. Typed refusals of the path planner; each message carries its numbers."""

from ccatp.errors import CcatpError, ExitStatus


class PlanError(CcatpError):
    """Base of every refusal of this room."""


class OutsideMirrorError(PlanError):
    """A path was asked for from a place that is not on the mirror."""


class UnreachableError(PlanError):
    """No sequence of turns and straight legs leads there with the clearances of the configuration."""

    exit_status = ExitStatus.USAGE
