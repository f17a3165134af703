"""The studies of whole missions over their factors.

`filters`: each filter in each world, compared with the least possible error. `time`: effect of the order of points, the
speed and the measuring time on the mission time, which may be one hour. `sensitivity`: effect of each disturbance of
the world `hard`, added alone to the world `thesis`, or removed alone from `hard`. `ablation`: effect of each technique
of estimation and control, switched off alone.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ccatp.config.load import load_config
from ccatp.core import FloatArray
from ccatp.mirror.mirror import build_mirror
from ccatp.report.plots import INK, QUIET
from ccatp.studies.campaign import Cell, CellResult, Factors, Job, JobOutcome, Study
from ccatp.studies.cramer_rao import WAY_T, RecordedSilRun, bounds_of
from ccatp.studies.mission_study import (
    COLUMN,
    Histogram,
    combine_missions,
    first_arrivals,
    mission_outcome,
    rms_and_p50,
    run_mission,
)
from ccatp.studies.results import LIMIT, FigureRow, Measure, colour, draw_ranges, grouped, levels, plot, rows_by
from ccatp.survey.planning.route import ORDERS
from ccatp.survey.planning.tour_bound import tour_bound

# -- filters ----------------------------------------------------------------------------------------------------------

_BOUND_EVERY = 4  # bounds take half the time of a mission and differ little between runs: every fourth seed has them
_SHOWN_MM = (0.01, 300.0)
_LIMIT_MM = 10.0
_DASHES = ("-", "--", ":")  # curves that coincide stay visible


def run_filter_mission(job: Job) -> JobOutcome:
    """One mission; for every fourth seed also the bounds along its true path, without and with the accelerometer."""
    if job.seed % _BOUND_EVERY != 1:
        values, arrays = run_mission(job)
        return JobOutcome(values, {**arrays, "bounds": np.empty((0, 5))})
    run = RecordedSilRun(job.cfg)
    values, arrays = mission_outcome(job.cfg, run.run())
    record, mirror = run.record(), build_mirror(job.cfg.mirror)
    without, with_it = (bounds_of(job.cfg, mirror, record, with_accelerometer=flag) for flag in (False, True))
    bounds = [
        (record.way[fix.frame, WAY_T], np.trace(bound_m2), np.trace(better_m2), *fix.error_m)
        for fix, bound_m2, better_m2 in zip(record.fixes, without, with_it, strict=True)
        if fix.point is not None
    ]
    return JobOutcome(values, {**arrays, "bounds": np.array(bounds, dtype=np.float64).reshape(-1, 5)})


def combine_filters(factors: Factors, outcomes: Sequence[JobOutcome]) -> JobOutcome:
    """Statistics of the missions, and their stop errors with the bound.

    Array ``bounds``: rows of t (s), least mean square distance without and with the accelerometer (m^2), error x, y
    (m), shape (k, 5).
    """
    values, arrays = combine_missions(factors, outcomes)
    # The first point of a run is left out: its error is mainly that of the start, not of the filter.
    bounds = np.concatenate([outcome.arrays["bounds"][1:] for outcome in outcomes])
    error_rms_mm = rms_and_p50(np.sqrt(np.sum(bounds[:, 3:] ** 2, axis=1)) ** 2)["rms"]
    bound: dict[str, Any] = {
        **_bound(bounds[:, 1], error_rms_mm),
        "error_rms_mm": error_rms_mm,
        "with_accelerometer": _bound(bounds[:, 2], error_rms_mm),
    }
    return JobOutcome({**values, "bound": bound}, {**arrays, "bounds": bounds})


def _bound(squares_m2: FloatArray, error_rms_mm: float | None) -> dict[str, float | None]:
    found = rms_and_p50(squares_m2)
    rms_mm = found["rms"]
    ratio = None if rms_mm is None or error_rms_mm is None else round(error_rms_mm / rms_mm, 4)
    return {"rms_mm": rms_mm, "p50_mm": found["p50"], "ratio": ratio}


def draw_filters(cells: Sequence[CellResult], out: Path) -> None:
    """Figures: exceedance of localization and arrival errors, stop errors with their bound, consistency."""
    for (mirror,), there in grouped(cells, "mirror").items():
        _draw_exceedance(there, _localization, f"Localization error on {mirror}", out / f"localization-{mirror}")
        _draw_exceedance(there, _arrival, f"First arrival error on {mirror}", out / f"arrival-{mirror}")
        rows = rows_by(there, "filter", "world")
        draw_ranges(rows, BOUND, f"Stop errors and the least possible on {mirror}", out / f"bound-{mirror}")
        title = f"Mean and 5 to 95 %; line: what a consistent filter has, on {mirror}"
        draw_ranges(rows, CONSISTENCY, title, out / f"consistency-{mirror}")


def _localization(cell: CellResult) -> tuple[FloatArray, FloatArray]:
    return Histogram.from_arrays(cell.arrays, "localization").exceedance()


def _arrival(cell: CellResult) -> tuple[FloatArray, FloatArray]:
    values = np.sort(first_arrivals(cell.arrays["stops"][:, 1:])[:, COLUMN["arrival_m"]])
    return values, 1.0 - np.arange(len(values)) / max(len(values), 1)  # share >= the value, so the largest is shown


def _draw_exceedance(
    cells: Sequence[CellResult], curve: Callable[[CellResult], tuple[FloatArray, FloatArray]], title: str, stem: Path
) -> None:
    worlds, filters = grouped(cells, "world"), levels(cells, "filter")
    columns = min(2, len(worlds))
    rows = -(-len(worlds) // columns)
    size, lowest = (4.4 * columns, 3.1 * rows + 0.5), 1.0
    with plot(stem, *size, rows, columns, title=title, legend=len(filters), sharex=True, sharey=True) as panels:
        for axes, ((world,), there) in zip(panels, worlds.items(), strict=False):
            for cell in there:
                values, share = curve(cell)
                is_seen = share > 0.0
                lowest = min(lowest, float(share[is_seen].min(initial=1.0)))
                index = filters.index(cell.factors["filter"])
                look = {"color": colour(index), "linestyle": _DASHES[index % len(_DASHES)], "linewidth": 1.6}
                axes.loglog(1e3 * values[is_seen], share[is_seen], label=str(cell.factors["filter"]), **look)
            axes.axvline(_LIMIT_MM, color=LIMIT, linewidth=1.0, linestyle=":")
            axes.set(xlim=_SHOWN_MM, title=f"world {world}", xlabel="error, mm", ylabel="share that is as large")
        for axes in panels[len(worlds) :]:
            axes.set_visible(False)
        panels[0].set_ylim(max(lowest, 1e-6) * 0.8, 1.3)
        panels[0].text(_LIMIT_MM * 1.08, 0.9, "10 mm", color=LIMIT, fontsize=8, va="top")


BOUND = (
    Measure(
        "rms position error at the stops (dot), posterior Cramér-Rao bound (end), with the accelerometer (mark), mm",
        ("bound.rms_mm", "bound.error_rms_mm"), "bound.error_rms_mm", "bound.with_accelerometer.rms_mm",
    ),
)  # fmt: skip
CONSISTENCY = (
    Measure("NEES of the pose", ("nees.pose.p5", "nees.pose.p95"), "nees.pose.mean", line=3.0),
    Measure("NEES of the position", ("nees.position.p5", "nees.position.p95"), "nees.position.mean", line=2.0),
    Measure("NIS of the fixes", ("nis.p5", "nis.p95"), "nis.mean", line=2.0),
)


FILTERS = Study(
    cells=lambda: [
        Cell({"world": world, "filter": name}, {"run.world": world, "run.filter": name})
        for world in ("thesis", "thesis-x2", "hard", "extreme")
        for name in ("kf", "ekf", "ukf")
    ],
    run_job=run_filter_mission,
    combine=combine_filters,
    columns="""
        complete
        localization_error_mm: mean p99 p99_9 max within_10mm_fraction
        localization_error_after_first_leg_mm: max
        heading_error_mrad: rms
        arrival_error_mm: mean p99 p99_9 max within_10mm_fraction
        arrival_error_after_first_leg_mm: max
        bound: error_rms_mm rms_mm ratio with_accelerometer.rms_mm with_accelerometer.ratio
        nees: pose.mean pose.band_95 position.mean
        nis: mean
        corrections
        after_correction_mm: max
        mission_time_s time_ratio
        danger: falls false_edges
    """,
    draw=draw_filters,
)

# -- time -------------------------------------------------------------------------------------------------------------

_PARTS = ("measuring", "driving", "turning", "settling")


def run_timed_mission(job: Job) -> JobOutcome:
    """One mission, and the least time of any tour through its points."""
    values, arrays = run_mission(job)
    cfg = job.cfg
    mirror = build_mirror(cfg.mirror)
    points = ORDERS[cfg.run.order](mirror, cfg.run.panels)
    bound_s = tour_bound(mirror, points, cfg.limits, cfg.etalon.measuring_time_s)
    return JobOutcome({**values, "tour_bound_s": round(bound_s, 3), "budget_s": cfg.run.budget_s}, arrays)


def combine_times(factors: Factors, outcomes: Sequence[JobOutcome]) -> JobOutcome:
    """Statistics of the missions, and the time margin of the slowest one."""
    values, arrays = combine_missions(factors, outcomes)
    tour_s, budget_s = (float(outcomes[0].values[name]) for name in ("tour_bound_s", "budget_s"))
    mean_s, slowest_s = values["mission_time_s"], values["mission_time_max_s"]
    more = {
        "tour_bound_s": tour_s,
        "tour_ratio": None if mean_s is None else round(mean_s / tour_s, 5),
        "budget_s": budget_s,
        "margin_s": None if slowest_s is None else round(budget_s - slowest_s, 3),
    }
    return JobOutcome({**values, **more}, arrays)


def draw_times(cells: Sequence[CellResult], out: Path) -> None:
    """Time in each mission state, bounds and budget: a bar for each cell, a figure for each mirror."""
    known = [cell for cell in cells if cell.values["mission_time_s"] is not None]
    for (mirror,), there in grouped(known, "mirror").items():
        with plot(out / f"time-{mirror}", 8.4, 0.32 * len(there) + 1.9, legend=4) as (axes,):
            for place, cell in enumerate(there):
                left_s, states_s = 0.0, cell.values["states_s"]
                rest_s = sum(time_s for state, time_s in states_s.items() if state not in _PARTS)
                shown = [(part, states_s.get(part, 0.0), colour(k)) for k, part in enumerate(_PARTS)]
                for part, width_s, shade in (*shown, ("rest", rest_s, QUIET)):
                    axes.barh(place, width_s, left=left_s, height=0.66, color=shade, label=None if place else part)
                    left_s += width_s
                for bound_s, style, name in (
                    (cell.values["lower_bound_s"], "-", "bound of the path"),
                    (cell.values["tour_bound_s"], ":", "bound of any tour"),
                ):
                    ends, label = [place - 0.45, place + 0.45], None if place else name
                    axes.plot([bound_s] * 2, ends, color=INK, linestyle=style, label=label)
                axes.text(left_s, place, f"  {cell.values['time_ratio']:.3f}", va="center", fontsize=7, color=QUIET)
            budget_s = there[0].values["budget_s"]
            if max(cell.values["mission_time_s"] for cell in there) > 0.4 * budget_s:  # not for a few panels only
                axes.axvline(budget_s, color=LIMIT, linewidth=1.2, label="budget")
            factors = [cell.factors for cell in there]
            names = [f"{f['order']}, {f['v_max_m_s']:.2f} m/s, {f['measuring_time_s']:.1f} s" for f in factors]
            axes.set_yticks(range(len(there)), names)
            axes.invert_yaxis()
            axes.margins(x=0.08)
            axes.set_xlabel("time, s; number: in units of the path's bound")
            axes.set_title(f"Where the time of a mission on {mirror} goes")


TIME = Study(
    cells=lambda: [
        Cell(
            {"order": order, "v_max_m_s": v_m_s, "measuring_time_s": measuring_s},
            {"run.order": order, "limits.v_max_m_s": v_m_s, "etalon.measuring_time_s": measuring_s},
        )
        for order in ("thesis", "optimised")
        for v_m_s in (0.10, 0.15, 0.20)
        for measuring_s in (0.5, 1.0)
    ],
    run_job=run_timed_mission,
    combine=combine_times,
    columns="""
        complete mission_time_s lower_bound_s time_ratio tour_bound_s tour_ratio margin_s
        states_s: turning driving settling measuring
        corrections
        localization_error_mm: mean
        arrival_error_mm: mean max
    """,
    draw=draw_times,
    runs=2,
)

# -- sensitivity ------------------------------------------------------------------------------------------------------

# Groups of keys of a world.
GROUPS = {
    "encoder counts": ("encoder_sigma_rad_s", "encoder_counts_per_rev"),
    "gyroscope": ("gyroscope_bias_sigma_rad_s", "gyroscope_bias_walk_rad_s_sqrt_s", "gyroscope_scale_sigma"),
    "accelerometer": ("accelerometer_bias_sigma_m_s2", "accelerometer_bias_walk_m_s2_sqrt_s"),
    "slip": ("slip_min", "slip_max", "slip_walk_sigma", "slip_walk_time_s"),
    "creep": ("creep_fraction", "creep_walk_fraction", "creep_walk_time_s"),
    "vibration": ("vibration_rate_rad_s", "vibration_speed_m_s", "vibration_acceleration_m_s2"),
    "wheels": ("wheel_radius_sigma", "wheel_base_sigma", "wheel_lag_spread"),
    "delays": ("sensors_delay_s", "commands_delay_s"),
    "panel edges": ("panel_edge_sigma_m",),
}
ALL_ON = "nothing"
_BASES = {"none": "world {}", "all": "world {}", ALL_ON: "with all"}  # levels without a change, and their labels
WORLDS = ("thesis", "hard")


def sensitivity_cells() -> Sequence[Cell]:
    """The quiet world, alone and with each group added; the hard world, alone and with each group removed."""
    quiet, hard = (load_config(None, {"run.world": name}).world for name in ("thesis", "hard"))
    found = []
    for base, whole, sign, other in (("thesis", "none", "plus", hard), ("hard", "all", "minus", quiet)):
        found.append(Cell({"world": base, "group": whole}, {"run.world": base}))
        for group, keys in GROUPS.items():
            values = {f"world.{key}": getattr(other, key) for key in keys}
            found.append(Cell({"world": base, "group": f"{sign} {group}"}, {"run.world": base, **values}))
    return found


MISSION = (
    *(
        Measure(label, (f"{key}.mean", f"{key}.p99"), f"{key}.mean")
        for label, key in (
            ("localization error, mm", "localization_error_mm"),
            ("first arrival error, mm", "arrival_error_mm"),
        )
    ),
    Measure("time / bound of the path", ("time_ratio", "time_ratio"), "time_ratio", is_log=False),
)
SHOWN = "mean (dot), 99th percentile (end of the bar)"


def _drawing(name: str, factor: str, groups: Sequence[str], title: str) -> Callable[[Sequence[CellResult], Path], None]:
    """A function that draws a figure for all levels of ``groups``, with a row for each level of a factor."""

    def draw(cells: Sequence[CellResult], out: Path) -> None:
        for found, there in grouped(cells, *groups).items():
            rows = [_row(cell, factor) for cell in there]
            draw_ranges(rows, MISSION, f"{title.format(*found)}: {SHOWN}", out / "-".join((name, *found)))

    return draw


def _row(cell: CellResult, factor: str) -> FigureRow:
    """A row with a colour for each world; cells without a change are the base."""
    world, level = str(cell.factors["world"]), str(cell.factors[factor])
    label = {"group": level, "without": f"without {level}"}[factor]
    return FigureRow(_BASES.get(level, label).format(world), cell, WORLDS.index(world), level in _BASES)


SENSITIVITY = Study(
    cells=sensitivity_cells,
    run_job=run_mission,
    combine=combine_missions,
    columns="""
        complete
        localization_error_mm: mean p99 max
        heading_error_mrad: rms
        arrival_error_mm: mean p99 max
        stop_error_mm: rms
        nees: pose.mean
        corrections mission_time_s time_ratio
        danger: false_edges
    """,
    draw=_drawing("sensitivity", "group", ("mirror",), "What each disturbance costs on {}"),
    defaults={"run.filter": "ekf"},
    runs=5,
)

# -- ablation ---------------------------------------------------------------------------------------------------------

_USE = "localizer.full_state.use"
# Technique that is switched off, and the keys that do so.
WITHOUT: Mapping[str, Mapping[str, object]] = {
    ALL_ON: {},
    "zero-velocity updates": {f"{_USE}.zero_velocity": False},
    "biases seen at rest": {f"{_USE}.rest_biases": False},
    "seam crossings": {f"{_USE}.seams": False},
    "states of edge offsets": {"localizer.full_state.edge_sigma_m": 1e-9},
    "gravity heading": {f"{_USE}.gravity": False},
    "accelerometer": {f"{_USE}.accelerometer": False},
    "slip learned leg by leg": {f"{_USE}.slip_per_leg": False},
    "slip that wanders": {"localizer.full_state.wander_fraction": 0.0},
    "calibration drive": {"mission.calibration_length_m": 0.0},
    "calibration drive, first fix": {"mission.calibration_length_m": 0.0, "mission.fix_at_start": False},
    "delay prediction": {"control.predicts_delay": False},
    "wheel lag in the control": {"robot.wheel_lag_s": 0.0},
    "creep compensation": {"control.compensates_creep": False},
    "slip share in the control": {"control.slip_limit": 0.0},
    "settling on means": {"control.settle_mean_time_s": 1e-6},
    "regulator on the line": {"control.cross_track_gain_rad_m2": 0.0},
    "line tracking (thesis's PID)": {"control.gains": "thesis"},
    "correction moves": {"mission.max_approaches": 1},
    "thesis's order (optimised)": {"run.order": "optimised"},
}


ABLATION = Study(
    cells=lambda: [
        Cell({"world": world, "without": name}, {"run.world": world, **keys})
        for world in WORLDS
        for name, keys in WITHOUT.items()
    ],
    run_job=run_mission,
    combine=combine_missions,
    columns="""
        complete
        localization_error_mm: mean p99 max
        arrival_error_mm: mean p99 max within_10mm_fraction
        stop_error_mm: rms
        heading_error_mrad: rms
        nees: pose.mean
        corrections mission_time_s time_ratio
        danger: false_edges
        causes
    """,
    draw=_drawing("ablation", "without", ("mirror", "world"), "Without a technique, world {1} on {0}"),
    defaults={"run.filter": "ekf"},
    runs=3,
)
