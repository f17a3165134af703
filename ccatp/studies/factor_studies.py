"""The study `sensitivity`: what each disturbance of the world `hard` costs, alone, and what its absence saves.

The figure of the study `sensitivity`.

The study `ablation`: what each technique of estimation and control gives, by switching it off alone.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

from ccatp.config.load import load_config
from ccatp.config.models import WorldConfig
from ccatp.studies.campaign import Cell, CellResult, Column, Study
from ccatp.studies.figures import FigureRow, draw_ranges
from ccatp.studies.mission_study import combine_missions, run_mission

_BASES = ("none", "all")


def draw_sensitivity(cells: Sequence[CellResult], out: Path) -> None:
    """One figure for each mirror, the undisturbed and the fully disturbed world as lines."""
    worlds = list(dict.fromkeys(cell.factors["world"] for cell in cells))
    for mirror in dict.fromkeys(str(cell.factors["mirror"]) for cell in cells):
        there = [cell for cell in cells if cell.factors["mirror"] == mirror]
        rows = [FigureRow(_name(c), c, worlds.index(c.factors["world"]), c.factors["group"] in _BASES) for c in there]
        draw_ranges(rows, f"What each disturbance costs on {mirror}", out / f"sensitivity-{mirror}")


def _name(cell: CellResult) -> str:
    group = str(cell.factors["group"])
    return f"world {cell.factors['world']}" if group in _BASES else group


QUIET, HARD = "thesis", "hard"
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
SENSITIVITY_COLUMNS = (
    Column("complete", "complete"),
    Column("localization mean, mm", "localization_error_mm.mean", ".3f"),
    Column("p99", "localization_error_mm.p99", ".3f"),
    Column("max", "localization_error_mm.max", ".2f"),
    Column("heading rms, mrad", "heading_error_mrad.rms", ".3f"),
    Column("arrival mean, mm", "arrival_error_mm.mean", ".3f"),
    Column("p99", "arrival_error_mm.p99", ".3f"),
    Column("max", "arrival_error_mm.max", ".2f"),
    Column("stop error rms, mm", "stop_error_mm.rms", ".3f"),
    Column("NEES pose (3)", "nees.pose.mean", ".2f"),
    Column("corrections", "corrections"),
    Column("mission, s", "mission_time_s", ".0f"),
    Column("time / bound", "time_ratio", ".4f"),
    Column("false edges", "danger.false_edges"),
)


def sensitivity_cells() -> Sequence[Cell]:
    """The quiet world, each group added to it; the hard world, each group taken from it."""
    quiet, hard = (load_config(None, {"run.world": name}).world for name in (QUIET, HARD))
    found = [Cell({"world": QUIET, "group": "none"}, {"run.world": QUIET})]
    found += [_changed(QUIET, "plus", group, hard) for group in GROUPS]
    found += [Cell({"world": HARD, "group": "all"}, {"run.world": HARD})]
    found += [_changed(HARD, "minus", group, quiet) for group in GROUPS]
    return found


def _changed(base: str, sign: str, group: str, other: WorldConfig) -> Cell:
    values = {f"world.{key}": getattr(other, key) for key in GROUPS[group]}
    return Cell({"world": base, "group": f"{sign} {group}"}, {"run.world": base, **values})


SENSITIVITY = Study(
    name="sensitivity",
    title="What each disturbance costs",
    cells=sensitivity_cells,
    run_job=run_mission,
    combine=combine_missions,
    columns=SENSITIVITY_COLUMNS,
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
ABLATION_COLUMNS = (
    Column("complete", "complete"),
    Column("localization mean, mm", "localization_error_mm.mean", ".3f"),
    Column("p99", "localization_error_mm.p99", ".2f"),
    Column("max", "localization_error_mm.max", ".2f"),
    Column("arrival mean, mm", "arrival_error_mm.mean", ".3f"),
    Column("p99", "arrival_error_mm.p99", ".2f"),
    Column("max", "arrival_error_mm.max", ".2f"),
    Column("first arrivals within 10 mm", "arrival_error_mm.within_10mm_fraction", ".2%"),
    Column("stop error rms, mm", "stop_error_mm.rms", ".3f"),
    Column("heading rms, mrad", "heading_error_mrad.rms", ".2f"),
    Column("NEES pose (3)", "nees.pose.mean", ".2f"),
    Column("corrections", "corrections"),
    Column("mission, s", "mission_time_s", ".0f"),
    Column("time / bound", "time_ratio", ".4f"),
    Column("false edges", "danger.false_edges"),
    Column("ended by", "causes"),
)


def ablation_cells() -> Sequence[Cell]:
    """Worlds times what is switched off."""
    return [
        Cell({"world": world, "without": name}, {"run.world": world, **keys})
        for world in WORLDS
        for name, keys in WITHOUT.items()
    ]


def draw(results: Sequence[CellResult], out: Path) -> None:
    """Figures ``ablation-<mirror>-<world>``, the mission with everything as a line."""
    for mirror, world in dict.fromkeys((str(c.factors["mirror"]), str(c.factors["world"])) for c in results):
        there = [c for c in results if (c.factors["mirror"], c.factors["world"]) == (mirror, world)]
        rows = [FigureRow(_label(c), c, WORLDS.index(world), c.factors["without"] == ALL_ON) for c in there]
        draw_ranges(rows, f"Without a technique, world {world} on {mirror}", out / f"ablation-{mirror}-{world}")


def _label(cell: CellResult) -> str:
    name = str(cell.factors["without"])
    return "with all" if name == ALL_ON else f"without {name}"


ABLATION = Study(
    name="ablation",
    title="What each technique gives: one switched off at a time",
    cells=ablation_cells,
    run_job=run_mission,
    combine=combine_missions,
    columns=ABLATION_COLUMNS,
    draw=draw,
    defaults={"run.filter": "ekf"},
    runs=3,
)
