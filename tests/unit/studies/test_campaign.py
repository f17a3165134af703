"""Campaigns: cells, jobs and shards, the store of finished jobs, runs that are interrupted, tables."""

import json
import pickle
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ccatp.cli import main
from ccatp.errors import CcatpError
from ccatp.studies import STUDIES
from ccatp.studies.campaign import (
    CampaignError,
    CampaignFailed,
    CampaignInterrupted,
    ClusterUnreachable,
    Job,
    JobOutcome,
    Shard,
    cells_of,
    jobs_of,
    parse_choice,
    parse_shard,
    with_seed,
)
from ccatp.studies.engine import FAILURES, CampaignOptions, open_store, run_campaign
from ccatp.studies.results import plain, table
from tests.support.command import refused
from tests.unit.studies.toy import FAULTS, SPEEDS_M_S, STUDY, load

TRIAL = replace(STUDY, name="trial", defaults={"run.filter": "ekf", "run.panels": 2}, mirrors=("thesis-m1",))


# -- cells, jobs, shards ----------------------------------------------------------------------------------------------


def test_cells_are_crossed_with_the_mirrors() -> None:
    cells = cells_of(TRIAL, ["fyst-m1", "fyst-m2"])
    assert [dict(cell.factors) for cell in cells] == [
        {"mirror": mirror, "speed_m_s": speed} for mirror in ("fyst-m1", "fyst-m2") for speed in SPEEDS_M_S
    ]
    assert cells[3].overrides == {"run.mirror": "fyst-m2", "limits.v_max_m_s": 0.1}
    assert [cell.factors["speed_m_s"] for cell in cells_of(TRIAL, only={"speed_m_s": ("0.1",)})] == [0.1]
    assert [dict(cell.factors) for cell in cells_of(STUDY)] == [{"speed_m_s": 0.05}, {"speed_m_s": 0.1}]


def test_a_job_holds_all_that_it_depends_on() -> None:
    plan = jobs_of(TRIAL, cells_of(TRIAL), load, {"run.panels": 1, "run.seed": 7}, 2)
    assert [[job.key for job in group] for group in plan] == [
        [f"mirror=thesis-m1,speed_m_s={v},seed={seed}" for seed in (7, 8)] for v in SPEEDS_M_S
    ]
    job = plan[1][1]
    assert (job.cfg.run.seed, job.cfg.run.filter, job.cfg.run.panels, job.cfg.limits.v_max_m_s) == (8, "ekf", 1, 0.1)
    assert job.cfg.mirror.name == "thesis-m1"
    again = pickle.loads(pickle.dumps(job))
    assert again == job
    outcome = JobOutcome({"a": 1.0})
    assert pickle.loads(pickle.dumps(outcome)) == outcome
    others = [
        Job("other", job.factors, 8, job.cfg),
        Job("trial", {"speed_m_s": 0.2}, 8, job.cfg),
        Job("trial", job.factors, 2, job.cfg),
        Job("trial", job.factors, 8, load({"mission.backoff_m": 0.04})),
        Job("trial", job.factors, 8, with_seed(job.cfg, 2)),
    ]
    assert again.fingerprint == job.fingerprint
    assert len({job.fingerprint, *(other.fingerprint for other in others)}) == 6


@pytest.mark.parametrize(
    ("refused", "message"),
    [
        (lambda: cells_of(STUDY, ["fyst-m1"]), "study toy chooses its mirrors itself; leave --mirror out"),
        (lambda: cells_of(TRIAL, only={"sp": ("1",)}), "--only sp: is no factor of study trial; there are mirror, sp"),
        (
            lambda: cells_of(TRIAL, only={"speed_m_s": ("0.3",)}),
            r"--only speed_m_s=0.3: study trial has no such level; there are 0.05, 0.1",
        ),
        (
            lambda: jobs_of(TRIAL, cells_of(TRIAL), load, {"limits.v_max_m_s": 0.2}, 1),
            r"limits\.v_max_m_s is set by study trial itself; leave it out, or",
        ),
        (lambda: jobs_of(TRIAL, cells_of(TRIAL), load, {}, 0), "--runs 0: must be at least 1"),
        *(
            (lambda text=text: parse_shard(text), f"--shard {text}: is not i/n with 1 <= i <= n")
            for text in ("0/4", "5/4", "1", "a/b", "1/", "-1/4", "1/4/2")
        ),
        *((lambda text=text: parse_choice(text), "is not factor=level") for text in ("world", "=hard", "a=", "a=,")),
    ],
)
def test_what_cannot_be_planned_is_refused(refused: Any, message: str) -> None:
    with pytest.raises(CampaignError, match=message):
        refused()
    assert parse_shard("2/4") == Shard(2, 4)
    assert parse_choice("world=hard, extreme") == ("world", ("hard", "extreme"))


@pytest.fixture
def toy_study(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ccatp.studies.find_study", lambda name: analysis if name == "one" else STUDY)


def analysis(cfg: Any, out: Path) -> dict[str, Any]:
    """A study without runs."""
    (out / "table.md").write_text(f"{cfg.limits.v_max_m_s}\n")
    return {"study": "one", "cells": [], "wall_s": 0.0}


# -- campaigns --------------------------------------------------------------------------------------------------------

CELLS = [
    {"speed_m_s": 0.05, "runs": 3, "mean": pytest.approx(0.1), "speed": 0.05},
    {"speed_m_s": 0.1, "runs": 3, "mean": pytest.approx(0.2), "speed": 0.1},
]


def campaign(out: Path, **options: Any) -> dict[str, Any]:
    return run_campaign(STUDY, load, CampaignOptions(out, **{"workers": 1, **options}))


def jobs_done(out: Path) -> list[str]:
    return [json.loads(line)["key"] for path in out.glob("jobs*.jsonl") for line in path.read_bytes().splitlines()]


def test_a_campaign_writes_all_its_files_and_json_alone_on_standard_output(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], toy_study: None
) -> None:
    assert main(["study", "toy", "--workers", "1", "--panels", "1", "--out", str(tmp_path), "--json"]) == 0
    shown = capsys.readouterr()
    result = json.loads(shown.out)
    assert (result["study"], result["cells"], result["settings"]) == ("toy", CELLS, {"run.panels": 1})
    assert json.loads((tmp_path / "result.json").read_text()) == result
    assert "ccatp: study toy: 6 jobs to do" in shown.err
    assert shown.err.splitlines()[-1] == f"ccatp: study toy: all 6 jobs are done; results are in {tmp_path}"
    with np.load(tmp_path / "result.npz") as arrays:
        assert arrays["1/values"].tolist() == pytest.approx([0.1, 0.2, 0.3])
    rows = "| speed_m_s | runs | mean |\n|---|---|---|\n| 0.05 | 3 | 0.1 |\n| 0.1 | 3 | 0.2 |\n"
    assert (tmp_path / "table.md").read_text() == f"# toy: A toy\n\n{rows}"
    assert (tmp_path / "figure.txt").read_text() == "2"
    seeds = [key.rpartition("=")[2] for key in jobs_done(tmp_path)]
    assert seeds == ["1", "1", "2", "2", "3", "3"]  # one job of each cell first


def test_workers_give_the_same_cells(tmp_path: Path) -> None:
    assert campaign(tmp_path, workers=2, with_figures=False)["cells"] == CELLS
    assert len(jobs_done(tmp_path)) == 6
    assert not (tmp_path / "figure.txt").exists()


def test_what_is_done_is_not_done_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    campaign(tmp_path, runs=2)
    monkeypatch.setenv(FAULTS, "speed_m_s=0.05,seed=1:raise")
    assert campaign(tmp_path)["cells"] == CELLS
    assert len(jobs_done(tmp_path)) == 6
    done = r"jobs.jsonl: job speed_m_s=0.05,seed=1 was done with another configuration or version; give the options"
    with pytest.raises(CampaignError, match=done):
        campaign(tmp_path, settings={"run.panels": 2})


def test_shards_are_put_together(tmp_path: Path, capsys: pytest.CaptureFixture[str], toy_study: None) -> None:
    args, out = ["study", "toy", "--workers", "1", "--json", "--out"], tmp_path / "a"
    assert main([*args, str(out), "--shard", "1/2"]) == 0
    shown = capsys.readouterr()
    assert "3 of 6 jobs are done; the other shards, or the same command without --shard, do the 3 that are" in shown.err
    assert json.loads(shown.out)["missing"] == 3
    assert [cell["runs"] for cell in json.loads(shown.out)["cells"]] == [2, 1]
    assert main([*args, str(tmp_path / "b"), "--from", str(out), "--shard", "2/2"]) == 0
    assert "3 jobs to do, 3 done before" in capsys.readouterr().err
    assert campaign(out, others=(tmp_path / "b",))["cells"] == CELLS
    assert (out / "jobs.jsonl").read_bytes() == b""


def test_one_failure_does_not_stop_the_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(FAULTS, "speed_m_s=0.05,seed=1:raise")
    with pytest.raises(
        CampaignFailed, match=r"1 of 6 jobs failed, the first: speed_m_s=0.05,seed=1: ArithmeticError: the wheel came"
    ):
        campaign(tmp_path)
    assert len(jobs_done(tmp_path)) == 5
    assert "in _go_wrong" in (tmp_path / FAILURES).read_text()
    assert json.loads((tmp_path / "result.json").read_text())["missing"] == 1
    monkeypatch.delenv(FAULTS)
    assert campaign(tmp_path)["cells"] == CELLS


KEYS = [f"speed_m_s={v},seed={seed}" for v in SPEEDS_M_S for seed in (1, 2, 3)]


@pytest.mark.parametrize(
    ("faults", "workers", "error", "message", "done"),
    [
        pytest.param(
            ";".join(f"{key}:raise" for key in KEYS), 1, CampaignFailed,
            r"5 jobs failed, the last: .*the wheel came off; see .*failures.txt", [0], id="one after the other",
        ),
        pytest.param(
            f"{KEYS[-1]}:interrupt", 1, CampaignInterrupted,
            "interrupted; what is done is kept in .*: the same command continues from there", [5], id="Ctrl-C",
        ),
        pytest.param(
            f"{KEYS[-1]}:die", 2, CampaignFailed,
            "a worker died, perhaps for want of memory; what is done is kept in", range(6), id="a worker dies",
        ),
    ],
)  # fmt: skip
def test_what_ends_a_campaign(
    faults: str, workers: int, error: type[CampaignError], message: str, done: list[int], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setenv(FAULTS, faults)
    with pytest.raises(error, match=message) as ended:
        campaign(tmp_path, workers=workers)
    assert ended.value.exit_status == (130 if error is CampaignInterrupted else 4)
    assert len(jobs_done(tmp_path)) in done
    assert not (tmp_path / "result.json").exists()


@pytest.mark.parametrize("workers", [1, 2])
def test_errors_with_arguments_of_their_own_end_no_pool(
    workers: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(FAULTS, f"{KEYS[0]}:block")
    with pytest.raises(CampaignFailed, match=r"1 of 6 jobs failed, the first: .*block 'b' is not in the state"):
        campaign(tmp_path, workers=workers)
    assert len(jobs_done(tmp_path)) == 5
    monkeypatch.setenv(FAULTS, f"{KEYS[0]}:data")  # data that cannot be used end the campaign: no job can use them
    with pytest.raises(CcatpError, match=r"^a\.csv:3: is empty$") as ended:
        campaign(tmp_path, workers=workers)
    assert ended.value.exit_status == 2


def test_a_cluster_that_does_not_answer_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ccatp.studies.engine.CLUSTER_TIMEOUT_S", 0.2)
    with pytest.raises(ClusterUnreachable, match=r"--cluster tcp://127.0.0.1:9: no scheduler answers there") as refused:
        campaign(tmp_path, cluster="tcp://127.0.0.1:9")
    assert refused.value.exit_status == 5


# -- the store --------------------------------------------------------------------------------------------------------

OUTCOME = JobOutcome({"value": 1.5, "lost": float("nan")}, {"values": np.arange(3.0)})


@pytest.mark.parametrize("shard", [Shard(1, 1), Shard(1, 2)])
def test_finished_jobs_are_found_again_and_a_torn_line_is_not(tmp_path: Path, shard: Shard) -> None:
    one, other = jobs_of(STUDY, cells_of(STUDY), load, {}, 2)[0]
    with open_store(tmp_path / "new", shard) as store:
        store.add(one, OUTCOME, 2.5)
        store.add(other, OUTCOME)
    (path,) = (tmp_path / "new").iterdir()
    path.write_bytes(torn := path.read_bytes()[:-1])
    with open_store(tmp_path / "new") as store:
        found = store.find(one)
        assert found is not None
        assert (found.outcome.values, found.took_s) == ({"value": 1.5, "lost": None}, 2.5)
        assert found.outcome.arrays["values"].tolist() == [0.0, 1.0, 2.0]
        assert store.find(other) is None
        assert path.read_bytes() == (torn if shard.of == 2 else torn[: torn.rfind(b"\n") + 1])  # another's is left
        store.add(other, OUTCOME)
    assert len((tmp_path / "new" / "jobs.jsonl").read_bytes().splitlines()) == (1 if shard.of == 2 else 2)


def test_what_cannot_be_read_or_locked_is_refused(tmp_path: Path) -> None:
    def assert_refused(message: str, others: tuple[Path, ...] = ()) -> None:
        with pytest.raises(CampaignError, match=message), open_store(tmp_path, others=others):
            pass

    with open_store(tmp_path):
        assert_refused("another campaign writes there; wait for it or choose")
    with open_store(tmp_path, Shard(1, 2)), open_store(tmp_path, Shard(2, 2)):
        pass
    assert_refused(r"nowhere: is no directory; name one that a campaign wrote", (tmp_path / "nowhere",))
    (tmp_path / "jobs.jsonl").write_text('{"key": "a"}\n')
    assert_refused(r"jobs.jsonl:1: is no finished job; remove the line")


# -- results ----------------------------------------------------------------------------------------------------------


def test_values_are_made_what_json_has() -> None:
    given = {"a": np.float64(1.5), "b": [np.int64(2), float("nan")], "c": np.array([np.inf]), "d": (True, None, "x")}
    assert plain(given) == {"a": 1.5, "b": [2, None], "c": [None], "d": [True, None, "x"]}


def test_a_table_has_the_factors_first() -> None:
    rows = [
        {"world": "hard", "runs": 2, "e": {"mean": 1.2341, "band": [0.5, 2.0]}, "ratio": None, "causes": ["a", "b"]},
        {"world": "thesis", "runs": 1, "e": {"mean": 2, "band": None}, "ratio": 1.5, "causes": []},
    ]
    columns = """
        e: mean band gone
        ratio causes
    """
    assert table(rows, columns).splitlines() == [
        "| world | runs | e.mean | e.band | e.gone | ratio | causes |",
        "|---|---|---|---|---|---|---|",
        "| hard | 2 | 1.234 | 0.5 to 2 | - | - | a; b |",
        "| thesis | 1 | 2 | - | - | 1.5 | - |",
    ]


# -- the command ------------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("toy_study")
def test_without_json_the_table_is_shown(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    args = ["--workers", "1", "--only", "speed_m_s=0.1", "--no-figures", "--seed", "5", "--set", "run.filter=ekf"]
    assert main(["study", "toy", *args]) == 0
    assert capsys.readouterr().out == "# toy: A toy\n\n| speed_m_s | runs | mean |\n|---|---|---|\n| 0.1 | 3 | 0.6 |\n"
    settings = json.loads((tmp_path / "studies/toy/result.json").read_text())["settings"]
    assert settings == {"run.seed": 5, "run.filter": "ekf"}


@pytest.mark.usefixtures("toy_study")
def test_an_analysis_takes_what_every_study_takes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    args = ["study", "one", "--out", str(tmp_path / "a"), "--set", "limits.v_max_m_s=0.05"]
    assert main([*args, "--runs", "3", "--panels", "1", "--json"]) == 0
    shown = capsys.readouterr()
    assert json.loads(shown.out)["study"] == "one"
    assert shown.err == "ccatp: study one is one analysis: --runs and --workers change nothing\n"
    assert main(args) == 0
    assert capsys.readouterr().out == "0.05\n"


HANDED_OUT = [
    ("--cluster", "a:1"), ("--shard", "1/2"), ("--from", "x"), ("--only", "a=b"), ("--mirror", "fyst-m1"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("name", "out", "args", "status", "message"),
    [
        *(
            ("one", "", args, 2, f"ccatp: study one has no runs to hand out; leave {args[0]} out")
            for args in HANDED_OUT
        ),
        ("one", "file/out", (), 2, "ccatp: --out: cannot make {out}: Not a directory; choose another --out"),
        ("toy", "file/out", (), 2, "ccatp: --out: cannot make {out}: Not a directory; choose another --out"),
        ("one", "taken", (), 4, "ccatp: {out}/table.md: Is a directory; make room or choose another --out"),
    ],
)
@pytest.mark.usefixtures("toy_study")
def test_what_cannot_be_is_one_line(
    name: str, out: str, args: tuple[str, ...], status: int, message: str, tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    (tmp_path / "file").touch()
    (tmp_path / "taken" / "table.md").mkdir(parents=True)
    reported = refused(capsys, "study", name, "--out", tmp_path / out, *args, status=status)
    assert reported == message.format(out=tmp_path / out) + "\n"


@pytest.mark.parametrize("name", ["one", "toy"])
@pytest.mark.usefixtures("toy_study")
def test_what_cannot_be_drawn_is_one_line_before_any_work(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in ("matplotlib", "matplotlib.figure"):
        monkeypatch.setitem(sys.modules, module, None)
    reported = refused(capsys, "study", name, "--out", tmp_path / "out")
    assert reported.startswith("ccatp: the package matplotlib")
    assert not list((tmp_path / "out").iterdir())


def test_an_unknown_study_is_one_line_and_help_lists_the_others(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert refused(capsys, "study", "filter", "--out", tmp_path) == "ccatp: no study 'filter'; did you mean filters?\n"
    assert main(["study", "--help"]) == 0
    shown = capsys.readouterr().out
    assert all(f"  {name} " in shown for name in STUDIES)
