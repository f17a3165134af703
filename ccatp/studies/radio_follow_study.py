"""Pure. The study `radio-follow`: a moving radio is mapped and followed, side by side with Auth and Hovey 2018."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ccatp.studies.campaign import Cell, CellResult, Column, Factors, Outcome, Study
from ccatp.studies.radio_cell import COLUMNS, TARGET_COLUMNS, combine, run_job
from ccatp.studies.radio_figures import draw_errors

# Figures 3.2 to 3.5 of 2018, as its text sums them up.
PRINTED: dict[str, dict[str, str]] = {
    "ideal": {"target_m": "0.20", "beacons_m": "0.20 to 0.30"},
    "restrictive": {"target_m": "about 0.35", "beacons_m": "0.20 to 0.30"},
}
CASES = {"ideal": 1, "restrictive": 30}
SHADOW: dict[str, object] = {
    "sim.radio.shadowing_sigma_db": 5.0,
    "path_loss.shadowing_sigma_db": 5.0,
    "estimator.shadowing": "map",
}
CONDITIONS: dict[str, dict[str, object]] = {
    "as printed": {},
    "target stays": {"sim.target.speed_m_s": 0.0},
    "PI speed": {"control.speed_mode": "pi"},
    "constant speed": {"control.speed_mode": "constant"},
    "obstacle in the waves": {
        "sim.radio.obstacle_loss_db": 6.0,
        "path_loss.shadowing_sigma_db": 3.0,
        "path_loss.shadowing_length_m": 0.5,
        "estimator.shadowing": "map",
    },
    "shadowing 5 dB": SHADOW,
}


def cells() -> Sequence[Cell]:
    """How often the target is heard, times conditions."""
    return [
        Cell({"case": case, "condition": condition}, {**keys, "observation.target_every_steps": every})
        for condition, keys in CONDITIONS.items()
        for case, every in CASES.items()
    ]


def combine_beside(factors: Factors, outcomes: Sequence[Outcome]) -> Outcome:
    """The runs pooled, and what 2018 prints."""
    values, arrays = combine(factors, outcomes)
    is_printed = factors["condition"] == "as printed"
    printed: dict[str, Any] = dict(PRINTED[str(factors["case"])]) if is_printed else {}
    return Outcome({**values, "printed": printed}, arrays)


def draw(results: Sequence[CellResult], out: Path) -> None:
    """Figures ``radio_follow_target`` and ``radio_follow_beacons``: errors over time."""
    keys = ("case", "condition")
    draw_errors(results, "target_m", "error of the target, m", keys, out / "radio_follow_target")
    draw_errors(results, "beacons_m", "error of the beacons, m", keys, out / "radio_follow_beacons")


STUDY = Study(
    name="radio-follow",
    title="A moving radio followed",
    cells=cells,
    run_job=run_job,
    combine=combine_beside,
    columns=(
        Column("2018: target, m", "printed.target_m"),
        *TARGET_COLUMNS,
        Column("2018: beacons, m", "printed.beacons_m"),
        *COLUMNS,
    ),
    draw=draw,
    defaults={"system": "follow"},
    mirrors=(),
    runs=50,
    is_radio=True,
)
