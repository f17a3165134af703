"""Cells, jobs, shards and choices."""

import pickle
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest

from ccatp.config.load import load_config
from ccatp.config.models import Config
from ccatp.studies.campaign import (
    CampaignError,
    Cell,
    CellResult,
    Factors,
    Job,
    JobOutcome,
    Shard,
    Study,
    cells_of,
    jobs_of,
    parse_choice,
    parse_shard,
    plain,
    with_seed,
)


def run_job(job: Job) -> JobOutcome:
    return JobOutcome({"seed": job.seed})


def combine(factors: Factors, outcomes: Sequence[JobOutcome]) -> JobOutcome:
    return JobOutcome({"level": factors["speed"], "sum": sum(outcome.values["seed"] for outcome in outcomes)})


def draw(cells: Sequence[CellResult], out: Path) -> None:
    (out / "figure.png").write_text(str(len(cells)))


def a_study(mirrors: tuple[str, ...] = ("thesis-m1",)) -> Study:
    return Study(
        name="trial",
        title="A trial",
        cells=lambda: [Cell({"speed": v}, {"limits.v_max_m_s": v}) for v in (0.05, 0.1)],
        run_job=run_job,
        combine=combine,
        columns=(),
        draw=draw,
        defaults={"run.filter": "ekf", "run.panels": 2},
        mirrors=mirrors,
        runs=3,
    )


def load(keys: Mapping[str, object]) -> Config:
    return load_config(None, keys)


def test_cells_are_crossed_with_the_mirrors() -> None:
    cells = cells_of(a_study(), ["fyst-m1", "fyst-m2"])
    assert [dict(cell.factors) for cell in cells] == [
        {"mirror": "fyst-m1", "speed": 0.05},
        {"mirror": "fyst-m1", "speed": 0.1},
        {"mirror": "fyst-m2", "speed": 0.05},
        {"mirror": "fyst-m2", "speed": 0.1},
    ]
    assert cells[3].overrides == {"run.mirror": "fyst-m2", "limits.v_max_m_s": 0.1}


def test_a_study_may_choose_its_mirrors_itself() -> None:
    assert [dict(cell.factors) for cell in cells_of(a_study(()))] == [{"speed": 0.05}, {"speed": 0.1}]
    with pytest.raises(CampaignError, match="study trial chooses its mirrors itself; leave --mirror out"):
        cells_of(a_study(()), ["fyst-m1"])


def test_levels_are_chosen_by_factor() -> None:
    assert [cell.factors["speed"] for cell in cells_of(a_study(), only={"speed": ("0.1",)})] == [0.1]


@pytest.mark.parametrize(
    ("only", "message"),
    [
        ({"sped": ("0.1",)}, "--only sped: is no factor of study trial; there are mirror, speed"),
        ({"speed": ("0.3",)}, r"--only speed=0.3: study trial has no such level; there are 0.05, 0.1"),
    ],
)
def test_a_choice_that_does_not_exist_is_refused(only: dict[str, tuple[str, ...]], message: str) -> None:
    with pytest.raises(CampaignError, match=message):
        cells_of(a_study(), only=only)


def test_a_job_holds_all_that_it_depends_on() -> None:
    plan = jobs_of(a_study(), cells_of(a_study()), load, {"run.panels": 1, "run.seed": 7}, 2)
    assert [[job.key for job in group] for group in plan] == [
        [f"mirror=thesis-m1,speed={v},seed={seed}" for seed in (7, 8)] for v in (0.05, 0.1)
    ]
    job = plan[1][1]
    assert (job.cfg.run.seed, job.cfg.run.filter, job.cfg.run.panels, job.cfg.limits.v_max_m_s) == (8, "ekf", 1, 0.1)
    assert job.cfg.mirror.name == "thesis-m1"
    again = pickle.loads(pickle.dumps(job))
    assert again == job
    assert again.fingerprint == job.fingerprint


def test_every_key_of_the_configuration_is_in_the_fingerprint() -> None:
    job = Job("trial", {"speed": 0.1}, 1, load({}))
    others = [
        Job("other", job.factors, 1, job.cfg),
        Job("trial", {"speed": 0.2}, 1, job.cfg),
        Job("trial", job.factors, 2, job.cfg),
        Job("trial", job.factors, 1, load({"mission.backoff_m": 0.04})),
        Job("trial", job.factors, 1, with_seed(job.cfg, 2)),
    ]
    assert len({job.fingerprint, *(other.fingerprint for other in others)}) == 6


def test_a_setting_that_is_a_factor_is_refused() -> None:
    study = a_study()
    with pytest.raises(CampaignError, match=r"limits\.v_max_m_s is set by study trial itself; leave it out, or"):
        jobs_of(study, cells_of(study), load, {"limits.v_max_m_s": 0.2}, 1)


def test_a_campaign_without_runs_is_refused() -> None:
    with pytest.raises(CampaignError, match="--runs 0: must be at least 1"):
        jobs_of(a_study(), [], load, {}, 0)


def test_a_shard_is_a_number_of_so_many() -> None:
    assert parse_shard("2/4") == Shard(2, 4)


@pytest.mark.parametrize("text", ["0/4", "5/4", "1", "a/b", "1/", "-1/4", "1/4/2"])
def test_what_is_no_shard_is_refused(text: str) -> None:
    with pytest.raises(CampaignError, match=f"--shard {text}: is not i/n with 1 <= i <= n"):
        parse_shard(text)


def test_a_choice_is_a_factor_and_its_levels() -> None:
    assert parse_choice("world=hard, extreme") == ("world", ("hard", "extreme"))


@pytest.mark.parametrize("text", ["world", "=hard", "world=", "world=,"])
def test_what_is_no_choice_is_refused(text: str) -> None:
    with pytest.raises(CampaignError, match="is not factor=level"):
        parse_choice(text)


def test_values_are_made_what_json_can_say() -> None:
    given = {"a": np.float64(1.5), "b": [np.int64(2), float("nan")], "c": np.array([np.inf]), "d": (True, None, "x")}
    assert plain(given) == {"a": 1.5, "b": [2, None], "c": [None], "d": [True, None, "x"]}
