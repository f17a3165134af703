"""Pure. The study `ablation`: what each technique of estimation and control gives, by switching it off alone."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from ccatp.studies.campaign import Cell, CellResult, Column, Study
from ccatp.studies.mission_cell import combine_missions
from ccatp.studies.mission_job import run_mission
from ccatp.studies.range_figures import Row, draw_ranges

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
COLUMNS = (
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


def cells() -> Sequence[Cell]:
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
        rows = [Row(_label(c), c, WORLDS.index(world), c.factors["without"] == ALL_ON) for c in there]
        draw_ranges(rows, f"Without a technique, world {world} on {mirror}", out / f"ablation-{mirror}-{world}")


def _label(cell: CellResult) -> str:
    name = str(cell.factors["without"])
    return "with all" if name == ALL_ON else f"without {name}"


STUDY = Study(
    name="ablation",
    title="What each technique gives: one switched off at a time",
    cells=cells,
    run_job=run_mission,
    combine=combine_missions,
    columns=COLUMNS,
    draw=draw,
    defaults={"run.filter": "ekf"},
    runs=3,
)
