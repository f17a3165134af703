"""The studies `time`, `sensitivity` and `ablation`: whole missions with one thing changed.

`time`: what order of points, speed and measuring time do to the hour a mission may take. `sensitivity`: what each
disturbance of the world `hard` costs, alone, and what its absence saves. `ablation`: what each technique of estimation
and control gives, by switching it off alone.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

from ccatp.config.load import load_config
from ccatp.mirror.mirror import build_mirror
from ccatp.report.plots import INK, QUIET
from ccatp.studies.campaign import Cell, CellResult, Column, Factors, Job, JobOutcome, Study
from ccatp.studies.mission_study import combine_missions, run_mission
from ccatp.studies.results import LIMIT, FigureRow, colour, draw_ranges, plot
from ccatp.survey.planning.route import ORDERS
from ccatp.survey.planning.tour_bound import tour_bound

_PARTS = ("measuring", "driving", "turning", "settling")


def time_cells() -> Sequence[Cell]:
    """Orders times speeds times measuring times."""
    return [
        Cell(
            {"order": order, "v_max_m_s": v_m_s, "measuring_time_s": measuring_s},
            {"run.order": order, "limits.v_max_m_s": v_m_s, "etalon.measuring_time_s": measuring_s},
        )
        for order in ("thesis", "optimised")
        for v_m_s in (0.10, 0.15, 0.20)
        for measuring_s in (0.5, 1.0)
    ]


def run_timed_mission(job: Job) -> JobOutcome:
    """One mission, and the least time of any tour through its points."""
    values, arrays = run_mission(job)
    cfg = job.cfg
    mirror = build_mirror(cfg.mirror)
    points = ORDERS[cfg.run.order](mirror, cfg.run.panels)
    bound_s = tour_bound(mirror, points, cfg.limits, cfg.etalon.measuring_time_s)
    return JobOutcome({**values, "tour_bound_s": round(bound_s, 3), "budget_s": cfg.run.budget_s}, arrays)


def combine_times(factors: Factors, outcomes: Sequence[JobOutcome]) -> JobOutcome:
    """The missions pooled, and the margin that the slowest leaves."""
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
    """Where the time of a mission goes, its bounds and the budget: a bar for each cell, a figure for each mirror."""
    for mirror in dict.fromkeys(str(cell.factors["mirror"]) for cell in cells):
        there = [c for c in cells if c.factors["mirror"] == mirror and c.values["mission_time_s"] is not None]
        if there:
            _draw_time(mirror, there, out / f"time-{mirror}")


def _draw_time(mirror: str, cells: Sequence[CellResult], stem: Path) -> None:
    with plot(stem, 8.4, 0.32 * len(cells) + 1.9, legend=4) as (_, (axes,)):
        for place, cell in enumerate(cells):
            left_s = 0.0
            states_s = cell.values["states_s"]
            rest_s = sum(time_s for state, time_s in states_s.items() if state not in _PARTS)
            for index, part in enumerate((*_PARTS, "rest")):
                width_s = rest_s if part == "rest" else states_s.get(part, 0.0)
                shade = QUIET if part == "rest" else colour(index)
                axes.barh(place, width_s, left=left_s, height=0.66, color=shade, label=None if place else part)
                left_s += width_s
            for name, style, label in (
                ("lower_bound_s", "-", "bound of the path"),
                ("tour_bound_s", ":", "bound of any tour"),
            ):
                ends = [place - 0.45, place + 0.45]
                axes.plot([cell.values[name]] * 2, ends, color=INK, linestyle=style, label=None if place else label)
            axes.text(left_s, place, f"  {cell.values['time_ratio']:.3f}", va="center", fontsize=7, color=QUIET)
        budget_s = cells[0].values["budget_s"]
        longest_s = max(cell.values["mission_time_s"] for cell in cells)
        if longest_s > 0.4 * budget_s:  # a few panels do not take an hour
            axes.axvline(budget_s, color=LIMIT, linewidth=1.2, label="budget")
        names = (
            f"{f['order']}, {f['v_max_m_s']:.2f} m/s, {f['measuring_time_s']:.1f} s" for f in (c.factors for c in cells)
        )
        axes.set_yticks(range(len(cells)), list(names))
        axes.invert_yaxis()
        axes.margins(x=0.08)
        axes.set_xlabel("time, s; number: in units of the path's bound")
        axes.set_title(f"Where the time of a mission on {mirror} goes")


TIME = Study(
    name="time",
    title="Order, speed and measuring time against the hour",
    cells=time_cells,
    run_job=run_timed_mission,
    combine=combine_times,
    columns=(
        Column("complete", "complete"),
        Column("mission, s", "mission_time_s", ".0f"),
        Column("bound of the path, s", "lower_bound_s", ".0f"),
        Column("time / bound", "time_ratio", ".4f"),
        Column("bound of any tour, s", "tour_bound_s", ".0f"),
        Column("time / any tour", "tour_ratio", ".4f"),
        Column("margin to the budget, s", "margin_s", ".0f"),
        Column("turning, s", "states_s.turning", ".0f"),
        Column("driving, s", "states_s.driving", ".0f"),
        Column("settling, s", "states_s.settling", ".0f"),
        Column("measuring, s", "states_s.measuring", ".0f"),
        Column("corrections", "corrections"),
        Column("localization mean, mm", "localization_error_mm.mean", ".3f"),
        Column("arrival mean, mm", "arrival_error_mm.mean", ".3f"),
        Column("arrival max, mm", "arrival_error_mm.max", ".2f"),
    ),
    draw=draw_times,
    runs=2,
)


def _error_columns(tail: str, more: Sequence[Column], late: Sequence[Column] = ()) -> tuple[Column, ...]:
    """Columns of missions with one thing changed, with more before and late ones after the stop error."""
    return (
        Column("complete", "complete"),
        Column("localization mean, mm", "localization_error_mm.mean", ".3f"),
        Column("p99", "localization_error_mm.p99", tail),
        Column("max", "localization_error_mm.max", ".2f"),
        *more,
        Column("stop error rms, mm", "stop_error_mm.rms", ".3f"),
        *late,
        Column("NEES pose (3)", "nees.pose.mean", ".2f"),
        Column("corrections", "corrections"),
        Column("mission, s", "mission_time_s", ".0f"),
        Column("time / bound", "time_ratio", ".4f"),
        Column("false edges", "danger.false_edges"),
    )


# What belongs together, as keys of a world.
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
_BASES = ("none", "all")


def sensitivity_cells() -> Sequence[Cell]:
    """The quiet world, each group added to it; the hard world, each group taken from it."""
    quiet, hard = (load_config(None, {"run.world": name}).world for name in ("thesis", "hard"))
    found = []
    for base, whole, sign, other in (("thesis", "none", "plus", hard), ("hard", "all", "minus", quiet)):
        found.append(Cell({"world": base, "group": whole}, {"run.world": base}))
        for group, keys in GROUPS.items():
            values = {f"world.{key}": getattr(other, key) for key in keys}
            found.append(Cell({"world": base, "group": f"{sign} {group}"}, {"run.world": base, **values}))
    return found


def draw_sensitivity(cells: Sequence[CellResult], out: Path) -> None:
    """One figure for each mirror, the undisturbed and the fully disturbed world as lines."""
    worlds = list(dict.fromkeys(cell.factors["world"] for cell in cells))
    rows: dict[str, list[FigureRow]] = {}
    for cell in cells:
        world, group = cell.factors["world"], str(cell.factors["group"])
        label = f"world {world}" if group in _BASES else group
        row = FigureRow(label, cell, worlds.index(world), group in _BASES)
        rows.setdefault(str(cell.factors["mirror"]), []).append(row)
    for mirror, there in rows.items():
        draw_ranges(there, f"What each disturbance costs on {mirror}", out / f"sensitivity-{mirror}")


SENSITIVITY = Study(
    name="sensitivity",
    title="What each disturbance costs",
    cells=sensitivity_cells,
    run_job=run_mission,
    combine=combine_missions,
    columns=_error_columns(
        ".3f",
        (
            Column("heading rms, mrad", "heading_error_mrad.rms", ".3f"),
            Column("arrival mean, mm", "arrival_error_mm.mean", ".3f"),
            Column("p99", "arrival_error_mm.p99", ".3f"),
            Column("max", "arrival_error_mm.max", ".2f"),
        ),
    ),
    draw=draw_sensitivity,
    defaults={"run.filter": "ekf"},
    runs=5,
)

WORLDS = ("thesis", "hard")
ALL_ON = "nothing"
_USE = "localizer.full_state.use"
# What is off, and the keys that switch it off.
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


def draw_ablation(results: Sequence[CellResult], out: Path) -> None:
    """Figures ``ablation-<mirror>-<world>``, the mission with everything as a line."""
    rows: dict[tuple[str, str], list[FigureRow]] = {}
    for cell in results:
        mirror, world, name = (str(cell.factors[key]) for key in ("mirror", "world", "without"))
        label = "with all" if name == ALL_ON else f"without {name}"
        rows.setdefault((mirror, world), []).append(FigureRow(label, cell, WORLDS.index(world), name == ALL_ON))
    for (mirror, world), there in rows.items():
        draw_ranges(there, f"Without a technique, world {world} on {mirror}", out / f"ablation-{mirror}-{world}")


ABLATION = Study(
    name="ablation",
    title="What each technique gives: one switched off at a time",
    cells=lambda: [
        Cell({"world": world, "without": name}, {"run.world": world, **keys})
        for world in WORLDS
        for name, keys in WITHOUT.items()
    ],
    run_job=run_mission,
    combine=combine_missions,
    columns=(
        *_error_columns(
            ".2f",
            (
                Column("arrival mean, mm", "arrival_error_mm.mean", ".3f"),
                Column("p99", "arrival_error_mm.p99", ".2f"),
                Column("max", "arrival_error_mm.max", ".2f"),
                Column("first arrivals within 10 mm", "arrival_error_mm.within_10mm_fraction", ".2%"),
            ),
            (Column("heading rms, mrad", "heading_error_mrad.rms", ".2f"),),
        ),
        Column("ended by", "causes"),
    ),
    draw=draw_ablation,
    defaults={"run.filter": "ekf"},
    runs=3,
)
