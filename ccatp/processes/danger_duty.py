"""Glue. What a danger loop has to judge by the configuration of its run: a survey, or a mission among beacons."""

from collections.abc import Callable
from typing import NamedTuple, Protocol

from ccatp.beacon_danger import BeaconDanger
from ccatp.config.models import Config, LinkConfig, ObservatoryConfig
from ccatp.config.radio_models import RadioConfig
from ccatp.danger import DangerMonitor
from ccatp.hazards.abort_latch import AbortLatch
from ccatp.mirror.mirror import build_mirror
from ccatp.processes.observing import Monitor
from ccatp.samples import Verdict
from ccatp.wire.beacon_frame import decode_beacon_frame
from ccatp.wire.robot import BadLine, Sensors
from ccatp.wire.topics import Estimate

Judge = Callable[[Sensors, bytes, Estimate | None], Verdict]


class Guard(Monitor, Protocol):
    """The danger rules of a mission."""

    latch: AbortLatch

    @property
    def counts(self) -> dict[str, object]:
        """For the log, at the end."""

    def reset(self) -> None:
        """The robot has booted."""

    def stale(self, seq: int, t_s: float) -> Verdict:
        """The verdict when no frame came in time."""

    def garbled(self, seq: int, t_s: float, at_s: float) -> Verdict | None:
        """The verdict where a line of the robot was no frame, if that counts."""


class DangerDuty(NamedTuple):
    """What the process hosts.

    Attributes:
        monitor: the rules.
        judge: the verdict on a frame, its line and main's newest estimate.
        link: the robot link.
        observatory: the channel of the observatory.
        realtime_priority: of the process.
        stale_after_s: no permit on frames that are older.
    """

    monitor: Guard
    judge: Judge
    link: LinkConfig
    observatory: ObservatoryConfig
    realtime_priority: int
    stale_after_s: float


def duty_of(cfg: Config | RadioConfig) -> DangerDuty:
    """The rules that go with a configuration."""
    if isinstance(cfg, RadioConfig):
        return _among_beacons(cfg)
    monitor = DangerMonitor(build_mirror(cfg.mirror), cfg.robot, cfg.danger, cfg.health)

    def judge(sensors: Sensors, _raw: bytes, estimate: Estimate | None) -> Verdict:
        return monitor.step(sensors, estimate)

    return DangerDuty(monitor, judge, cfg.robot, cfg.observatory, cfg.run.realtime_priority, cfg.danger.stale_after_s)


def _among_beacons(cfg: RadioConfig) -> DangerDuty:
    monitor = BeaconDanger(cfg)

    def judge(sensors: Sensors, raw: bytes, estimate: Estimate | None) -> Verdict:
        try:
            extras = decode_beacon_frame(raw)
        except BadLine:
            # Without its distances nobody knows what is ahead.
            return monitor.stale(sensors.seq, sensors.t)
        return monitor.step(sensors, extras, estimate)

    return DangerDuty(
        monitor, judge, cfg.robot, cfg.observatory, cfg.processes.realtime_priority, cfg.danger.stale_after_s
    )
