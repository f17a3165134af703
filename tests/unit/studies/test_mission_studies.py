"""The studies of whole missions: their cells, the figures of a cell, what they draw."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from ccatp.config.load import load_config
from ccatp.studies import filters_study, time_study
from ccatp.studies.campaign import CampaignError, CellResult, Job, Study, cells_of, jobs_of, plain
from ccatp.studies.engine import CampaignOptions, run_campaign
from ccatp.studies.factor_studies import ABLATION, GROUPS, SENSITIVITY, sensitivity_cells
from ccatp.studies.job_store import table
from ccatp.studies.registry import STUDIES, find_study
from tests.unit.studies.missions import mission

CAMPAIGNS = (filters_study.STUDY, time_study.STUDY, SENSITIVITY, ABLATION)


def results_of(study: Study) -> list[CellResult]:
    """Cells of two made-up missions each."""
    found = []
    for k, cell in enumerate(cells_of(study)):
        scale = 1e-3 * (1 + k % 5)
        runs = [mission([scale, 2 * scale], cause="wind"), mission([3 * scale, scale])]
        values, arrays = study.combine(cell.factors, runs)
        found.append(CellResult(cell.factors, {"runs": 2, **values}, arrays))
    return found


@pytest.mark.parametrize("study", CAMPAIGNS)
def test_every_cell_is_a_configuration_of_its_own(study: Study) -> None:
    plan = jobs_of(study, cells_of(study), lambda keys: load_config(None, keys), {}, 1)
    configurations = [group[0].cfg.model_dump_json() for group in plan]
    assert len(set(configurations)) == len(configurations) > 1


@pytest.mark.parametrize(
    ("study", "stems"),
    [
        (
            filters_study.STUDY,
            {"localization-thesis-m1", "arrival-thesis-m1", "bound-thesis-m1", "consistency-thesis-m1"},
        ),
        (time_study.STUDY, {"time-thesis-m1"}),
        (SENSITIVITY, {"sensitivity-thesis-m1"}),
        (ABLATION, {"ablation-thesis-m1-thesis", "ablation-thesis-m1-hard"}),
    ],
)
def test_figures_and_table_show_every_cell(study: Study, stems: set[str], tmp_path: Path) -> None:
    results = results_of(study)
    study.draw(results, tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {f"{stem}.{kind}" for stem in stems for kind in ("png", "pdf")}
    lines = table([plain({**cell.factors, **cell.values}) for cell in results], study.columns).splitlines()
    assert len(lines) == 2 + len(results)
    # Every column finds its figure.
    shown = [line.split(" | ") for line in lines[2:]]
    assert not any(all(row[k] == "-" for row in shown) for k in range(len(shown[0])))


def test_stop_errors_stand_beside_the_bound_without_each_first_stop() -> None:
    values, arrays = filters_study.combine({}, [mission([0.1, 0.003]), mission([0.1, 0.004])])
    assert values["bound"]["rms_mm"] == pytest.approx(2.0 * 2.0**0.5, abs=1e-3)
    assert values["bound"]["error_rms_mm"] == pytest.approx(12.5**0.5, abs=1e-3)
    assert values["bound"]["ratio"] == pytest.approx((12.5 / 8.0) ** 0.5, abs=1e-3)
    assert values["bound"]["with_accelerometer"]["ratio"] == pytest.approx((12.5 / 2.0) ** 0.5, abs=1e-3)
    assert arrays["bounds"].shape == (2, 5)
    alone, _ = filters_study.combine({}, [mission([0.1])])
    assert alone["bound"]["ratio"] is None
    assert alone["bound"]["error_rms_mm"] is None


def test_the_margin_is_that_of_the_slowest_mission() -> None:
    values, _ = time_study.combine({}, [mission([0.001]), mission([0.001], mission_time_s=130.0)])
    assert values["margin_s"] == 3600.0 - 130.0
    assert values["tour_ratio"] == pytest.approx(120.0 / 90.0, abs=1e-4)
    held, _ = time_study.combine({}, [mission([0.001], outcome="held")])
    assert (held["margin_s"], held["tour_ratio"]) == (None, None)


def test_each_group_of_disturbances_is_added_and_taken_away() -> None:
    cells = {str(cell.factors["group"]): cell for cell in sensitivity_cells()}
    hard = load_config(None, {"run.world": "hard"}).world
    slip = load_config(None, cells["plus slip"].overrides).world
    assert (slip.slip_max, slip.creep_fraction) == (hard.slip_max, 0.0)
    rest = load_config(None, cells["minus slip"].overrides).world
    assert (rest.slip_max, rest.creep_fraction) == (0.0, hard.creep_fraction)


def test_everything_that_is_disturbed_belongs_to_a_group() -> None:
    """With all groups added, the quiet world is the hard one but for its name."""
    quiet, hard = (load_config(None, {"run.world": name}).world.model_dump() for name in ("thesis", "hard"))
    differing = {key for key in quiet if quiet[key] != hard[key]} - {"name"}
    assert differing <= {key for group in GROUPS.values() for key in group}


FACTORS: Mapping[str, Mapping[str, Any]] = {
    "filters": {"world": ("thesis",), "filter": ("ekf",)},
    "time": {"order": ("optimised",), "v_max_m_s": ("0.2",), "measuring_time_s": ("0.5",)},
}


@pytest.mark.parametrize("name", FACTORS)
def test_a_real_job_has_every_figure(name: str, tmp_path: Path) -> None:
    study = find_study(name)
    settings = {"run.panels": 1, **({"run.filter": "ekf"} if name == "time" else {})}
    options = CampaignOptions(tmp_path, runs=1, workers=1, only=FACTORS[name], settings=settings, is_quiet=True)
    result = run_campaign(study, lambda keys: load_config(None, keys), options)  # type: ignore[arg-type]
    (cell,) = result["cells"]
    assert (cell["complete"], cell["points"]["measured"]) == (1, 9)
    assert cell["time_ratio"] > 1.0
    line = (tmp_path / "table.md").read_text().splitlines()[-1]
    assert " - " not in line


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("filter", "did you mean filters"),
        ("zzz", "there are thesis, filters, time, sensitivity, ablation, danger, faults, cricket, mote-sizes"),
    ],
)
def test_an_unknown_study_is_answered_with_the_nearest(name: str, hint: str) -> None:
    with pytest.raises(CampaignError, match=f"no study '{name}'; {hint}"):
        find_study(name)


def test_every_row_of_the_registry_leads_to_a_study() -> None:
    for name in STUDIES:
        found = find_study(name)
        assert getattr(found, "name", name) == name


def test_a_job_has_a_name_that_tells_it_apart() -> None:
    job = Job("filters", {"world": "hard", "filter": "ekf"}, 3, load_config(None, {}))
    assert (job.cell, job.key) == ("world=hard,filter=ekf", "world=hard,filter=ekf,seed=3")
