"""Cells, jobs, shards and choices."""

import json
import pickle
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ccatp.config.load import load_config
from ccatp.config.models import Config
from ccatp.studies.campaign import (
    LEAST,
    CampaignError,
    CampaignFailed,
    CampaignInterrupted,
    Cell,
    CellResult,
    ClusterUnreachable,
    Column,
    Factors,
    Histogram,
    Job,
    JobOutcome,
    Schedule,
    Shard,
    Study,
    cells_of,
    jobs_of,
    parse_choice,
    parse_shard,
    plain,
    pooled,
    with_seed,
)
from ccatp.studies.engine import FAILURES, CampaignOptions, run_campaign
from ccatp.studies.job_store import JobStore, table, time_left
from tests.unit.studies.toy import FAULTS, STUDY
from tests.unit.studies.toy import load as engine_load
from tests.unit.studies.toy import load as ledger_load
from tests.unit.studies.toy import load as schedule_load


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


SLOW, FAST = "speed_m_s=0.05", "speed_m_s=0.1"


@pytest.fixture(scope="module")
def jobs() -> list[Job]:
    return [job for group in jobs_of(STUDY, cells_of(STUDY), schedule_load, {}, 3) for job in group]


def test_each_cell_is_tried_then_the_longest_comes_first(jobs: list[Job]) -> None:
    schedule = Schedule(jobs, {})
    taken = [schedule.take(), schedule.take()]
    assert [job.key for job in taken] == [f"{SLOW},seed=1", f"{FAST},seed=1"]
    schedule.done(taken[1], 9.0)  # it was not so fast
    schedule.done(taken[0], 2.0)
    assert [schedule.take().key for _ in range(4)] == [
        f"{FAST},seed=2", f"{FAST},seed=3", f"{SLOW},seed=2", f"{SLOW},seed=3",
    ]  # fmt: skip
    assert not schedule
    with pytest.raises(IndexError, match="all jobs are handed out"):
        schedule.take()


def test_what_is_known_from_before_counts(jobs: list[Job]) -> None:
    schedule = Schedule(jobs, {FAST: [1.0], SLOW: [3.0, 5.0]})
    assert schedule.left_s == pytest.approx(3 * 1.0 + 3 * 4.0)
    assert [schedule.take().cell for _ in range(4)] == [SLOW, SLOW, SLOW, FAST]


def test_the_time_left_is_that_of_jobs_not_yet_back(jobs: list[Job]) -> None:
    schedule = Schedule(jobs, {})
    assert schedule.left_s == 0.0  # nothing is known
    first, second = schedule.take(), schedule.take()
    schedule.done(first, 2.0)
    assert schedule.left_s == pytest.approx(5 * 2.0)  # of the other cell nothing is known
    schedule.done(second, 4.0)
    assert (schedule.done_s, schedule.left_s) == pytest.approx((6.0, 2 * 2.0 + 2 * 4.0))


BIN = 0.0012  # half a bin, 1/2000 of a decade, is 0.115 %


def errors(seed: int, count: int) -> np.ndarray:
    return np.random.default_rng(seed).lognormal(-7.0, 1.0, count)


@pytest.mark.parametrize("share", [0.01, 0.5, 0.99, 0.999])
def test_quantiles_are_those_of_the_numbers(share: float) -> None:
    values = errors(1, 20_001)
    # Beside the bin there is the step to the next number, which in the tail of so many is 1 % at most.
    assert Histogram.of(values, 0.01).quantile(share) == pytest.approx(np.quantile(values, share), rel=BIN + 0.01)


def test_a_quantile_is_right_to_half_a_bin() -> None:
    values = np.full(7, 0.0123)
    assert Histogram.of(np.append(values, 1.0), 0.01).quantile(0.5) == pytest.approx(0.0123, rel=BIN)


def test_count_mean_maximum_and_share_within_are_exact() -> None:
    values = np.append(errors(2, 999), 0.01)  # one exactly at the limit
    spread = Histogram.of(values, 0.01)
    assert spread.count == 1000
    assert spread.mean == pytest.approx(values.mean(), rel=1e-12)  # the order of summing
    assert spread.largest == values.max()
    assert spread.within == np.count_nonzero(values <= 0.01)


def test_no_quantile_exceeds_the_maximum() -> None:
    values = np.array([0.00100001])
    assert Histogram.of(values, 0.01).quantile(1.0) == values[0]


def test_spreads_pooled_are_the_spread_of_all() -> None:
    parts = [errors(3, 500), errors(4, 30), np.empty(0)]
    one, whole = pooled([Histogram.of(part, 0.01) for part in parts]), Histogram.of(np.concatenate(parts), 0.01)
    assert np.array_equal(one.bins, whole.bins)
    assert np.array_equal(one.counts, whole.counts)
    assert (one.largest, one.within) == (whole.largest, whole.within)
    assert one.total == pytest.approx(whole.total, rel=1e-12)  # the order of summing


def test_a_spread_comes_back_from_its_arrays() -> None:
    spread = Histogram.of(errors(5, 100), 0.01)
    again = Histogram.from_arrays(spread.to_arrays("x"), "x")
    assert np.array_equal(again.bins, spread.bins)
    assert np.array_equal(again.counts, spread.counts)
    assert (again.total, again.largest, again.within) == (spread.total, spread.largest, spread.within)


def test_the_exceedance_falls_to_nothing() -> None:
    values, share = Histogram.of(errors(6, 1000), 0.01).exceedance()
    assert (np.diff(values) > 0.0).all()
    assert (np.diff(share) < 0.0).all()
    assert share[-1] == 0.0


def test_nothing_has_no_quantile_and_no_mean() -> None:
    empty = Histogram.of(np.empty(0), 0.01)
    assert empty.count == 0
    assert np.isnan([empty.quantile(0.5), empty.mean]).all()
    assert pooled([]).count == 0


def test_what_is_smaller_than_the_first_bin_counts_there() -> None:
    assert Histogram.of(np.array([0.0, LEAST / 2.0]), 0.01).bins.tolist() == [0]


@pytest.mark.parametrize("value", [-1e-6, np.nan, np.inf])
def test_errors_are_finite_and_not_negative(value: float) -> None:
    with pytest.raises(ValueError, match="must be finite and not negative"):
        Histogram.of(np.array([0.1, value]), 0.01)


CELLS = [
    {"speed_m_s": 0.05, "runs": 3, "mean": pytest.approx(0.1), "speed": 0.05},
    {"speed_m_s": 0.1, "runs": 3, "mean": pytest.approx(0.2), "speed": 0.1},
]


def campaign(out: Path, **options: Any) -> dict[str, Any]:
    return run_campaign(STUDY, engine_load, CampaignOptions(out, **{"workers": 1, "is_quiet": True, **options}))


def jobs_done(out: Path) -> int:
    return sum(len(path.read_bytes().splitlines()) for path in out.glob("jobs*.jsonl"))


def test_a_campaign_writes_all_its_files(tmp_path: Path) -> None:
    result = campaign(tmp_path, settings={"run.panels": 1})
    assert result["study"] == "toy"
    assert result["cells"] == CELLS
    assert result["settings"] == {"run.panels": 1}
    assert json.loads((tmp_path / "result.json").read_text()) == result
    with np.load(tmp_path / "result.npz") as arrays:
        assert arrays["1/values"].tolist() == pytest.approx([0.1, 0.2, 0.3])
    assert (tmp_path / "table.md").read_text().splitlines()[2:] == [
        "| speed_m_s | runs | mean |",
        "|---|---|---|",
        "| 0.05 | 3 | 0.10 |",
        "| 0.1 | 3 | 0.20 |",
    ]
    assert (tmp_path / "figure.txt").read_text() == "2"


def test_workers_give_the_same_cells(tmp_path: Path) -> None:
    assert campaign(tmp_path, workers=2)["cells"] == CELLS
    assert jobs_done(tmp_path) == 6


def test_without_figures_nothing_is_drawn(tmp_path: Path) -> None:
    campaign(tmp_path, with_figures=False)
    assert not (tmp_path / "figure.txt").exists()


def test_what_is_done_is_not_done_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    campaign(tmp_path, runs=2)
    monkeypatch.setenv(FAULTS, "speed_m_s=0.05,seed=1:raise")
    assert campaign(tmp_path)["cells"] == CELLS
    assert jobs_done(tmp_path) == 6


def test_shards_are_put_together(tmp_path: Path) -> None:
    first = campaign(tmp_path, shard=Shard(1, 2))
    assert first["missing"] == 3
    assert [cell["runs"] for cell in first["cells"]] == [2, 1]
    assert "missing" not in campaign(tmp_path, shard=Shard(2, 2))
    result = campaign(tmp_path, with_figures=False)
    assert result["cells"] == CELLS
    assert (tmp_path / "jobs.jsonl").read_bytes() == b""


def test_shards_of_other_directories_are_taken_over(tmp_path: Path) -> None:
    for number in (1, 2):
        campaign(tmp_path / str(number), shard=Shard(number, 2))
    result = campaign(tmp_path / "whole", others=(tmp_path / "1", tmp_path / "2"))
    assert result["cells"] == CELLS
    assert (tmp_path / "whole/jobs.jsonl").read_bytes() == b""


def test_another_configuration_is_refused(tmp_path: Path) -> None:
    campaign(tmp_path)
    with pytest.raises(CampaignError, match=r"jobs.jsonl: job speed_m_s=0.05,seed=1 was done with another config"):
        campaign(tmp_path, settings={"run.panels": 2})


def test_one_failure_does_not_stop_the_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(FAULTS, "speed_m_s=0.05,seed=1:raise")
    with pytest.raises(
        CampaignFailed, match=r"1 of 6 jobs failed, the first: speed_m_s=0.05,seed=1: ArithmeticError: the wheel came"
    ):
        campaign(tmp_path)
    assert jobs_done(tmp_path) == 5
    assert "in _go_wrong" in (tmp_path / FAILURES).read_text()
    assert json.loads((tmp_path / "result.json").read_text())["missing"] == 1
    monkeypatch.delenv(FAULTS)
    assert campaign(tmp_path)["cells"] == CELLS


def test_failure_after_failure_ends_the_campaign(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    keys = [f"speed_m_s={v},seed={seed}" for v in (0.05, 0.1) for seed in (1, 2, 3)]
    monkeypatch.setenv(FAULTS, ";".join(f"{key}:raise" for key in keys))
    with pytest.raises(CampaignFailed, match=r"5 jobs failed, the last: .*the wheel came off; see .*failures.txt"):
        campaign(tmp_path)
    assert not (tmp_path / "result.json").exists()


def test_an_interruption_keeps_what_is_done(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(FAULTS, "speed_m_s=0.1,seed=3:interrupt")
    with pytest.raises(CampaignInterrupted, match=f"interrupted; what is done is kept in {tmp_path}: the same comm"):
        campaign(tmp_path)
    # One job of each of the two cells goes first; how many of the other four follow depends on what took how long.
    assert 2 <= jobs_done(tmp_path) <= 5
    assert CampaignInterrupted("").exit_status == 130


def test_a_worker_that_dies_ends_the_campaign(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(FAULTS, "speed_m_s=0.1,seed=3:die")
    with pytest.raises(CampaignFailed, match=r"a worker died, perhaps for want of memory; what is done is kept in"):
        campaign(tmp_path, workers=2)


@pytest.mark.parametrize("out", ["file/out", "file"])
def test_a_directory_that_cannot_be_written_is_one_line(tmp_path: Path, out: str) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(CampaignError, match=r"file.*: (Not a directory|File exists); choose another --out") as refused:
        campaign(tmp_path / out)
    assert refused.value.exit_status == 2


def test_a_cluster_that_does_not_answer_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ccatp.studies.engine._CLUSTER_TIMEOUT_S", 0.2)
    with pytest.raises(ClusterUnreachable, match=r"--cluster tcp://127.0.0.1:9: no scheduler answers there"):
        campaign(tmp_path, cluster="tcp://127.0.0.1:9")


@pytest.fixture(scope="module")
def ledger_jobs() -> list[Job]:
    return jobs_of(STUDY, cells_of(STUDY), ledger_load, {}, 3)[0]


OUTCOME = JobOutcome({"value": 1.5, "lost": float("nan")}, {"values": np.arange(3.0)})


def test_a_finished_job_is_found_again(tmp_path: Path, ledger_jobs: list[Job]) -> None:
    with JobStore(tmp_path / "new") as ledger:
        ledger.add(ledger_jobs[0], OUTCOME, 2.5)
    with JobStore(tmp_path / "new") as ledger:
        found = ledger.outcome(ledger_jobs[0])
        assert found is not None
        assert found.values == {"value": 1.5, "lost": None}
        assert found.arrays["values"].tolist() == [0.0, 1.0, 2.0]
        assert ledger.outcome(ledger_jobs[1]) is None
        assert (ledger.took_s(ledger_jobs[0]), ledger.took_s(ledger_jobs[1])) == (2.5, 0.0)
        assert ledger.durations_s == {"speed_m_s=0.05": [2.5]}


def test_a_torn_last_line_is_cut_and_the_rest_kept(tmp_path: Path, ledger_jobs: list[Job]) -> None:
    with JobStore(tmp_path) as ledger:
        ledger.add(ledger_jobs[0], OUTCOME)
        ledger.add(ledger_jobs[1], OUTCOME)
    path = tmp_path / "jobs.jsonl"
    path.write_bytes(path.read_bytes()[:-40])
    with JobStore(tmp_path) as ledger:
        assert ledger.outcome(ledger_jobs[0]) is not None
        assert ledger.outcome(ledger_jobs[1]) is None
        ledger.add(ledger_jobs[1], OUTCOME)
    assert len(path.read_bytes().splitlines()) == 2


def test_a_torn_last_line_of_another_shard_is_left_alone(tmp_path: Path, ledger_jobs: list[Job]) -> None:
    with JobStore(tmp_path, Shard(1, 2)) as ledger:
        ledger.add(ledger_jobs[0], OUTCOME)
        ledger.add(ledger_jobs[1], OUTCOME)
    path = tmp_path / "jobs-1of2.jsonl"
    path.write_bytes(torn := path.read_bytes()[:-1])
    with JobStore(tmp_path) as ledger:
        assert (ledger.outcome(ledger_jobs[0]) is not None, ledger.outcome(ledger_jobs[1])) == (True, None)
    assert path.read_bytes() == torn


def test_a_line_that_is_no_job_is_named(tmp_path: Path) -> None:
    (tmp_path / "jobs.jsonl").write_text('{"key": "a"}\n')
    with pytest.raises(CampaignError, match=r"jobs.jsonl:1: is no finished job; remove the line"):
        JobStore(tmp_path)


def test_two_campaigns_do_not_write_one_file(tmp_path: Path) -> None:
    with JobStore(tmp_path), pytest.raises(CampaignError, match="another campaign writes there; wait for it or choose"):
        JobStore(tmp_path)
    with JobStore(tmp_path, Shard(1, 2)), JobStore(tmp_path, Shard(2, 2)):
        pass


def test_a_directory_that_is_not_there_cannot_be_taken_over(tmp_path: Path) -> None:
    with pytest.raises(CampaignError, match=r"nowhere: is no directory; name one that a campaign wrote"):
        JobStore(tmp_path, others=[tmp_path / "nowhere"])


def test_a_table_has_the_factors_first() -> None:
    rows = [
        {
            "world": "hard",
            "runs": 2,
            "error": {"mean": 1.2345, "band": [0.5, 2.0]},
            "ratio": None,
            "causes": ["a", "b"],
        },
        {"world": "thesis", "runs": 1, "error": {"mean": 2, "band": None}, "ratio": 1.5, "causes": []},
    ]
    columns = [Column("mean, mm", "error.mean", ".2f"), Column("band", "error.band", ".1f"), Column("ratio", "ratio")]
    assert table(rows, [*columns, Column("gone", "error.gone"), Column("by", "causes")]).splitlines() == [
        "| world | runs | mean, mm | band | ratio | gone | by |",
        "|---|---|---|---|---|---|---|",
        "| hard | 2 | 1.23 | 0.5 to 2.0 | - | - | a; b |",
        "| thesis | 1 | 2.00 | - | 1.5 | - | - |",
    ]


@pytest.mark.parametrize(
    ("elapsed_s", "done_s", "left_s", "text"),
    [(10.0, 20.0, 40.0, "0:00:20 left"), (3600.0, 1.0, 1.5, "1:30:00 left"), (1.0, 0.0, 5.0, "0:00:00 left")],
)
def test_the_time_left_follows_the_pace(elapsed_s: float, done_s: float, left_s: float, text: str) -> None:
    assert time_left(elapsed_s, done_s, left_s) == text
