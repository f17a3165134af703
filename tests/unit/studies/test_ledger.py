"""What is done stays done: on the disk, line by line."""

from pathlib import Path

import numpy as np
import pytest

from ccatp.studies.campaign import CampaignError, Job, JobOutcome, Shard, cells_of, jobs_of
from ccatp.studies.job_store import JobStore
from tests.unit.studies.toy import STUDY, load


@pytest.fixture(scope="module")
def jobs() -> list[Job]:
    return jobs_of(STUDY, cells_of(STUDY), load, {}, 3)[0]


OUTCOME = JobOutcome({"value": 1.5, "lost": float("nan")}, {"values": np.arange(3.0)})


def test_a_finished_job_is_found_again(tmp_path: Path, jobs: list[Job]) -> None:
    with JobStore(tmp_path / "new") as ledger:
        ledger.add(jobs[0], OUTCOME, 2.5)
    with JobStore(tmp_path / "new") as ledger:
        found = ledger.outcome(jobs[0])
        assert found is not None
        assert found.values == {"value": 1.5, "lost": None}
        assert found.arrays["values"].tolist() == [0.0, 1.0, 2.0]
        assert ledger.outcome(jobs[1]) is None
        assert (ledger.took_s(jobs[0]), ledger.took_s(jobs[1])) == (2.5, 0.0)
        assert ledger.durations_s == {"speed_m_s=0.05": [2.5]}


def test_a_torn_last_line_is_cut_and_the_rest_kept(tmp_path: Path, jobs: list[Job]) -> None:
    with JobStore(tmp_path) as ledger:
        ledger.add(jobs[0], OUTCOME)
        ledger.add(jobs[1], OUTCOME)
    path = tmp_path / "jobs.jsonl"
    path.write_bytes(path.read_bytes()[:-40])
    with JobStore(tmp_path) as ledger:
        assert ledger.outcome(jobs[0]) is not None
        assert ledger.outcome(jobs[1]) is None
        ledger.add(jobs[1], OUTCOME)
    assert len(path.read_bytes().splitlines()) == 2


def test_a_torn_last_line_of_another_shard_is_left_alone(tmp_path: Path, jobs: list[Job]) -> None:
    with JobStore(tmp_path, Shard(1, 2)) as ledger:
        ledger.add(jobs[0], OUTCOME)
        ledger.add(jobs[1], OUTCOME)
    path = tmp_path / "jobs-1of2.jsonl"
    path.write_bytes(torn := path.read_bytes()[:-1])
    with JobStore(tmp_path) as ledger:
        assert (ledger.outcome(jobs[0]) is not None, ledger.outcome(jobs[1])) == (True, None)
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
