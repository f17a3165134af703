"""Pure. What a main loop that takes over from another one starts with, and how much of it is a guess."""

from math import hypot
from typing import NamedTuple

from ccatp.samples import DeckPose, PointId

# Of a robot that stood: it may have crept, or been touched.
_STOOD_M, _STOOD_RAD = 0.005, 0.01
# Of one that moved: the record is up to 0.1 s old, the last command lives for 0.25 s, the wheels run down in 0.1 s.
_UNSEEN_S = 0.45
# Within the age of the record it may have begun to move.
_BEGUN_S = 0.1


class Recovery(NamedTuple):
    """Where and how to go on.

    Attributes:
        pose: where the robot was seen last, deck frame.
        position_sigma_m, heading_sigma_rad: how far it may be from there now.
        elapsed_s: time that the mission has taken so far.
        skipped: points that were given up.
        abort_cause: why the robot is on its way home, or empty.
        held_cause: why an operator has to resume it, or empty.
    """

    pose: DeckPose
    position_sigma_m: float
    heading_sigma_rad: float
    elapsed_s: float = 0.0
    skipped: tuple[PointId, ...] = ()
    abort_cause: str = ""
    held_cause: str = ""


def doubted(
    sigmas: tuple[float, float], speeds: tuple[float, float], accelerations: tuple[float, float], *, stood: bool
) -> tuple[float, float]:
    """How well a pose is known of a robot that nobody has watched since.

    Args:
        sigmas: of position (m) and heading (rad) when it was seen last.
        speeds: forward (m/s) and angular (rad/s) then.
        accelerations: the largest, m/s^2 and rad/s^2.
        stood: it stood then and was not to move.

    Returns:
        Standard deviations of position (m) and heading (rad).
    """
    way, turn = (
        0.0 if stood else _UNSEEN_S * (abs(speed) + _BEGUN_S * largest)
        for speed, largest in zip(speeds, accelerations, strict=True)
    )
    return hypot(sigmas[0], way, _STOOD_M), hypot(sigmas[1], turn, _STOOD_RAD)
