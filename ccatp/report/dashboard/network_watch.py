"""The sentence of the laser network for the page, from the points that are measured so far."""

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor

from ccatp.config.models import Config
from ccatp.core import Measured, PointId
from ccatp.mirror.mirror import Mirror

_AGAIN = 1.1  # as many points as the last time, from which the network is adjusted again


class NetworkWatch:
    """Adjusts the network beside the page: it takes up to a second, in which the page must go on."""

    def __init__(self, mirror: Mirror, cfg: Config) -> None:
        self._mirror, self._cfg = mirror, cfg
        self._measured: dict[PointId, Measured] = {}
        self._is_new = False
        self._points = 0  # of the last adjustment
        self._sentence = ""
        self._running: Future[str] | None = None
        self._thread = ThreadPoolExecutor(1, "network")

    def add(self, one: Measured) -> None:
        """Take a fix; that of a point that is measured again replaces the first."""
        self._measured.pop(one.point, None)
        self._measured[one.point] = one
        self._is_new = True

    def sentence(self, *, is_over: bool) -> str:
        """Whether the network is consistent, by the newest adjustment; empty before the first.

        Begins another one if enough points are new, and at the end for all.
        """
        if self._running is not None and self._running.done():
            self._sentence, self._running = self._running.result(), None
        is_due = is_over or len(self._measured) >= _AGAIN * self._points
        if self._running is None and self._is_new and is_due:
            self._points, self._is_new = len(self._measured), False
            self._running = self._thread.submit(_adjusted, self._mirror, self._cfg, [*self._measured.values()])
        return self._sentence


def _adjusted(mirror: Mirror, cfg: Config, measured: Sequence[Measured]) -> str:
    # SciPy takes half a second, in which the page is open already.
    from ccatp.mirror.network_points import calibrate_surveys  # noqa: PLC0415
    from ccatp.report.network import sentence  # noqa: PLC0415

    return sentence(calibrate_surveys(mirror, cfg.etalon, cfg.align, [measured]))
