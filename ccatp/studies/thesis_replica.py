"""The thesis's simulation, done again: four panels, its filter, its control, and two readings of what it prints.

* ``noise_is_variance``: eq. 2.17 calls sigma a variance; then a sensor's standard deviation is the root of what table
  2.1 lists. The filter's R follows, as the thesis adjusts it.
* ``period_error``: the filter's time step is 10 ms, the loop takes longer by this part of it. The true robot moves for
  longer than the filter believes; control and rules keep the true time.

Both are properties of that simulation. A daemon that reads the time stamps of the samples has no period error. As in
thesis 2.1.5 the angle at a seam replaces the heading here, however sure the filter is of another.
"""

from collections.abc import Sequence
from dataclasses import replace
from math import sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ccatp.config.models import Config
from ccatp.core import EdgeSample, EventCode, Fix, GravitySample, ImuSample, Verdict, WheelSample
from ccatp.danger import DangerMonitor
from ccatp.estimation.measurements import STATES, THETA
from ccatp.estimation.seams import SensorTransition
from ccatp.estimation.thesis_localizer import FourStateLocalizer
from ccatp.filters import FILTERS
from ccatp.links.robot_messages import Sensors
from ccatp.links.topics import EstimateMessage
from ccatp.studies.sil_models import SilResult
from ccatp.studies.sil_run import SilRun
from ccatp.survey.composition import assemble

FRAME_HZ = 100.0
POINTS, PANELS = 36, 4
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
    "mirror.panels.count": _SIDE * _SIDE,
    "mirror.panels.cols": _SIDE,
    "mirror.panels.panels_per_row": [_SIDE] * _SIDE,
    "mirror.base.row": _BLOCK[0],
    "mirror.base.col": _BLOCK[0],
}


def overrides_of(
    noise: str, *, noise_is_variance: bool, period_error: float, is_ours: bool = False
) -> dict[str, object]:
    """Dotted configuration keys of one set-up.

    Args:
        noise: a name out of ``NOISES``.
        period_error: by which part of the filter's step the loop takes longer.
        is_ours: the daemon's filter and control in the same set-up, all encoder samples included.
    """
    sigmas = [sqrt(value) if noise_is_variance else value for value in _TABLE[noise]]
    keys: dict[str, object] = {**_LAYOUT, "run.world": _WORLDS[noise]}
    for name, sigma in zip(_SENSORS, sigmas, strict=True):
        keys[f"world.{name}"] = keys[f"localizer.{name}"] = sigma
    if is_ours:
        return keys | {"run.filter": "ekf", "control.gains": "shipped"}
    frame_hz = FRAME_HZ / (1.0 + period_error)
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


class ThesisLocalizer(FourStateLocalizer):
    """The four-state localizer, closer to the letter of the thesis.

    Attributes:
        period_factor: its clock is its own: a step of so many times 10 ms counts as 10 ms.
    """

    period_factor = 1.0

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

    def _use_crossings(self, transitions: Sequence[SensorTransition]) -> None:
        """Thesis 2.1.5: the angle at the seam is the heading from now on."""
        filter_ = self._filter
        theta = float(filter_.mean[THETA])
        seen = self._crossings.headings(transitions, self._odometer, self.pose, self.deck_pose, self.speed_m_s)
        for innovation, variance in seen:
            mean, covariance = filter_.mean.copy(), filter_.covariance.copy()
            mean[THETA] = theta + innovation
            covariance[THETA, :] = covariance[:, THETA] = 0.0
            covariance[THETA, THETA] = variance
            self.reset_filter(mean, covariance)
            self.counts["crossings_used"] += 1


class _NoEdges(DangerMonitor):
    """Permits everything: far from the rim an edge that a rule sees is a false one, and would end the run."""

    def step(self, sensors: Sensors, estimate: EstimateMessage | None) -> Verdict:
        del estimate
        return Verdict(sensors.seq, sensors.t, EventCode.NORMAL, "", "", 0.0, 0.0, True, True, True)


class _Replica(SilRun):
    """A rehearsal of the block's waypoints that may have the period error; ``run.panels`` counts the block's."""

    def __init__(self, cfg: Config, period_error: float) -> None:
        panels = cfg.run.panels
        cfg = cfg.model_copy(update={"run": cfg.run.model_copy(update={"panels": 0})})
        super().__init__(cfg, with_track=True)
        block = [p.panel for p in self.parts.points if p.row in _BLOCK and p.col in _BLOCK]
        kept = list(dict.fromkeys(block))[: panels or None]
        outside = [p for p in self.parts.points if p.panel not in kept]
        self.parts = parts = assemble(cfg, done=outside)
        self.monitor = _NoEdges(self.mirror, cfg.robot, cfg.danger)
        self.localizer, self.mission, self.gate = parts.localizer, parts.mission, parts.gate
        if cfg.run.filter == "kf":
            filter_ = FILTERS["kf"](np.zeros(STATES), np.eye(STATES))
            start = self.mirror.base_panel_pose
            localizer = ThesisLocalizer(filter_, self.mirror, cfg.robot, cfg.localizer, start)
            localizer.period_factor = 1.0 + period_error
            self.localizer = localizer


class ReplicaRun(NamedTuple):
    """One run, as the thesis measures it.

    Attributes:
        localization_m: distance of true and estimated position, every frame until the last stop, shape (k,).
        waypoint_m: distance of the robot's stop from its waypoint, shape (9 panels,) if all were reached.
        track: t, true x, y, estimated x, y, every tenth frame, shape (j, 5).
    """

    localization_m: NDArray[np.float64]
    waypoint_m: NDArray[np.float64]
    track: NDArray[np.float64]
    outcome: str
    cause: str


def run_replica(cfg: Config, *, period_error: float) -> ReplicaRun:
    """One simulation run.

    Args:
        cfg: with the keys of ``overrides_of``.
        period_error: by which part of the filter's step the loop takes longer.

    Raises:
        ValueError: a period error for a filter that reads time stamps.
    """
    if period_error and cfg.run.filter != "kf":
        raise ValueError(f"the filter {cfg.run.filter!r} reads time stamps: only kf can have a period error")
    return _figures(_Replica(cfg, period_error).run())


def _figures(rehearsal: SilResult) -> ReplicaRun:
    track = rehearsal.track if rehearsal.track is not None else np.empty((0, 7))
    stops = [stop for stop in rehearsal.stops if stop.approach == 1]
    # The way back to base is not part of the thesis's runs.
    track = track[track[:, 0] <= (stops[-1].t_s if stops else 0.0)]
    error = np.hypot(track[:, 1] - track[:, 4], track[:, 2] - track[:, 5])
    distance = np.array([stop.distance_m for stop in stops])
    return ReplicaRun(error, distance, track[::10, [0, 1, 2, 4, 5]], rehearsal.outcome, rehearsal.cause)
