"""Every study by its command, on one or two cells: its configurations, figures and files."""

import json
from pathlib import Path
from typing import Any

import pytest

from ccatp.cli import main
from ccatp.config import load as loaders
from ccatp.studies import STUDIES, find_study
from ccatp.studies.campaign import Study, cells_of, jobs_of
from ccatp.studies.results import columns_of

CAMPAIGNS = {name: study for name in STUDIES if isinstance(study := find_study(name), Study)}
ONE_PANEL = ("--panels", "1", "--set", "mission.calibration_length_m=0")  # a mission of a minute
RECORDINGS = Path(__file__).resolve().parents[3].parent / "shared" / "data" / "radio"
FEW_STEPS = ("--set", "run.steps=300")

# Choices of cells, further arguments, and the stems of all figures.
RUNS: dict[str, tuple[tuple[str, ...], tuple[str, ...], str]] = {
    "thesis": (
        ("noise=normal", "system=thesis", "noise_is_variance=True", "period_error=0.008"), ("--panels", "1"),
        "trajectory_normal localization_normal waypoints_normal",
    ),
    "filters": (
        ("world=thesis", "filter=ekf"), ONE_PANEL,
        "localization-thesis-m1 arrival-thesis-m1 bound-thesis-m1 consistency-thesis-m1",
    ),
    "time": (("order=thesis", "v_max_m_s=0.2", "measuring_time_s=0.5"), ONE_PANEL, "time-thesis-m1"),
    "sensitivity": (("group=none",), ONE_PANEL, "sensitivity-thesis-m1"),
    "ablation": (("world=hard", "without=nothing"), ONE_PANEL, "ablation-thesis-m1-hard"),
    "danger": (
        ("speed_m_s=0.2", "crossing=0,turn"), ("--mirror", "thesis-m1"),
        "danger_false_edges_thesis-m1 danger_overrun_thesis-m1",
    ),
    "faults": (("faults=random",), ("--mirror", "thesis-m1", *ONE_PANEL), "faults"),
    "physics": (("mirror=fyst-m1", "tyre=round", "friction=1.0", "margin=3.0"), ONE_PANEL, "physics-fyst-m1-3"),
    "cricket": (("case=zigzag-printed,all-printed,batch-45-once",), (), "figure_11_12 figure_14 figure_9_10_13 ways"),
    "recordings": (
        ("data=Plaza2,XBee scenario 1", "estimator=ekf-slam,fingerprints"), ("--data", str(RECORDINGS)), "recordings",
    ),
    "damage": (("damage=5 % ranges of 0 m",), ("--data", str(RECORDINGS)), ""),
    "mote-navigation": ((), ("--set", "mission.laps=1"), "mote_navigation"),
    "radio-signals": (("condition=white 2 dB",), (), "radio_signals"),
    "radio-slam": (("room=3 m", "condition=white", "every=30"), FEW_STEPS, "radio_slam"),
    "radio-cases": (("case=I",), FEW_STEPS, "radio_cases"),
    "radio-follow": (
        ("case=ideal", "condition=as printed"), FEW_STEPS, "radio_follow_target radio_follow_beacons",
    ),
}  # fmt: skip


def has(cell: Any, key: str) -> bool:
    for part in key.split("."):
        if part not in cell:
            return False
        cell = cell[part]
    return True


@pytest.mark.parametrize("name", CAMPAIGNS)
def test_a_study_writes_its_figures_and_all_that_its_table_shows(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    only, args, stems = RUNS[name]
    if str(RECORDINGS) in args and not RECORDINGS.is_dir():
        pytest.skip(f"no recorded data at {RECORDINGS}")
    chosen = [word for choice in only for word in ("--only", choice)]
    line = ["study", name, "--runs", "1", "--workers", "1", "--out", str(tmp_path), "--json", *chosen, *args]
    assert main(line) == 0
    cells = json.loads(capsys.readouterr().out)["cells"]
    assert all(cell["runs"] == 1 for cell in cells)
    assert all(cell.get("complete", 1) == 1 for cell in cells)
    for key in columns_of(CAMPAIGNS[name].columns):
        assert any(has(cell, key) for cell in cells), key
    figures = {path.name for path in tmp_path.iterdir() if path.suffix in {".png", ".pdf"}}
    assert figures == {f"{stem}{suffix}" for stem in stems.split() for suffix in (".png", ".pdf")}
    assert len((tmp_path / "table.md").read_text().splitlines()) == 4 + len(cells)


@pytest.mark.parametrize("name", CAMPAIGNS)
def test_cells_are_configurations_of_their_own(name: str) -> None:
    study = CAMPAIGNS[name]
    cells = cells_of(study)
    load = getattr(loaders, study.loader)
    plan = jobs_of(study, cells, lambda keys: load(None, keys), {}, 1)
    configurations = [group[0].cfg.model_dump_json() for group in plan]
    if name not in {
        "cricket",
        "danger",
        "radio-signals",
        "faults",
        "recordings",
        "damage",
    }:  # their jobs look at the factors
        assert len(set(configurations)) == len(configurations)
    assert len({str(cell.factors) for cell in cells}) == len(cells)
