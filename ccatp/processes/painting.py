"""Glue. The newest of everything that a display shows, put together only while somebody looks on."""

from collections.abc import Callable
from typing import Generic, NamedTuple, TypeVar

import msgspec

from ccatp.beacon_mission.navigator import Navigator
from ccatp.bus import Publisher
from ccatp.localizer import Localizer
from ccatp.wire.topics import Picture


class Look(NamedTuple):
    """The pose as ``Picture`` tells it."""

    x_m: float
    y_m: float
    heading_rad: float
    covariance_m2: tuple[float, float, float]
    heading_sigma_rad: float
    nis: float
    size: int


Who = TypeVar("Who")


class Painter(Generic[Who]):
    """Publishes ``Picture`` for the main loop.

    Args:
        publisher: main's publisher.
        look: asks whoever knows the pose.
    """

    def __init__(self, publisher: Publisher, look: Callable[[Who], Look]) -> None:
        """Nothing seen yet."""
        self._publisher, self._look = publisher, look
        self._who: Who | None = None
        self._line = b"null"

    def sees(self, who: Who, line: bytes) -> None:
        """A frame was served: who knows the pose, and its line. Called in every frame, so it only notes them."""
        self._who, self._line = who, line

    def tell_if_wanted(self, seq: int, t_s: float) -> None:
        """Publish, if there are subscribers.

        Args:
            seq, t_s: the newest frame.
        """
        if self._who is None or not self._publisher.has_subscriber("picture"):
            return
        look = self._look(self._who)
        self._publisher.send("picture", Picture(seq=seq, t_s=t_s, line=msgspec.Raw(self._line), **look._asdict()))


def look_at_localizer(localizer: Localizer) -> Look:
    """The pose on the deck, and the filter's last update."""
    pose, covariance, innovation = localizer.deck_pose, localizer.pose_covariance, localizer.innovation
    return Look(
        x_m=pose.x_m,
        y_m=pose.y_m,
        heading_rad=pose.heading_rad,
        covariance_m2=(float(covariance[0, 0]), float(covariance[0, 1]), float(covariance[1, 1])),
        heading_sigma_rad=localizer.heading_sigma_rad,
        nis=innovation.nis if innovation is not None else 0.0,
        size=innovation.size if innovation is not None else 0,
    )


def look_at_navigator(navigator: Navigator) -> Look:
    """The pose among beacons; how readings agree is told with the map, as a sum over many of them."""
    belief = navigator.belief
    x_m, y_m, *covariance = belief.ellipse
    xx, xy, yy = covariance
    sigma_rad = float(max(belief.covariance[2, 2], 0.0)) ** 0.5
    return Look(x_m, y_m, belief.pose[2], (xx, xy, yy), sigma_rad, 0.0, 0)
