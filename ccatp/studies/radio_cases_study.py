"""Pure. The study `radio-cases`: the three experimental cases of Hevrdejs and Knoll 2017, side by side with ours.

The slides print the errors of three drives in a laboratory and nothing of the drives. Ours are three paths in the same
room, among the same radios with 5 dB of static shadowing and reflected rays, read through the turning reflector.
"""

from collections.abc import Sequence
from pathlib import Path

from ccatp.studies.campaign import Cell, CellResult, Column, Factors, Outcome, Study
from ccatp.studies.radio_cell import COLUMNS, combine, run_job
from ccatp.studies.radio_figures import draw_cases

# RMSE, RMSE of the heading, RMSE of the beacons 1 to 4: table of the slide "Discussion".
PRINTED = {
    "I": (0.04, 0.03, 0.28, 0.67, 0.39, 0.53),
    "II": (0.05, 0.04, 1.03, 0.88, 0.53, 0.33),
    "III": (0.06, 0.04, 0.41, 0.36, 0.34, 0.66),
}
PATHS: dict[str, list[list[float]]] = {
    "I": [[0.8, 0.8], [2.2, 0.8], [2.2, 2.2], [0.8, 2.2]],
    "II": [[0.8, 0.8], [2.2, 2.2], [0.8, 2.2], [2.2, 0.8]],
    "III": [[2.2, 0.8], [1.5, 2.2], [0.8, 0.8]],
}
RADIO: dict[str, object] = {
    "sim.radio.scan": "reflector",
    "sim.radio.shadowing_sigma_db": 5.0,
    "sim.radio.multipath_paths": 3,
    "path_loss.shadowing_sigma_db": 5.0,
    "estimator.shadowing": "map",
}
NAMES = ("pose_m", "heading_rad", "beacon1", "beacon2", "beacon3", "beacon4")


def cells() -> Sequence[Cell]:
    """The three paths."""
    return [Cell({"case": case}, {**RADIO, "workspace.waypoints_m": path}) for case, path in PATHS.items()]


def combine_beside(factors: Factors, outcomes: Sequence[Outcome]) -> Outcome:
    """The runs pooled, and what 2017 prints."""
    values, arrays = combine(factors, outcomes)
    return Outcome({**values, "printed": dict(zip(NAMES, PRINTED[str(factors["case"])], strict=True))}, arrays)


def draw(results: Sequence[CellResult], out: Path) -> None:
    """Figure ``radio_cases``: printed and our errors of pose and beacons."""
    draw_cases(results, NAMES, out / "radio_cases")


def _columns() -> list[Column]:
    columns = [
        Column("2017: RMSE, m", "printed.pose_m", ".2f"),
        Column("ours", "pose_m", ".3f"),
        Column("2017: RMSE heading, rad", "printed.heading_rad", ".2f"),
        Column("ours", "heading_rad", ".3f"),
    ]
    for name in NAMES[2:]:
        columns += [
            Column(f"2017: {name}, m", f"printed.{name}", ".2f"),
            Column("ours", f"beacon_rmse_m.{name}", ".2f"),
        ]
    return columns + [column for column in COLUMNS if column.key not in {"pose_m", "heading_rad"}]


STUDY = Study(
    name="radio-cases",
    title="Cases I to III of 2017",
    cells=cells,
    run_job=run_job,
    combine=combine_beside,
    columns=_columns(),
    draw=draw,
    defaults={"system": "zigbee"},
    mirrors=(),
    runs=50,
    is_radio=True,
)
