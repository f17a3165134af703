"""Pure. What passes between the true world and whoever drives in it: commands down, readings up."""

from typing import NamedTuple


class DriveCommand(NamedTuple):
    """Set points until the next step.

    Attributes:
        speed_m_s: forward speed.
        steer_rad: steering angle to the left; of an Ackermann vehicle.
        turn_rate_rad_s: turn rate to the left; of a differential drive.
    """

    speed_m_s: float
    steer_rad: float
    turn_rate_rad_s: float


HALT = DriveCommand(0.0, 0.0, 0.0)


class TruePose(NamedTuple):
    """Pose in the room: x, y, and the heading from the x axis, counter-clockwise, not wrapped."""

    x_m: float
    y_m: float
    heading_rad: float


class WheelReading(NamedTuple):
    """What the odometry tells of one step: mean speed, and steering angle or turn rate."""

    interval_s: float
    speed_m_s: float
    steer_rad: float
    turn_rate_rad_s: float


class Packet(NamedTuple):
    """One answer of a radio: which, where the reflector pointed (left of the heading), how strong."""

    beacon: str
    direction_rad: float
    rssi_dbm: float


class Sighting(NamedTuple):
    """A scan that comes as its result: one signal strength and one bearing, left of the heading."""

    beacon: str
    rssi_dbm: float
    bearing_rad: float


class WorldFrame(NamedTuple):
    """All readings of one step.

    Attributes:
        time_s: at the end of the step, since the start.
        wheels: odometry of the step.
        packets: answers heard at its end while the reflector turned once; empty in steps without a scan.
        sightings: the same of worlds that draw the result of a scan.
        distances_m: of the distance sensors, in the order of the configuration; their range where they see nothing.
    """

    time_s: float
    wheels: WheelReading
    packets: tuple[Packet, ...]
    sightings: tuple[Sighting, ...]
    distances_m: tuple[float, ...]
