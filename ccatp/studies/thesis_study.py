"""The study `thesis`: the thesis's simulation repeated, five runs of 36 waypoints compared with its published values.

Four panels, the thesis's filter and control, and two interpretations of its text. Cells with one of them switched off
show its effect:

* ``noise_is_variance``: eq. 2.17 calls sigma a variance. Then a sensor's standard deviation is the square root of the
  value in table 2.1. The filter's R is the same, as in the thesis.
* ``period_error``: the filter's time step is 10 ms, but the loop takes longer by this fraction. So the true robot moves
  longer than the filter assumes; control and rules use the true time.

Both are properties of that simulation. A daemon that reads the time stamps of the samples has no period error. As in
thesis 2.1.5 the angle at a seam replaces the heading here, however certain the filter is. The cells of the system
``ours`` have the same waypoints and noise, with the daemon's filter and control.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from math import sqrt
from pathlib import Path
from typing import Any

import numpy as np

from ccatp.config.models import Config
from ccatp.core import EdgeSample, Fix, FloatArray, GravitySample, ImuSample, Verdict, WheelSample
from ccatp.danger import DangerMonitor
from ccatp.estimation.localizer_base import SensorTransition
from ccatp.estimation.thesis_localizer import THETA, FourStateLocalizer
from ccatp.estimation.wheel_coast import WheelInput
from ccatp.links.robot_messages import Sensors
from ccatp.links.topics import EstimateMessage
from ccatp.records.summary import WITHIN_M
from ccatp.report.plots import INK, QUIET
from ccatp.studies.campaign import Cell, CellResult, Factors, Job, JobOutcome, Study
from ccatp.studies.mission_study import Histogram, of_histogram, of_values, pooled
from ccatp.studies.results import LIMIT, colour, grouped, plot
from ccatp.studies.sil_run import SilRun
from ccatp.survey.composition import assemble

FRAME_HZ = 100.0
POINTS, PANELS = 36, 4
# Accelerometer m/s^2, gyroscope rad/s, encoder rad/s: thesis table 2.1.
_TABLE = {"normal": (0.0059, 0.0087, 0.001), "twice": (0.0118, 0.0175, 0.002)}
_WORLDS = {"normal": "thesis", "twice": "thesis-x2"}
_SENSORS = ("accelerometer_sigma_m_s2", "gyroscope_sigma_rad_s", "encoder_sigma_rad_s")
# A block of 2 x 2 panels of thesis-m1 with other panels all around it: a turning robot cannot reach the rim.
_BLOCK = (3, 4)  # its rows and columns, with the same parity as the mirror's first ones (table 3.1)
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

    ``noise``: ``normal`` or ``twice``. ``period_error``: fraction of the filter's step by which the loop takes longer.
    ``is_ours``: the daemon's filter and control in the same set-up, with all encoder samples.
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
        "mission.max_approaches": 1,  # the thesis has no correction moves
        "sim.robot.frame_hz": frame_hz,
        # Thesis 2.1.4: only the latest sample of each sensor is used, one per frame.
        "sim.robot.imu_hz": frame_hz,
        "sim.robot.encoder_hz": frame_hz,
        "sim.robot.edge_hz": 10.0 * frame_hz,
    }


class ThesisLocalizer(FourStateLocalizer):
    """The four-state localizer with the period error and the heading replacement of the thesis."""

    period_factor = 1.0  # a step of this many times 10 ms is processed as 10 ms

    def step(
        self, t_s: float, imu: Sequence[ImuSample], encoders: Sequence[WheelSample], edges: Sequence[EdgeSample],
        gravity: GravitySample | None = None, set_points: WheelInput = None,
    ) -> None:  # fmt: skip
        """Process one sensors frame; see ``FourStateLocalizer.step``."""
        k = 1.0 / self.period_factor
        super().step(
            k * t_s,
            [ImuSample(k * t, ax, wz) for t, ax, wz in imu],
            [WheelSample(k * t, right, left) for t, right, left in encoders],
            [EdgeSample(k * t, *values) for t, *values in edges],
            gravity,
            set_points,
        )

    def fuse_fix(self, fix: Fix) -> float:
        """Fuse a fix; see ``FourStateLocalizer.fuse_fix``."""
        return super().fuse_fix(replace(fix, t_s=fix.t_s / self.period_factor))

    def _use_crossings(self, transitions: Sequence[SensorTransition]) -> None:
        """Thesis 2.1.5: the angle at the seam replaces the heading."""
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
    """Permits all motion: far from the rim every detected edge is a false one, and would end the run."""

    def step(self, sensors: Sensors, estimate: EstimateMessage | None) -> Verdict:
        del estimate
        return Verdict.normal(sensors.seq, sensors.t)


class _Replica(SilRun):
    """A mission over the block's waypoints, with a period error for ``kf``; ``run.panels``: of the block, 0: all."""

    def __init__(self, cfg: Config, period_error: float) -> None:
        panels = cfg.run.panels
        cfg = cfg.model_copy(update={"run": cfg.run.model_copy(update={"panels": 0})})
        super().__init__(cfg)
        block = [p.panel for p in self.parts.points if p.row in _BLOCK and p.col in _BLOCK]
        kept = list(dict.fromkeys(block))[: panels or None]
        outside = [p for p in self.parts.points if p.panel not in kept]
        self.parts = self.pipeline.parts = parts = assemble(cfg, done=outside)
        self.monitor = _NoEdges(self.mirror, cfg.robot, cfg.danger)
        self.pipeline.localizer = parts.localizer
        self.pipeline.mission = parts.mission
        self.pipeline.gate = parts.gate
        if cfg.run.filter == "kf":
            localizer = ThesisLocalizer(cfg, self.mirror, self.mirror.base_panel_pose)
            localizer.period_factor = 1.0 + period_error
            self.pipeline.localizer = localizer


# Thesis 2.3.2 (one run for each noise) and 3.5 (five runs each): share below 1 cm, mean, largest, mm.
PUBLISHED: dict[str, dict[str, dict[str, float]]] = {
    "normal": {
        "localization": {"within_10mm_fraction": 0.9621, "mean": 3.4, "max": 18.1},
        "waypoint": {"within_10mm_fraction": 0.8889, "mean": 6.4, "max": 14.9},
    },
    "twice": {
        "localization": {"within_10mm_fraction": 0.925, "mean": 3.9, "max": 31.7},
        "waypoint": {"within_10mm_fraction": 0.8333, "mean": 7.1, "max": 42.9},
    },
}
RUNS = {"localization": 1, "waypoint": 5}  # number of runs of the published values
# With the first one this simulation is closest to the published values; with the second one another simulation of the
# same text was closest. The true period of that loop is not known.
PERIOD_ERRORS = (0.008, 0.013)
_TRACK_STEP = 20  # frames, a fifth of a second, between points of the drawn track
_SHOWN = " ".join(f"{name}.mean {name}.run_to_run published.{name}" for name in ("within_10mm_fraction", "mean", "max"))
_SCATTERS = 2.0  # standard deviations beyond which a published value counts as different


def cells() -> Sequence[Cell]:
    """Interpretations times noise for the thesis's system; ours has no period error."""
    nearest, other = PERIOD_ERRORS
    readings = [(True, nearest), (True, 0.0), (False, nearest), (False, 0.0), (True, other)]
    rows = [("thesis", noise, *reading) for reading in readings for noise in _TABLE]
    rows += [("ours", noise, is_variance, 0.0) for is_variance, noise in product((True, False), _TABLE)]
    return [
        Cell(
            {"system": system, "noise": noise, "noise_is_variance": is_variance, "period_error": error},
            overrides_of(noise, noise_is_variance=is_variance, period_error=error, is_ours=system == "ours"),
        )
        for system, noise, is_variance, error in rows
    ]


def run_job(job: Job) -> JobOutcome:
    """One simulation run with the error definitions of the thesis.

    Arrays: ``waypoint_m``, distance of each stop from its waypoint; ``track``: t, true x, y, estimated x, y, shape
    (j, 5); histogram of the distance between true and estimated position in every frame until the last stop.
    """
    found = _Replica(job.cfg, float(job.factors["period_error"])).run()
    track = found.track
    stops = [stop for stop in found.stops if stop.approach == 1]
    # The drive back to base is not part of the thesis's runs.
    track = track[track[:, 0] <= (stops[-1].t_s if stops else 0.0)]
    error_m = np.hypot(track[:, 1] - track[:, 4], track[:, 2] - track[:, 5])
    waypoint_m = np.array([stop.distance_m for stop in stops])
    values = {
        "outcome": found.outcome,
        "cause": found.cause,
        "waypoints": waypoint_m.size,
        "wanted": POINTS * (job.cfg.run.panels or PANELS) // PANELS,
        "time_s": float(track[::10][-1, 0]) if track.size else 0.0,
        "localization": _of_run(error_m),
        "waypoint": _of_run(waypoint_m),
    }
    arrays: dict[str, Any] = {
        "waypoint_m": waypoint_m,
        "track": track[::_TRACK_STEP, [0, 1, 2, 4, 5]].astype(np.float32),
        **Histogram.of(error_m).to_arrays("localization"),
    }
    return JobOutcome(values, arrays)


def _of_run(errors_m: FloatArray) -> dict[str, float]:
    if not errors_m.size:
        return dict.fromkeys(("within_10mm_fraction", "mean", "max"), float("nan"))
    return {
        "within_10mm_fraction": float(np.mean(errors_m < WITHIN_M)),
        "mean": 1e3 * float(np.mean(errors_m)),
        "max": 1e3 * float(np.max(errors_m)),
    }


def combine(factors: Factors, outcomes: Sequence[JobOutcome]) -> JobOutcome:
    """Pooled values, their scatter between runs, and the published ones."""
    values = [outcome.values for outcome in outcomes]
    waypoint_m = np.concatenate([outcome.arrays["waypoint_m"] for outcome in outcomes])
    localization = pooled([Histogram.from_arrays(outcome.arrays, "localization") for outcome in outcomes])
    figures: dict[str, Any] = {
        "complete": sum(v["outcome"] == "complete" and v["waypoints"] == v["wanted"] for v in values),
        "causes": sorted({v["cause"] for v in values if v["cause"]}),
        "time_s": float(np.mean([v["time_s"] for v in values])),
        "localization_error_mm": of_histogram(localization),
        "arrival_error_mm": of_values(waypoint_m),
    }
    for quantity, published in PUBLISHED[str(factors["noise"])].items():
        figures[quantity] = _beside(published, [v[quantity] for v in values], RUNS[quantity])
    arrays: dict[str, Any] = {
        "waypoint_m": waypoint_m,
        "track": outcomes[0].arrays["track"],
        **localization.to_arrays("localization"),
    }
    return JobOutcome(figures, arrays)


def _beside(published: Mapping[str, float], runs: Sequence[Mapping[str, float]], published_runs: int) -> dict[str, Any]:
    """Mean and scatter of single runs for each value, and the difference to the published one in units of scatter.

    The difference between a mean over n runs and one over m runs has the standard deviation s sqrt(1/n + 1/m). The
    largest value of m > 1 runs is not a mean, so it is not compared here.
    """
    found: dict[str, Any] = {"published": dict(published), "published_runs": published_runs}
    for name, theirs in published.items():
        ours = np.array([run[name] for run in runs])
        mean = float(np.mean(ours))
        spread = float(np.std(ours, ddof=1)) if ours.size > 1 else float("nan")
        scatter = spread * sqrt(1.0 / ours.size + 1.0 / published_runs)
        is_comparable = ours.size > 1 and (name != "max" or published_runs == 1)
        found[name] = {
            "mean": mean,
            "run_to_run": spread,
            "least": float(np.min(ours)),
            "largest": float(np.max(ours)),
            "published_minus_mean_in_scatters": (theirs - mean) / scatter
            if is_comparable and scatter > 0.0
            else float("nan"),
            "is_published_within": abs(theirs - mean) <= _SCATTERS * scatter if is_comparable else None,
        }
    verdicts = [found[name]["is_published_within"] for name in published]
    compared = [verdict for verdict in verdicts if verdict is not None]
    found["is_published_within"] = all(compared) if compared else None
    return found


# -- figures, each like one of the thesis: 2.9 to 2.12, 3.10 and 3.11 -------------------------------------------------

_NUMBERS = {"normal": ("2.9", "2.10", "3.10"), "twice": ("2.11", "2.12", "3.11")}
_LIMIT_MM = 1e3 * WITHIN_M
_BIN_MM = 1.0


def draw(results: Sequence[CellResult], out: Path) -> None:
    """For both noises: path of the first run, distribution of the localization error, waypoint errors of all runs."""
    for (noise,), mine in grouped(results, "noise").items():
        published, titles = PUBLISHED[noise], [f"{noise} noise, as fig. {number}" for number in _NUMBERS[noise]]
        _draw_localization(mine, published["localization"], titles[1], out / f"localization_{noise}")
        for result in [r for r in mine if r.factors["noise_is_variance"] and r.factors["period_error"]][:1]:
            _draw_trajectory(result, titles[0], out / f"trajectory_{noise}")
            _draw_waypoints(result, published["waypoint"], titles[2], out / f"waypoints_{noise}")


def _draw_trajectory(result: CellResult, title: str, stem: Path) -> None:
    track = result.arrays["track"]
    with plot(stem, 6.4, 6.0, legend=2) as (axes,):
        axes.plot(track[:, 1], track[:, 2], color=colour(0), linewidth=1.6, label="true")
        axes.plot(track[:, 3], track[:, 4], color=colour(1), linewidth=0.9, linestyle="--", label="estimated")
        axes.set(aspect="equal", xlabel="x, m", ylabel="y, m", title=f"Way of one run, {title}")


def _draw_localization(results: Sequence[CellResult], published: Mapping[str, float], title: str, stem: Path) -> None:
    with plot(stem, 7.2, 5.2, legend=2) as (axes,):
        for k, result in enumerate(results):
            values, beyond = Histogram.from_arrays(result.arrays, "localization").exceedance()
            factors = result.factors
            who, style = ("ekf, shipped control", ":") if factors["system"] == "ours" else ("kf, thesis's control", "-")
            noise = "variances" if factors["noise_is_variance"] else "standard deviations"
            late = 100.0 * float(factors["period_error"])
            label = f"{who}: {noise}{f', period {late:.1f} % long' if late else ''}"
            axes.semilogx(1e3 * values, 1.0 - beyond, color=colour(k), linestyle=style, linewidth=1.5, label=label)
        marks_mm, shares = [_LIMIT_MM, published["max"]], [published["within_10mm_fraction"], 1.0]
        axes.plot(marks_mm, shares, "x", color=INK, label="published")
        axes.axvline(_LIMIT_MM, color=LIMIT, linewidth=0.9)
        axes.set_xlim(0.01, 100.0)
        axes.set_xlabel("distance between true and estimated position, mm")
        axes.set(ylabel="share of all instants below", title=f"Localization error, {title}")


def _draw_waypoints(result: CellResult, published: Mapping[str, float], title: str, stem: Path) -> None:
    errors = 1e3 * np.asarray(result.arrays["waypoint_m"])
    within = float(np.mean(errors < _LIMIT_MM)) if errors.size else float("nan")
    title = (
        f"Waypoint error, {title}: {100.0 * within:.1f} % below 1 cm "
        f"(published {100.0 * published['within_10mm_fraction']:.2f} %)"
    )
    with plot(stem, 9.0, 3.6, 1, 2, title=title, width_ratios=(2, 1), sharey=True) as (left, right):
        left.plot(np.arange(1, errors.size + 1), errors, ".", color=colour(0), markersize=4)
        bins = np.arange(0.0, max(errors.max(initial=0.0), _LIMIT_MM) + _BIN_MM, _BIN_MM)
        right.hist(errors, bins=bins.tolist(), orientation="horizontal", color=colour(0))
        for axes in (left, right):
            axes.axhline(_LIMIT_MM, color=LIMIT, linewidth=0.9, label="1 cm")
            axes.axhline(published["mean"], color=QUIET, linewidth=0.9, linestyle="--", label="published mean")
            axes.axhline(published["max"], color=QUIET, linewidth=0.9, linestyle=":", label="published largest")
        left.set(xlabel="waypoint, one run after the other", ylabel="distance of the stop, mm")
        right.set_xlabel("waypoints")
        right.legend(frameon=False, fontsize=7)


STUDY = Study(
    cells=cells,
    run_job=run_job,
    combine=combine,
    columns="complete\n" + "\n".join(f"{quantity}: {_SHOWN} is_published_within" for quantity in RUNS),
    draw=draw,
    mirrors=(),
    runs=5,
)
