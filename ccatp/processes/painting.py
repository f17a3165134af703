"""Glue. The newest of everything that a display shows, put together only while somebody looks on."""

import msgspec

from ccatp.bus import Publisher
from ccatp.localizer import Localizer
from ccatp.wire.topics import Picture


class Painter:
    """Publishes ``Picture`` for the main loop.

    Args:
        publisher: main's publisher.
    """

    def __init__(self, publisher: Publisher) -> None:
        """Nothing seen yet."""
        self._publisher = publisher
        self._localizer: Localizer | None = None
        self._line = b"null"

    def sees(self, localizer: Localizer, line: bytes) -> None:
        """A frame was served: who knows the pose, and its line. Called in every frame, so it only notes them."""
        self._localizer, self._line = localizer, line

    def tell_if_wanted(self, seq: int, t_s: float) -> None:
        """Publish, if there are subscribers.

        Args:
            seq, t_s: the newest frame.
        """
        localizer = self._localizer
        if localizer is None or not self._publisher.has_subscriber("picture"):
            return
        pose, covariance, innovation = localizer.deck_pose, localizer.pose_covariance, localizer.innovation
        message = Picture(
            seq=seq,
            t_s=t_s,
            x_m=pose.x_m,
            y_m=pose.y_m,
            heading_rad=pose.heading_rad,
            covariance_m2=(float(covariance[0, 0]), float(covariance[0, 1]), float(covariance[1, 1])),
            heading_sigma_rad=localizer.heading_sigma_rad,
            nis=innovation.nis if innovation is not None else 0.0,
            size=innovation.size if innovation is not None else 0,
            line=msgspec.Raw(self._line),
        )
        self._publisher.send("picture", message)
