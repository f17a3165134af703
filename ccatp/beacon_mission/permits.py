"""Pure. The last gate of a robot among beacons: nothing is sent that the verdict does not permit."""

from math import isfinite

from ccatp.control.waypoint_steering import HALT, Drive
from ccatp.samples import Verdict


def permitted(drive: Drive, verdict: Verdict, back_speed_m_s: float) -> Drive:
    """What is left of a drive.

    Where forward motion is wanted and denied, the robot backs off straight, if that is permitted: what it stands before
    stays there, and wheels that steer cannot turn on the spot.

    Args:
        drive: wanted.
        verdict: in force.
        back_speed_m_s: of backing off.
    """
    if not all(map(isfinite, drive)):
        return HALT
    if drive.speed_m_s > 0.0 and not verdict.forward:
        return Drive(-back_speed_m_s, 0.0, 0.0) if verdict.reverse else HALT
    if drive.speed_m_s < 0.0 and not verdict.reverse:
        return HALT
    if not verdict.turn:
        return Drive(drive.speed_m_s, 0.0, 0.0)
    return drive
