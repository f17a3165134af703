"""The studies with real physics.

`physics`: whole missions by tyre, friction and thrust. `stops`: drives over the rim, and stops by command. `slides`:
friction that falls while the robot drives.
"""

from collections.abc import Sequence
from itertools import product
from pathlib import Path

from ccatp.config.load import load_config
from ccatp.control.thrust import forecast_grip
from ccatp.mirror.mirror import build_mirror
from ccatp.studies.campaign import Cell, CellResult, Study
from ccatp.studies.mission_study import combine_missions, run_mission
from ccatp.studies.results import draw_ranges, grouped, rows_by
from ccatp.studies.survey_studies import MISSION, SHOWN

# -- whole missions ---------------------------------------------------------------------------------------------------

MIRRORS = "fyst-m1", "fyst-m2"
TYRES_M = {"round": 0.002, "flat": 0.0075}  # levers at which they rub: the creep of turns at a known friction


def robot_keys(mirror: str, tyre: str, friction: float, margin: float | None) -> dict[str, object]:
    """Of the configuration, for the robot and for its physics; without a margin the thrust is the configured one."""
    keys: dict[str, object] = {"run.mirror": mirror, "sim.physics.tyre": tyre, "robot.tyre_m": TYRES_M[tyre]}
    cfg = load_config(None, {"run.mirror": mirror, "robot.friction": friction})
    thrust_n = cfg.robot.thrust_n
    if margin is not None:
        thrust_n = round(margin * forecast_grip(cfg.robot, build_mirror(cfg.mirror)).least_n, 2)
    for place in ("robot", "sim.physics"):
        keys |= {f"{place}.friction": friction, f"{place}.thrust_n": thrust_n}
    return keys


def physics_cells() -> Sequence[Cell]:
    """Mirror, tyre, friction, and the thrust at full duty over the least that holds the robot anywhere on the mirror.

    The robot's configuration has the same friction and thrust: what its builder knows.
    """
    found = []
    for name, tyre, friction, margin in product(MIRRORS, TYRES_M, (0.5, 0.6, 0.8, 1.0), (1.1, 1.3, 2.0, 3.0)):
        keys = robot_keys(name, tyre, friction, margin)
        found.append(Cell({"mirror": name, "tyre": tyre, "friction": friction, "margin": margin}, keys))
    return found


def draw_physics(cells: Sequence[CellResult], out: Path) -> None:
    """Errors and time, a figure for each mirror and thrust."""
    for (mirror, margin), there in grouped(cells, "mirror", "margin").items():
        rows = rows_by(there, "tyre", "friction")
        title = f"{mirror}, {margin} times the least thrust, by friction: {SHOWN}"
        draw_ranges(rows, MISSION, title, out / f"physics-{mirror}-{margin}")


PHYSICS = Study(
    cells=physics_cells,
    run_job=run_mission,
    combine=combine_missions,
    columns="""
        complete points.measured
        danger: falls
        localization_error_mm: mean p99 max
        arrival_error_mm: mean max within_10mm_fraction
        corrections mission_time_s time_ratio
    """,
    draw=draw_physics,
    defaults={"sim.robot.physics": "mujoco", "run.panels": 9},
    mirrors=(),
    runs=1,
)
