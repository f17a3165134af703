"""Modes of a mission, its outcomes, and the inputs that arrive between two frames."""

from enum import StrEnum
from types import MappingProxyType
from typing import NamedTuple

from ccatp.control.gate import Purpose
from ccatp.core import Cause, PointId
from ccatp.missions import SEARCHED


class Mode(StrEnum):
    """Mode of a mission. Another kind of mission may have modes of its own, in which it may be held or end."""

    IDLE = "idle"
    TURNING = "turning"
    DRIVING = "driving"
    SETTLING = "settling"
    MEASURING = "measuring"
    BACKING_OFF = "backing off"
    RETURNING = "returning"
    HELD = "held"
    DONE = "done"


IDLE, TURNING, DRIVING, SETTLING, MEASURING, BACKING_OFF, RETURNING, HELD, DONE = Mode
MOVES = "stands for a moment before the move or until the danger loop permits it, then continues by itself"
# What a robot waits for that stands in a mode while nothing is wrong, and what happens then.
WAITS_FOR = MappingProxyType(
    {
        IDLE: "waits for the robot, its laser system and the permit of the danger loop, then starts by itself",
        **dict.fromkeys((TURNING, DRIVING, BACKING_OFF, RETURNING), MOVES),
        SETTLING: "waits until the wheels are at rest, then measures",
        MEASURING: "waits for the lengths of the laser system, then continues with the next point",
        HELD: "continues by itself when the cause of the hold is gone, else with 'ccatp resume'",
        DONE: "the run ends by itself",
    }
)


class SurveyOutcome(StrEnum):
    """Outcome of a mission."""

    NONE = ""
    COMPLETE = "complete"
    AT_BASE = "aborted, at base"
    STOPPED = "stopped"


# The purpose for which the drive gate permits motion in a mode of a survey.
PURPOSES = MappingProxyType(
    {
        IDLE: Purpose.STAND,
        TURNING: Purpose.SURVEY,
        DRIVING: Purpose.SURVEY,
        SETTLING: Purpose.STAND,
        MEASURING: Purpose.STAND,
        BACKING_OFF: Purpose.RETREAT,
        RETURNING: Purpose.HOMEWARD,
        HELD: Purpose.STAND,
        DONE: Purpose.STAND,
    }
)


def waits_for(state: str) -> str:
    """What a robot waits for that stands in a mode of any mission while nothing is wrong; empty: it is not known."""
    if state in WAITS_FOR:
        return WAITS_FOR[Mode(state)]
    return next((kind.waits[state] for kinds in SEARCHED for kind in kinds() if state in kind.waits), "")


class Pause(NamedTuple):
    """Hold until an operator resumes."""

    cause: Cause


class Resume(NamedTuple):
    """Continue after a hold whose cause is gone."""


class Abort(NamedTuple):
    """Return to base and end there."""

    cause: Cause


class StopHere(NamedTuple):
    """Hold the wheels and end here."""


class Interrupted(NamedTuple):
    """The loop or the link has found something: hold, go home or only report it, as its row says."""

    cause: Cause


class Fault(NamedTuple):
    """Something is wrong: hold until an operator resumes."""

    cause: Cause
    loses_pose: bool = False


class EstimateDiverged(NamedTuple):
    """The localizer is frozen until it has a fix. Repeated divergence is a fault."""

    cause: Cause
    t_s: float


class TrackingGap(NamedTuple):
    """The robot may have moved unobserved: it needs a fix and a certain heading before it drives on."""


class EmergencyKnown(NamedTuple):
    """An emergency that the first verdict reports is not new."""


class EmergencyLatched(NamedTuple):
    """An emergency is latched, as the first verdict will say: until it is cleared, ``Resume`` is refused."""

    is_shaking: bool  # an earthquake


class TakenOver(NamedTuple):
    """Continue with the state of an earlier process, before the first frame; the robot relocalizes before it moves.

    ``measured``, in this order, and ``skipped`` are from the mission's database; ``elapsed_s``: mission time so far.
    ``is_new_run``: an operator continues an ended mission; failed points are tried again, and time counts from now.
    """

    measured: tuple[PointId, ...]
    skipped: tuple[PointId, ...] = ()
    elapsed_s: float = 0.0
    is_new_run: bool = False


class FixStored(NamedTuple):
    """The requested measurement is fused and stored. ``point`` is ``None`` for a fix that only relocalizes."""

    point: PointId | None
    heading_sigma_rad: float = 0.0


class PointMissed(NamedTuple):
    """The fix shows the robot too far from its point: approach the point again."""


class FixFailed(NamedTuple):
    """The measurement failed after all retries: the point is skipped. Several failures in a row hold the robot."""

    point: PointId | None
    cause: str
    heading_sigma_rad: float = 0.0


SurveyInput = (
    Pause | Resume | Abort | StopHere | Interrupted | Fault | EstimateDiverged | TrackingGap | EmergencyKnown
    | EmergencyLatched | TakenOver | FixStored | PointMissed | FixFailed
)  # fmt: skip
