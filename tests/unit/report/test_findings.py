"""What a report is made of: run directories whole, torn, resumed and of real robots; grades of points, times."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from ccatp.core import PointId
from ccatp.links.topics import BY_NAME, MissionStatus
from ccatp.records.recorder import Recorder, iter_messages
from ccatp.records.run_reader import read_truth
from ccatp.records.state_log import StateChange, changes_of, read_log
from ccatp.records.store import StoredPoint
from ccatp.report.findings import Grade, TimeBreakdown, findings_of, outcome_of, point_verdicts, spells_of, time_budget
from ccatp.report.record import TOPICS_READ, RecordedSession, SurveyFiles, read_record
from ccatp.survey.composition import assemble


@pytest.fixture(scope="module")
def record(recorded: Path) -> SurveyFiles:
    return read_record(recorded)


def only(record: SurveyFiles) -> RecordedSession:
    (session,) = record.sessions
    return session


def test_a_whole_run_is_that_of_its_summary(record: SurveyFiles) -> None:
    found, session = findings_of(record), only(record)
    assert (record.missing, record.warnings) == ((), ())
    assert (record.name, record.is_simulation, record.has_truth) == ("tonight", True, True)
    assert session.version == "0.0.test"
    assert len(session.track.seq) == len(set(session.track.seq.tolist())) > 1000
    assert [arrived.point[2] for arrived in session.arrivals] == [7, 8, 9, 6, 5, 4, 1, 2, 3]
    assert [row.status for row in record.points or ()] == ["measured"] * 9
    assert record.changed["run.panels"] == (1, 0)
    assert not [key for key in record.changed if key.startswith(("world", "mirror"))]
    assert record.injected is not None
    assert [line.text for line in record.log][-1] == "run finished: status 0"
    base = record.mirror.base_pose
    assert session.track.place[0, :2] == pytest.approx([base.x_m, base.y_m], abs=0.01)
    x_m, y_m, z_m = session.track.place[500].tolist()
    assert z_m == pytest.approx(record.mirror.surface.point(x_m, y_m)[2], abs=1e-9)

    assert record.summary is not None
    first = [one.first_mm for one in found.points if one.first_mm is not None]
    arrivals, expected = record.summary["arrival_error_mm"], record.summary["localization_error_mm"]
    assert (len(first), np.mean(first), max(first)) == (
        9,
        *(pytest.approx(arrivals[k], abs=1e-3) for k in ("mean", "max")),
    )
    assert found.figures is not None
    # Estimates are recorded in panel frames: a micrometre is lost on the way to the deck and back.
    for name in ("mean", "p50", "p99", "max"):
        assert found.figures[f"{name}_mm"] == pytest.approx(expected[name], abs=2e-3)
    assert found.figures["within_limit"] == expected["within_10mm_fraction"]
    assert 0.9 < found.figures["within_sigma3"] <= 1.0


def test_grades(record: SurveyFiles) -> None:
    points = [PointId(1, 2, number) for number in range(1, 6)]
    fixes = {one.point: one for one in record.measured}
    far = fixes[points[1]]
    x, y, z = far.fix.position_m
    moved = far._replace(fix=replace(far.fix, position_m=(x + 0.02, y, z)))
    statuses = ("measured", "measured", "measured", "skipped", "planned")
    rows = [StoredPoint(point, 0.0, 0.0, status, None, None) for point, status in zip(points, statuses, strict=True)]
    session = only(record)
    reported = msgspec.structs.replace(session.statuses[-1], left_out={"no fix: too few channels": ["1-2-4"]})
    corrected = next(fix for fix in session.fixes if fix.point == tuple(points[2]))
    x, y, z = corrected.position_m
    arrived = msgspec.structs.replace(corrected, position_m=(x, y + 0.02, z))
    blind = replace(session, truth=None, statuses=(reported,), fixes=(arrived, *session.fixes))
    measured = (fixes[points[0]], moved, fixes[points[2]])
    found = point_verdicts(replace(record, points=tuple(rows), measured=measured, sessions=(blind,)))
    assert [str(verdict.grade) for verdict in found] == ["pass", "fail", "corrected", "skipped", "not measured"]
    assert len(Grade) == len(found)
    assert found[2].first_mm == pytest.approx(20.0, abs=5.0)
    assert found[3].why == "no fix: too few channels"


# -- time budget ------------------------------------------------------------------------------------------------------


def budget_of(record: SurveyFiles, *changes: tuple[int, str, str], **fields: object) -> TimeBreakdown:
    reported = tuple(StateChange(*change) for change in changes)
    session = replace(only(record), changes=reported, **fields)  # type: ignore[arg-type]
    found = time_budget(replace(record, sessions=(session,)))
    assert found is not None
    return found


def test_the_times_add_up_to_the_mission(record: SurveyFiles) -> None:
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
    assert found.bound_s < found.total_s  # type: ignore[operator]
    assert found.covers == "the whole mission"
    sampled = budget_of(record)  # without changes in the log the status tells, coarsely
    assert not sampled.is_exact
    assert sampled.total_s == pytest.approx(only(record).span_s, abs=2.0)  # a batch at each end
    assert time_budget(replace(record, sessions=())) is None


def test_a_longer_measurement_waited(record: SurveyFiles) -> None:
    found = budget_of(record, (100, "idle", "measuring"), (250, "measuring", "held"), (300, "held", "done"))
    # 1 s idle, 1.5 s measuring of which half a second is due, half a second held, and nothing after the end.
    assert found.spent_s == {"measure": pytest.approx(0.5), "wait": pytest.approx(2.5)}


def test_what_passed_while_main_was_restarted_is_a_row(record: SurveyFiles) -> None:
    """Main was gone from 3 s to 7 s of robot time; its successor speaks first before it has seen a frame."""
    reported = [
        (100, 1.0, 1.0, "driving"),
        (300, 3.0, 3.0, "driving"),
        (-1, 0.0, 3.0, "idle"),
        (710, 7.1, 3.1, "settling"),
    ]
    statuses: tuple[MissionStatus, ...] = tuple(
        msgspec.structs.replace(only(record).statuses[0], seq=seq, t_s=t_s, elapsed_s=elapsed_s, state=state)
        for seq, t_s, elapsed_s, state in reported
    )
    changes = ((100, "idle", "driving"), (690, "idle", "settling"), (710, "settling", "done"))
    found = budget_of(record, *changes, statuses=statuses)
    assert (found.total_s, found.spent_s["restart"]) == pytest.approx((7.1, 4.0))
    sampled, _ = spells_of(replace(only(record), statuses=statuses, changes=()))
    assert [(state, round(duration_s, 6)) for state, duration_s in sampled] == [
        ("driving", 2.0), ("driving", 0.1), ("restart", 4.0),
    ]  # fmt: skip


# -- run directories --------------------------------------------------------------------------------------------------


def test_a_run_that_was_killed(without: Callable[..., Path]) -> None:
    run_dir = without("summary.json")
    telemetry, log = run_dir / "telemetry.mcap", run_dir / "log.jsonl"
    telemetry.write_bytes(telemetry.read_bytes()[: telemetry.stat().st_size // 2])
    log.write_text(log.read_text()[:-30])
    before = {path.name: path.read_bytes() for path in run_dir.iterdir()}
    found = read_record(run_dir)
    assert {path.name: path.read_bytes() for path in run_dir.iterdir()} == before  # nothing is written
    assert found.missing == ("summary.json: the run is in progress, or was killed before its end",)
    torn, line = sorted(found.warnings, reverse=True)
    assert torn.startswith("telemetry.mcap: damaged or cut off at byte ")
    assert torn.endswith("; the rest is used")
    assert line == "log.jsonl: 1 lines cannot be read and are not used"
    assert len(only(found).track.seq) > 500
    ended = findings_of(found).outcome
    assert (ended.text, ended.is_good) == ("no end is recorded", False)


def test_a_recording_torn_in_its_first_bytes(run_dir: Path) -> None:
    telemetry = run_dir / "telemetry.mcap"
    telemetry.write_bytes(telemetry.read_bytes()[:20])
    found = findings_of(read_record(run_dir))
    assert (found.errors, found.budget, found.outcome.text) == (None, None, "complete")  # by the log
    assert outcome_of(replace(found.record, log=())).text == "no mission"
    assert found.alignment is not None  # the fixes are in the database


def test_what_is_missing_is_reported(without: Callable[..., Path]) -> None:
    assert not findings_of(read_record(without("log.jsonl"))).budget.is_exact  # type: ignore[union-attr]
    found = read_record(without("telemetry.mcap", "mission.sqlite", "summary.json"))
    assert found.missing == (
        "log.jsonl: log of the processes, and when the mission changed its state",
        "telemetry.mcap: path, estimates, arrivals and fixes over time",
        "mission.sqlite: points, their fixes, and the panel alignment",
        "summary.json: the run is in progress, or was killed before its end",
    )
    assert (found.is_simulation, found.points, found.sessions) == (None, None, ())


def test_a_simulated_run_with_a_spoilt_recording_is_none_of_a_real_robot(run_dir: Path) -> None:
    (run_dir / "origin.json").write_text('{"simulation": true, "run_id": "1"}')
    for recording in run_dir.glob("telemetry*.mcap"):
        recording.unlink()
    (run_dir / "telemetry.mcap").write_bytes(b"spoilt")
    assert read_record(run_dir).is_simulation is True
    assert read_truth(run_dir, []) == (None, True)
    (run_dir / "origin.json").write_text("{")
    assert read_record(run_dir).is_simulation is None
    assert read_truth(run_dir, []) == (None, None)


@pytest.mark.parametrize(
    ("name", "content", "warning"),
    [
        ("summary.json", b"{", "summary.json: cannot be read: damaged"),
        ("summary.json", b"[1, 2]", "summary.json: is no summary"),
        ("summary.json", b"null", "summary.json: is no summary"),
        ("mission.sqlite", bytes(5000), "mission.sqlite: damaged or not a mission store: file is not a database"),
    ],
)
def test_what_is_spoilt_is_not_used(name: str, content: bytes, warning: str, run_dir: Path) -> None:
    (run_dir / name).write_bytes(content)
    found = read_record(run_dir)
    assert (found.summary if name == "summary.json" else found.points) is None
    assert [one.startswith(warning) for one in found.warnings] == [True]


def test_messages_of_another_version_are_not_used(run_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (run_dir / "telemetry.mcap").unlink()
    recorder = Recorder(run_dir / "telemetry.mcap", [("track", {}), ("fix", {})], is_simulation=False)
    recorder.write("track", 1.0, b'{"seq":1,"t_s":1.0,"rows":[[0,0.0,99,99,0,0,0,0]]}')
    recorder.write("fix", 1.0, b'{"seq":1,"t_s":1.0,"where":"here"}')
    recorder.close()
    lost, other = read_record(run_dir).warnings
    assert lost.startswith("telemetry.mcap: 1 messages cannot be read and are not used: topic fix: ")
    assert other.startswith("telemetry.mcap: its estimates are not of this mirror and are not used: ")

    def refuse(path: Path) -> dict[str, str]:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr("ccatp.report.record.read_metadata", refuse)
    found = read_record(run_dir)
    assert found.sessions == ()
    assert "telemetry.mcap: cannot be read: Permission denied" in found.warnings


def test_a_resumed_run_has_its_sessions_one_after_the_other(run_dir: Path) -> None:
    shutil.copy(run_dir / "telemetry.mcap", run_dir / "telemetry.1.mcap")
    log = (run_dir / "log.jsonl").read_text()
    (run_dir / "log.jsonl").write_text(log + log)
    found = findings_of(read_record(run_dir))
    assert [session.name for session in found.record.sessions] == ["telemetry.1.mcap", "telemetry.mcap"]
    errors, budget = found.errors, found.budget
    assert errors is not None
    assert budget is not None
    assert (np.diff(errors.t_s) >= 0.0).all()
    span_s = found.record.sessions[0].span_s
    assert (*errors.breaks_s, errors.t_s[-1]) == pytest.approx((span_s, 2.0 * span_s))
    assert budget.is_exact
    assert budget.total_s == pytest.approx(2.0 * span_s)


def test_every_topic_that_is_read_is_recorded(recorded: Path) -> None:
    assert all(BY_NAME[name].recorded for name in TOPICS_READ)
    assert {message.topic for message in iter_messages(recorded / "telemetry.mcap")} >= TOPICS_READ


# -- the log ----------------------------------------------------------------------------------------------------------

STATE = '{"logger":"main","seq":%d,"before":"%s","after":"%s","event":"state_changed","level":"debug","timestamp":"w"}'
RUN = '{"logger":"supervisor","event":"run_started","level":"info","timestamp":"w"}'
OLD_STATE = '{"process":"main","seq":%d,"before":"%s","after":"%s","event":"state","level":"debug","wall":"w"}'
OLD_RUN = '{"process":"supervisor","event":"run","level":"info","wall":"w"}'


@pytest.mark.parametrize(("run", "state"), [(RUN, STATE), (OLD_RUN, OLD_STATE)], ids=["now", "older"])
def test_the_log_tells_states_by_session(tmp_path: Path, run: str, state: str) -> None:
    path = tmp_path / "log.jsonl"
    later = (state % (8, "idle", "held"), state % (5, "held", "idle"))
    path.write_text("\n".join((run, state % (3, "idle", "turning"), "torn {", run, *later, "")))
    warnings: list[str] = []
    read = list(read_log(path, warnings))
    assert warnings == ["log.jsonl: 1 lines cannot be read and are not used"]
    first, second = changes_of(read, 2)
    assert [tuple(change) for change in first] == [(3, "idle", "turning")]
    assert second == ()  # the frames count anew: their times are not known
    assert changes_of(read, 1) == [()]  # a recording is missing, so nobody knows which


VERDICT = {
    "logger": "danger",
    "event": "verdict_changed",
    "condition": "estimate_stale",
    "code": 0,
    "signal": "estimate",
    "value": 0.31,
    "limit": 0.15,
}
OLD = {"process": "main", "event": "fault", "level": "warning", "wall": "w", "t_s": 3, "lag_s": 0.05, "why": ""}
LATE = {"logger": "main", "event": "frame_late", "level": "warning", "timestamp": "x", "lateness_ms": 51.0}
SAID = {"logger": "main", "event": "operator_message", "level": "info", "timestamp": "x", "text": "resumed: 1_2"}
COUNTS = {
    "logger": "danger", "event": "danger_statistics", "edges": {"front_left": 2}, "held": True, "denied": {},
    "names": ["a", "b"],
}  # fmt: skip


def test_the_log_is_shown_in_words_and_without_what_is_for_debugging(tmp_path: Path) -> None:
    path = tmp_path / "log.jsonl"
    verdicts = (VERDICT | {"cause": "estimate stale", "severity": 3}, VERDICT | {"cause": ""})
    rows = map(json.dumps, (OLD, LATE, SAID, {"event": 3}, *verdicts, COUNTS))
    path.write_text("\n".join((STATE % (1, "a", "b"), "[]", *rows, "")))
    shown = [tuple(line.shown) for line in read_log(path, []) if line.shown is not None]
    assert shown[:3] == [
        ("w", 3.0, "warning", "main", "fault: lag 0.05 s"),
        ("x", None, "warning", "main", "frame late: lateness 51 ms"),
        ("x", None, "info", "main", "resumed: 1_2"),
    ]
    assert [line[-1] for line in shown[3:]] == [
        "danger: estimate stale: 0.31 s (limit 0.15 s), event code 0",
        "danger: all is well again",
        "danger statistics: edges front left 2, held yes, names a, b",
    ]
