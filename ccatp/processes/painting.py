"""Glue. The newest of everything that a display shows, put together only while somebody looks on."""

from collections.abc import Callable
from typing import Generic, NamedTuple, TypeVar

import msgspec

from ccatp.bus import Publisher
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
