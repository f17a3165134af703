"""Pure. The thesis's simulation, done again: four panels, its filter, its control, and two readings of what it prints.

* ``noise_is_variance``: eq. 2.17 calls sigma a variance; then a sensor's standard deviation is the root of what table
  2.1 lists. The filter's R follows, as the thesis adjusts it.
* ``period_error``: the filter's time step is 10 ms, the loop takes 1.3 % longer. The true robot moves for longer than
  the filter believes; control and rules keep the true time.

Both are properties of that simulation. A daemon that reads the time stamps of the samples has no period error.
"""

from collections.abc import Sequence
from dataclasses import replace
from math import sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ccatp.assembly import assemble
from ccatp.config.models import Config
from ccatp.danger import DangerMonitor, Estimate, SensorsFrame
from ccatp.filters import FILTERS
from ccatp.localization.four_state import FourStateLocalizer
from ccatp.localization.measurements import STATES
from ccatp.samples import EdgeSample, EventCode, Fix, GravitySample, ImuSample, Verdict, WheelSample
from ccatp.studies.rehearsal import Rehearsal, _Rehearsing

PERIOD_FACTOR = 1.013  # the loop's period over the filter's
FRAME_HZ = 100.0
POINTS = 36
LIMIT_M = 0.010
NOISES = ("normal", "twice")
# Accelerometer m/s^2, gyroscope rad/s, encoder rad/s: thesis table 2.1.
_TABLE = {"normal": (0.0059, 0.0087, 0.001), "twice": (0.0118, 0.0175, 0.002)}
_WORLDS = {"normal": "thesis", "twice": "thesis-x2"}
_SENSORS = ("accelerometer_sigma_m_s2", "gyroscope_sigma_rad_s", "encoder_sigma_rad_s")
# A block of 2 x 2 panels of thesis-m1 with others all round it: no rim within reach of a robot that turns.
_BLOCK = (3, 4)  # its rows and columns, of the parity of the mirror's first ones (table 3.1)
_SIDE = 6
_LAYOUT: dict[str, object] = {
    "run.mirror": "thesis-m1",
    "run.order": "thesis",
    "run.panels": 0,
    "mirror.panels.count": _SIDE * _SIDE,
    "mirror.panels.cols": _SIDE,
    "mirror.panels.panels_per_row": [_SIDE] * _SIDE,
    "mirror.base.row": _BLOCK[0],
    "mirror.base.col": _BLOCK[0],
}


def overrides_of(
    noise: str, *, noise_is_variance: bool, period_error: bool, is_ours: bool = False
) -> dict[str, object]:
    """Dotted configuration keys of one set-up.

    Args:
        noise: a name out of ``NOISES``.
        noise_is_variance: the table lists variances.
        period_error: the loop takes longer than the filter's step.
        is_ours: the daemon's filter and control in the same set-up, all encoder samples included.
    """
    sigmas = [sqrt(value) if noise_is_variance else value for value in _TABLE[noise]]
    keys: dict[str, object] = {**_LAYOUT, "run.world": _WORLDS[noise]}
    for name, sigma in zip(_SENSORS, sigmas, strict=True):
        keys[f"world.{name}"] = keys[f"localizer.{name}"] = sigma
    if is_ours:
        return keys | {"run.filter": "ekf", "control.gains": "shipped"}
    frame_hz = FRAME_HZ / PERIOD_FACTOR if period_error else FRAME_HZ
    return keys | {
        "run.filter": "kf",
        "control.gains": "thesis",
        "mission.max_approaches": 1,  # the thesis corrects no stop
        "sim.robot.frame_hz": frame_hz,
        # Thesis 2.1.4: of each sensor only the sample with the latest time stamp is used, one per frame.
        "sim.robot.imu_hz": frame_hz,
        "sim.robot.encoder_hz": frame_hz,
        "sim.robot.edge_hz": 10.0 * frame_hz,
    }


class FixedStepLocalizer(FourStateLocalizer):
    """The four-state localizer with a clock of its own: a step of ``period_factor`` counts as one."""

    period_factor = PERIOD_FACTOR

    def step(
        self,
        t_s: float,
        imu: Sequence[ImuSample],
        encoders: Sequence[WheelSample],
        edges: Sequence[EdgeSample],
        gravity: GravitySample | None = None,
    ) -> None:
        """Take one sensors frame; see ``FourStateLocalizer.step``."""
        k = 1.0 / self.period_factor
        super().step(
            k * t_s,
            [ImuSample(k * t, ax, wz) for t, ax, wz in imu],
            [WheelSample(k * t, right, left) for t, right, left in encoders],
            [EdgeSample(k * t, *values) for t, *values in edges],
            gravity,
        )

    def fuse_fix(self, fix: Fix) -> float:
        """Fuse a fix; see ``FourStateLocalizer.fuse_fix``."""
        return super().fuse_fix(replace(fix, t_s=fix.t_s / self.period_factor))


class _NoEdges(DangerMonitor):
    """Permits everything: far from the rim an edge that a rule sees is a false one, and would end the run."""

    def step(self, sensors: SensorsFrame, estimate: Estimate | None) -> Verdict:
        """The verdict that all is normal."""
        del estimate
        return Verdict(sensors.seq, sensors.t, EventCode.NORMAL, "", "", 0.0, 0.0, True, True, True)


class _Replica(_Rehearsing):
    """A rehearsal of the block's waypoints that may have the period error."""

    def __init__(self, cfg: Config, period_error: bool) -> None:
        super().__init__(cfg, with_track=True)
        outside = [p for p in self.parts.points if not (p.row in _BLOCK and p.col in _BLOCK)]
        self.parts = parts = assemble(cfg, done=outside)
        self.monitor = _NoEdges(self.mirror, cfg.robot, cfg.danger)
        self.localizer, self.mission, self.gate = parts.localizer, parts.mission, parts.gate
        if period_error:
            n = STATES
            start = self.mirror.base_panel_pose
            filter_ = FILTERS[cfg.run.filter](np.zeros(n), np.eye(n))
            self.localizer = FixedStepLocalizer(filter_, self.mirror, cfg.robot, cfg.localizer, start)


class ReplicaRun(NamedTuple):
    """One run, as the thesis measures it.

    Attributes:
        localization_m: distance of true and estimated position, every frame until the last stop, shape (k,).
        waypoint_m: distance of the robot's stop from its waypoint, shape (36,) if all were reached.
        track: t, true x, y, estimated x, y, every tenth frame, shape (j, 5).
        outcome, cause: how the mission ended.
    """

    localization_m: NDArray[np.float64]
    waypoint_m: NDArray[np.float64]
    track: NDArray[np.float64]
    outcome: str
    cause: str


def run_replica(cfg: Config, *, period_error: bool) -> ReplicaRun:
    """One simulation run.

    Args:
        cfg: with the keys of ``overrides_of``.
        period_error: the filter's step is shorter than the loop's period.

    Raises:
        ValueError: a period error for a filter that reads time stamps.
    """
    if period_error and cfg.run.filter != "kf":
        raise ValueError(f"the filter {cfg.run.filter!r} reads time stamps: only kf can have a period error")
    return _figures(_Replica(cfg, period_error).run())


def _figures(rehearsal: Rehearsal) -> ReplicaRun:
    track = rehearsal.track if rehearsal.track is not None else np.empty((0, 7))
    stops = [stop for stop in rehearsal.stops if stop.approach == 1]
    # The way back to base is not part of the thesis's runs.
    track = track[track[:, 0] <= (stops[-1].t_s if stops else 0.0)]
    error = np.hypot(track[:, 1] - track[:, 4], track[:, 2] - track[:, 5])
    distance = np.array([stop.distance_m for stop in stops])
    return ReplicaRun(error, distance, track[::10, [0, 1, 2, 4, 5]], rehearsal.outcome, rehearsal.cause)
