"""What follows from a recorded survey: pass or fail of each point, where the time went, and the least it takes."""

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from ccatp.core import PointId, Vector3
from ccatp.links.topics import FixMessage, MissionStatus
from ccatp.mirror.panel_alignment import Measured
from ccatp.records.state_log import StateChange
from ccatp.records.store_rows import StoredPoint
from ccatp.report.findings import (
    Grade,
    error_figures,
    error_series,
    first_arrivals_mm,
    least_times,
    point_verdicts,
    sampled_spells,
    spells_of,
    time_budget,
)
from ccatp.report.record import RecordedSession, RunRecord, changed_keys, read_record
from ccatp.survey.composition import assemble


@pytest.fixture
def record(recorded: Path) -> RunRecord:
    return read_record(recorded)


def test_arrivals_and_errors_are_those_of_the_summary(record: RunRecord) -> None:
    assert record.summary is not None
    first = list(first_arrivals_mm(record).values())
    assert len(first) == 9
    assert np.mean(first) == pytest.approx(record.summary["arrival_error_mm"]["mean"], abs=1e-3)
    assert max(first) == pytest.approx(record.summary["arrival_error_mm"]["max"], abs=1e-3)
    series = error_series(record)
    assert series is not None
    figures = error_figures(series)
    assert figures is not None
    expected = record.summary["localization_error_mm"]
    # Estimates are recorded in panel frames: a micrometre is lost on the way to the deck and back.
    assert (figures.mean_mm, figures.p50_mm, figures.p99_mm, figures.max_mm) == pytest.approx(
        (expected["mean"], expected["p50"], expected["p99"], expected["max"]), abs=2e-3
    )
    assert figures.within_limit == expected["within_10mm_fraction"]
    assert 0.9 < figures.within_sigma3 <= 1.0


def test_grades(record: RunRecord) -> None:
    points = [PointId(1, 2, number) for number in range(1, 6)]
    fixes = {one.point: one for one in record.measured}
    far = fixes[points[1]]
    x, y, z = far.fix.position_m
    measured = (fixes[points[0]], replace_fix(far, (x + 0.02, y, z)), fixes[points[2]])
    statuses = ("measured", "measured", "measured", "skipped", "planned")
    rows = [StoredPoint(point, 0.0, 0.0, status, None, None) for point, status in zip(points, statuses, strict=True)]
    (session,) = record.sessions
    status = session.statuses[-1]
    told = msgspec.structs.replace(status, left_out={"no fix: too few channels": ["1-2-4"]})
    blind = replace(session, truth=None, statuses=(told,), fixes=arrived_far(session.fixes, points[2]))
    found = point_verdicts(replace(record, points=tuple(rows), measured=measured, sessions=(blind,)))
    assert [verdict.grade for verdict in found] == [
        Grade.GOOD, Grade.FAIL, Grade.CORRECTED, Grade.SKIPPED, Grade.OPEN,
    ]  # fmt: skip
    assert found[2].first_mm == pytest.approx(20.0, abs=5.0)
    assert found[3].why == "no fix: too few channels"
    assert len({verdict.grade for verdict in found}) == len(Grade)


def replace_fix(one: Measured, position_m: Vector3) -> Measured:
    return one._replace(fix=replace(one.fix, position_m=position_m))


def arrived_far(fixes: tuple[FixMessage, ...], point: PointId) -> tuple[FixMessage, ...]:
    first = next(fix for fix in fixes if fix.point == tuple(point))
    x, y, z = first.position_m
    return (msgspec.structs.replace(first, position_m=(x, y + 0.02, z)), *fixes)


def test_changed_keys() -> None:
    ours = {"a": {"b": 1, "c": [1]}, "d": 2}
    shipped = {"a": {"b": 1, "c": [2]}, "e": 3}
    assert changed_keys(ours, shipped) == {"a.c": ([1], [2]), "d": (2, None), "e": (None, 3)}
    assert changed_keys(ours, ours) == {}


# -- time budget ------------------------------------------------------------------------------------------------------


def only(record: RunRecord) -> RecordedSession:
    (session,) = record.sessions
    return session


def said(*changes: tuple[int, str, str]) -> tuple[StateChange, ...]:
    return tuple(StateChange(*change) for change in changes)


def test_the_times_add_up_to_the_mission(record: RunRecord) -> None:
    found = time_budget(record)
    assert found is not None
    assert record.summary is not None
    assert found.is_exact
    assert found.total_s == pytest.approx(record.summary["mission_time_s"], abs=0.02)  # a frame at each end
    assert set(found.spent_s) == {"turn", "drive", "settle", "measure", "wait"}
    measurements = found.visits["measure"]
    assert measurements >= 9
    assert found.spent_s["measure"] == pytest.approx(measurements * record.cfg.etalon.measuring_time_s, abs=1e-6)
    assert found.bound_s == pytest.approx(assemble(record.cfg).lower_bound_s, abs=1e-9)
    assert found.bound_s is not None
    assert found.bound_s < found.total_s
    assert found.covers == "the whole mission"


def test_the_least_time_of_half_a_mission_ends_at_its_last_point(record: RunRecord) -> None:
    whole, _ = least_times(record)
    half, covers = least_times(replace(record, measured=record.measured[:3]))
    none, _ = least_times(replace(record, measured=()))
    assert whole is not None
    assert half is not None
    assert half["measure"] == pytest.approx(3 * 0.5)
    assert 0.0 < half["drive"] < 0.5 * whole["drive"]
    assert covers == "the planned way to the last measured point"
    assert none is None


def test_a_longer_measurement_waited(record: RunRecord) -> None:
    session = only(record)
    changes = said((100, "idle", "measuring"), (250, "measuring", "held"), (300, "held", "done"))
    found = time_budget(replace(record, sessions=(replace(session, changes=changes),)))
    assert found is not None
    # 1 s idle, 1.5 s measuring of which half a second is due, half a second held, and nothing after the end.
    assert found.spent_s == {"measure": pytest.approx(0.5), "wait": pytest.approx(2.5)}


def test_a_main_loop_that_died_leaves_a_wait(record: RunRecord) -> None:
    session = only(record)
    changes = said((100, "idle", "driving"), (300, "idle", "settling"), (310, "settling", "done"))
    spells = spells_of(replace(session, changes=changes))
    assert spells is not None
    assert [state for state, _ in spells] == ["idle", "idle", "settling"]
    assert [duration_s for _, duration_s in spells] == pytest.approx([1.0, 2.0, 0.1])


def restarted(session: RecordedSession) -> tuple[MissionStatus, ...]:
    """Main was gone from 3 s to 7 s of robot time; its successor speaks first before it has seen a frame."""
    first = session.statuses[0]
    told = [(100, 1.0, 1.0, "driving"), (300, 3.0, 3.0, "driving"), (-1, 0.0, 3.0, "idle"), (710, 7.1, 3.1, "settling")]
    return tuple(
        msgspec.structs.replace(first, seq=seq, t_s=t_s, elapsed_s=elapsed_s, state=state)
        for seq, t_s, elapsed_s, state in told
    )


def test_what_passed_while_main_was_restarted_is_a_row(record: RunRecord) -> None:
    session = only(record)
    changes = said((100, "idle", "driving"), (690, "idle", "settling"), (710, "settling", "done"))
    found = time_budget(replace(record, sessions=(replace(session, changes=changes, statuses=restarted(session)),)))
    assert found is not None
    assert found.spent_s["start anew"] == pytest.approx(4.0)
    assert found.mission_s == pytest.approx(found.total_s - 4.0)
    assert found.total_s == pytest.approx(7.1)
    sampled = sampled_spells(replace(session, statuses=restarted(session)))
    assert [(state, round(duration_s, 6)) for state, duration_s in sampled] == [
        ("driving", 2.0), ("driving", 0.1), ("start anew", 4.0),
    ]  # fmt: skip


def test_the_status_tells_coarsely(record: RunRecord) -> None:
    session = only(record)
    sampled = sampled_spells(session)
    assert sum(duration_s for _, duration_s in sampled) == pytest.approx(session.span_s, abs=2.0)  # a batch at each end
    found = time_budget(replace(record, sessions=(replace(session, changes=()),)))
    assert found is not None
    assert not found.is_exact


def test_nothing_tells_nothing(record: RunRecord) -> None:
    assert time_budget(replace(record, sessions=())) is None
