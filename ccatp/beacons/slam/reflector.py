"""A turn of the reflector: from packets to one level and one bearing for each radio."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import atan2, cos, hypot, pi, sin, tau
from typing import NamedTuple

from ccatp.config.beacon_models import ScanConfig
from ccatp.core import wrap_pi

_APART_RAD = pi / 2.0  # strongest readings further apart than this are two directions, not one


class ScanResult(NamedTuple):
    """Level and bearing of one radio after a turn of the reflector.

    Attributes:
        bearing_rad: left of the heading; None where the scan has none.
    """

    beacon: str
    rssi_dbm: float
    readings: int
    bearing_rad: float | None
    bearing_sigma_rad: float
    heard: float


@dataclass(frozen=True, slots=True)
class ReflectorScan:
    """How scans are taken and read: 40 readings of one turn are steps of 9 degrees (Hevrdejs and Knoll 2017)."""

    cfg: ScanConfig

    @property
    def step_rad(self) -> float:
        """Between two readings."""
        return tau / self.cfg.readings

    @property
    def sigma_rad(self) -> float:
        """Of a bearing: noise, and a direction that may lie anywhere within a step (variance step^2 / 12)."""
        return hypot(self.cfg.bearing_sigma_rad, self.step_rad / 12.0**0.5)

    def results(self, packets: Iterable[tuple[str, float, float]]) -> list[ScanResult]:
        """One result for each radio, in the order of their first packets.

        Args:
            packets: radio, direction of the reflector left of the heading (rad), level (dBm).
        """
        by_beacon: dict[str, list[tuple[float, float]]] = {}
        for beacon, direction_rad, level_dbm in packets:
            by_beacon.setdefault(beacon, []).append((direction_rad, level_dbm))
        return [self._result(beacon, readings) for beacon, readings in by_beacon.items()]

    def _result(self, beacon: str, readings: Sequence[tuple[float, float]]) -> ScanResult:
        heard = len(readings) / self.cfg.readings
        bearing_rad = self._bearing(readings)
        if bearing_rad is None or heard < 1.0 - self.cfg.loss_tolerance:
            levels = [level_dbm for _, level_dbm in readings]
            return ScanResult(beacon, max(levels), 1, None, self.sigma_rad, heard)
        levels = [z for direction, z in readings if abs(wrap_pi(direction - bearing_rad)) <= 1.01 * self.step_rad]
        levels = levels or [max(level_dbm for _, level_dbm in readings)]
        return ScanResult(beacon, sum(levels) / len(levels), len(levels), bearing_rad, self.sigma_rad, heard)

    def _bearing(self, readings: Sequence[tuple[float, float]]) -> float | None:
        """Direction of the strongest reading, 2017 eq. 5; the middle of equals that lie together, else None."""
        strongest_dbm = max(level_dbm for _, level_dbm in readings)
        tied = [direction for direction, level_dbm in readings if level_dbm == strongest_dbm]
        c, s = sum(map(cos, tied)), sum(map(sin, tied))
        if hypot(c, s) < 1e-9 * len(tied):
            return None
        middle_rad = atan2(s, c)
        is_one = all(abs(wrap_pi(direction - middle_rad)) <= _APART_RAD / 2.0 for direction in tied)
        return middle_rad if is_one else None
