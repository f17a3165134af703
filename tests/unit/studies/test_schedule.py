"""The order in which jobs are handed out."""

import pytest

from ccatp.studies.campaign import Job, Schedule, cells_of, jobs_of
from tests.unit.studies.toy import STUDY, load

SLOW, FAST = "speed_m_s=0.05", "speed_m_s=0.1"


@pytest.fixture(scope="module")
def jobs() -> list[Job]:
    return [job for group in jobs_of(STUDY, cells_of(STUDY), load, {}, 3) for job in group]


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
