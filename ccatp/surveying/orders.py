"""Pure. What the mission wants of a frame."""

import msgspec

from ccatp.samples import PointId, Twist

STILL = Twist(0.0, 0.0)


class Order(msgspec.Struct, frozen=True):
    """What the mission wants of the present frame.

    Attributes:
        twist: the velocity wanted until the next frame.
        at_rest: the robot has come to rest in this frame.
        arrived: the measurement point at which it did so for the first time; corrections are no arrivals.
        measure: have the laser system measure now (of a point, or after a back-off to find itself again).
    """

    twist: Twist
    at_rest: bool = False
    arrived: PointId | None = None
    measure: bool = False


STAND = Order(STILL)
