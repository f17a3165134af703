"""Points of a survey: what contradicts itself cannot come about."""

from hypothesis import given
from hypothesis import strategies as st

from ccatp.core import PointId
from ccatp.survey.points import Failure, PointLog

A, B, C, D = (PointId(0, 0, number) for number in (1, 2, 3, 4))


def test_failed_points_have_a_second_round_and_no_third() -> None:
    log = PointLog().fail(A, "no lengths").measure(B).fail(C, "it moved")
    assert (log.done, log.skipped, log.due) == ((B,), (A, C), ())
    log = log.begin_second_round()
    assert log.due == (C, A)
    log = log.measure(C).fail(A, "timeout")
    assert (log.done, log.causes, log.due) == ((B, C), {A: "timeout"}, ())
    assert log.begin_second_round().due == ()


def test_a_point_without_time_is_not_skipped_and_not_tried_again() -> None:
    log = PointLog().fail(A, "no lengths").give_up((A, B), "no time for it", (C, D))
    assert (log.skipped, log.due) == ((A,), (C, D))
    assert log.causes == {A: "no time for it", B: "no time for it"}
    assert log.measure(C).measure(D).begin_second_round().due == ()


def test_the_database_is_newer_than_the_log() -> None:
    log = PointLog(failed={A: Failure("no lengths", had_second_try=True), B: Failure("late", False, True)}, due=(A, C))
    assert log.take_over((), (A,)) == log
    later = log.take_over((A,), (C,))
    assert (later.done, later.skipped, later.due) == ((A,), (C,), ())
    assert later.causes == {B: "late", C: "not measured"}
    assert log.take_over((), ()).skipped == ()


POINTS = st.sampled_from((A, B, C, D))
EVENTS = st.sampled_from(("measure", "fail", "give up", "second round", "take over"))


@given(st.lists(st.tuples(EVENTS, POINTS, POINTS)))
def test_a_point_is_in_one_place(events: list[tuple[str, PointId, PointId]]) -> None:
    log, measured = PointLog(), list[PointId]()
    for name, point, other in events:
        if name == "measure":
            log = log.measure(point)
            measured += [point] if point not in measured else []
        elif name == "fail":
            log = log.fail(point, "no lengths")
        elif name == "give up" and point not in measured:
            log = log.give_up((point,), "no time for it", () if other in measured or other == point else (other,))
            assert not log.failed[point].is_tried or point in log.skipped
        elif name == "second round":
            log = log.begin_second_round()
            assert all(failure.had_second_try for failure in log.failed.values())
        elif name == "take over":
            log = log.take_over(log.done, log.skipped)
        assert log.done == tuple(measured)
        assert not {*log.failed, *log.due} & set(log.done)
        assert set(log.skipped) <= log.failed.keys() == log.causes.keys()
