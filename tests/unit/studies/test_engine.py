"""Campaigns: done here or in workers, in parts, again after a failure, and always with the same cells."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ccatp.studies.campaign import CampaignError, CampaignFailed, CampaignInterrupted, ClusterUnreachable, Shard
from ccatp.studies.engine import FAILURES, CampaignOptions, run_campaign
from tests.unit.studies.toy import FAULTS, STUDY, load

CELLS = [
    {"speed_m_s": 0.05, "runs": 3, "mean": pytest.approx(0.1), "speed": 0.05},
    {"speed_m_s": 0.1, "runs": 3, "mean": pytest.approx(0.2), "speed": 0.1},
]


def campaign(out: Path, **options: Any) -> dict[str, Any]:
    return run_campaign(STUDY, load, CampaignOptions(out, **{"workers": 1, "is_quiet": True, **options}))


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
