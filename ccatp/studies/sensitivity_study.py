"""Glue. The study `sensitivity`: what each disturbance of the world `hard` costs, alone, and what its absence saves."""

from collections.abc import Sequence

from ccatp.config.loader import load_config
from ccatp.config.models import WorldConfig
from ccatp.studies.campaign import Cell, Column, Study
from ccatp.studies.mission_cell import combine_missions
from ccatp.studies.mission_job import run_mission
from ccatp.studies.sensitivity_figures import draw_sensitivity

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
COLUMNS = (
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


def cells() -> Sequence[Cell]:
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


STUDY = Study(
    name="sensitivity",
    title="What each disturbance costs",
    cells=cells,
    run_job=run_mission,
    combine=combine_missions,
    columns=COLUMNS,
    draw=draw_sensitivity,
    defaults={"run.filter": "ekf"},
    runs=5,
)
