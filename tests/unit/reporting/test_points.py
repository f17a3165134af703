"""Pass or fail of each point."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from ccatp.core import PointId, Vector3
from ccatp.links.topics import FixMessage
from ccatp.mirror.panel_alignment import Measured
from ccatp.records.store import StoredPoint
from ccatp.report.findings import Grade, error_figures, error_series, first_arrivals_mm, point_verdicts
from ccatp.report.record import RunRecord, changed_keys, read_record


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
    ours: Mapping[str, object] = {"a": {"b": 1, "c": [1]}, "d": 2}
    shipped: Mapping[str, object] = {"a": {"b": 1, "c": [2]}, "e": 3}
    assert changed_keys(ours, shipped) == {"a.c": ([1], [2]), "d": (2, None), "e": (None, 3)}
    assert changed_keys(ours, ours) == {}
