"""What a report is made of: run directories whole, torn, resumed and of real robots; grades of points, times."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from ccatp.core import PointId, Vector3
from ccatp.errors import ConfigError
from ccatp.links.topics import FixMessage, MissionStatus
from ccatp.mirror.panel_alignment import Measured
from ccatp.records.recorder import iter_messages
from ccatp.records.run_reader import RunReadError
from ccatp.records.state_log import StateChange, changes_of, read_log
from ccatp.records.store import StoredPoint
from ccatp.report.findings import (
    Grade,
    error_figures,
    error_series,
    findings_of,
    first_arrivals_mm,
    least_times,
    point_verdicts,
    sampled_spells,
    spells_of,
    time_budget,
)
from ccatp.report.record import RecordedSession, RunRecord, changed_keys, read_record
from ccatp.survey.composition import assemble
from tests.unit.reporting.recorded import record as record_run


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


# -- run directories --------------------------------------------------------------------------------------------------


def test_a_whole_run(recorded: Path) -> None:
    found = read_record(recorded)
    assert (found.missing, found.warnings) == ((), ())
    assert (found.name, found.is_simulation, found.has_truth) == ("tonight", True, True)
    (session,) = found.sessions
    assert session.version == "0.0.test"
    assert session.truth is not None
    assert len(session.track.seq) == len(set(session.track.seq.tolist())) > 1000
    assert [arrived.point[2] for arrived in session.arrivals] == [7, 8, 9, 6, 5, 4, 1, 2, 3]
    assert found.points is not None
    assert [row.status for row in found.points] == ["measured"] * 9
    assert found.changed["run.panels"] == (1, 0)
    assert not [key for key in found.changed if key.startswith(("world", "mirror"))]
    assert found.injected is not None
    assert [line.text for line in found.log][-1] == "run finished: status 0"


def test_the_track_is_on_the_deck(recorded: Path) -> None:
    found = read_record(recorded)
    (session,) = found.sessions
    base = found.mirror.base_pose
    assert session.track.place_m[0, :2] == pytest.approx([base.x_m, base.y_m], abs=0.01)
    assert session.truth is not None
    x_m, y_m, z_m = session.track.place_m[500].tolist()
    assert z_m == pytest.approx(found.mirror.surface.point(x_m, y_m)[2], abs=1e-9)


def test_nothing_is_written(run_dir: Path) -> None:
    before = {path.name: path.read_bytes() for path in run_dir.iterdir()}
    read_record(run_dir)
    assert {path.name: path.read_bytes() for path in run_dir.iterdir()} == before


def test_a_run_that_was_killed(without: Callable[..., Path]) -> None:
    run_dir = without("summary.json")
    telemetry, log = run_dir / "telemetry.mcap", run_dir / "log.jsonl"
    telemetry.write_bytes(telemetry.read_bytes()[: telemetry.stat().st_size // 2])
    log.write_text(log.read_text()[:-30])
    found = read_record(run_dir)
    assert found.missing == ("summary.json: the run goes on, or was killed before its end",)
    torn, line = sorted(found.warnings, reverse=True)
    assert torn.startswith("telemetry.mcap: damaged or cut off before byte ")
    assert torn.endswith("; what came before it is in this report")
    assert line == "log.jsonl: 1 lines cannot be read and are left out"
    assert len(found.sessions[0].track.seq) > 500
    ended = findings_of(found).outcome
    assert (ended.text, ended.is_good) == ("no end is recorded", False)


def test_a_recording_torn_in_its_first_bytes(run_dir: Path) -> None:
    telemetry = run_dir / "telemetry.mcap"
    telemetry.write_bytes(telemetry.read_bytes()[:20])
    found = findings_of(read_record(run_dir))
    assert (found.errors, found.budget, found.outcome.text) == (None, None, "no mission")
    assert found.alignment is not None  # the fixes are in the database


def test_a_real_robot_has_no_truth(tmp_path: Path) -> None:
    found = findings_of(read_record(record_run(tmp_path / "real", is_simulation=False)))
    record_ = found.record
    assert (record_.is_simulation, record_.has_truth, record_.injected) == (False, False, None)
    assert record_.missing == ()
    assert found.errors is not None
    assert np.isnan(found.errors.error_mm).all()
    assert (found.figures, found.against) == (None, None)
    # The laser saw each arrival to some micrometres.
    assert all(verdict.first_mm is not None for verdict in found.points)


def test_truth_and_laser_tell_the_same_of_arrivals(recorded: Path) -> None:
    whole = read_record(recorded)
    (session,) = whole.sessions
    import dataclasses

    blind = dataclasses.replace(whole, sessions=(dataclasses.replace(session, truth=None),))
    for seen, true in zip(findings_of(blind).points, findings_of(whole).points, strict=True):
        assert seen.first_mm == pytest.approx(true.first_mm, rel=0.02, abs=0.02)  # curved surface, noise


def test_what_is_missing_is_told(without: Callable[..., Path]) -> None:
    found = read_record(without("telemetry.mcap", "mission.sqlite", "summary.json", "log.jsonl"))
    assert found.missing == (
        "log.jsonl: log of the processes, and when the mission changed its state",
        "telemetry.mcap: path, estimates, arrivals and fixes over time",
        "mission.sqlite: points, their fixes, and how the panels lie",
        "summary.json: the run goes on, or was killed before its end",
    )
    assert (found.is_simulation, found.points, found.sessions) == (None, None, ())


def test_a_run_without_its_log_has_sampled_states(without: Callable[..., Path]) -> None:
    found = findings_of(read_record(without("log.jsonl")))
    assert found.budget is not None
    assert not found.budget.is_exact


@pytest.mark.parametrize("text", ["{", "[1, 2]", "null"])
def test_a_spoilt_summary_is_left_out(text: str, run_dir: Path) -> None:
    (run_dir / "summary.json").write_text(text)
    found = read_record(run_dir)
    assert found.summary is None
    assert found.warnings[0].startswith("summary.json: ")


def test_a_spoilt_database_is_left_out(run_dir: Path) -> None:
    (run_dir / "mission.sqlite").write_bytes(bytes(5000))
    found = read_record(run_dir)
    assert found.points is None
    assert found.warnings == ("mission.sqlite: damaged or not a mission store: file is not a database",)


def test_messages_of_another_version_are_left_out(run_dir: Path) -> None:
    from ccatp.records.recorder import Recorder

    (run_dir / "telemetry.mcap").unlink()
    recorder = Recorder(run_dir / "telemetry.mcap", [("track", {}), ("fix", {})], is_simulation=False)
    recorder.write("track", 1.0, b'{"seq":1,"t_s":1.0,"rows":[[0,0.0,99,99,0,0,0,0]]}')
    recorder.write("fix", 1.0, b'{"seq":1,"t_s":1.0,"where":"here"}')
    recorder.close()
    found = read_record(run_dir)
    lost, other = found.warnings
    assert lost.startswith("telemetry.mcap: 1 messages cannot be read and are left out: topic fix: ")
    assert other.startswith("telemetry.mcap: its estimates are not of this mirror and are left out: ")


def test_a_resumed_run_has_its_sessions_one_after_the_other(run_dir: Path) -> None:
    shutil.copy(run_dir / "telemetry.mcap", run_dir / "telemetry.1.mcap")
    log = (run_dir / "log.jsonl").read_text()
    (run_dir / "log.jsonl").write_text(log + log)
    once = findings_of(read_record(run_dir))
    assert [session.name for session in once.record.sessions] == ["telemetry.1.mcap", "telemetry.mcap"]
    errors, budget = once.errors, once.budget
    assert errors is not None
    assert budget is not None
    assert (np.diff(errors.t_s) >= 0.0).all()
    span_s = once.record.sessions[0].span_s
    assert list(errors.breaks_s) == pytest.approx([span_s])
    assert errors.t_s[-1] == pytest.approx(2.0 * span_s)
    assert budget.is_exact
    assert budget.total_s == pytest.approx(2.0 * span_s)


def test_no_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RunReadError, match="nothing: no such directory; name the directory of a run"):
        read_record(tmp_path / "nothing")
    with pytest.raises(RunReadError, match=r"no config\.toml there; name the directory of a run"):
        read_record(tmp_path)
    (tmp_path / "config.toml").write_text('system = "cricket"\n')
    with pytest.raises(RunReadError, match=r"a mission among beacons; this is for surveys"):
        read_record(tmp_path)
    (tmp_path / "config.toml").write_text("[run]\nspeed = 1\n")
    with pytest.raises(ConfigError, match=r"run\.speed is unknown"):
        read_record(tmp_path)


def test_recordings_that_cannot_be_opened_are_told(run_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(path: Path) -> dict[str, str]:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr("ccatp.report.record.read_metadata", refuse)
    found = read_record(run_dir)
    assert found.sessions == ()
    assert "telemetry.mcap: cannot be read: Permission denied" in found.warnings


def lines(*texts: str) -> str:
    return "\n".join(texts) + "\n"


STATE = '{"logger":"main","seq":%d,"before":"%s","after":"%s","event":"state_changed","level":"debug","timestamp":"w"}'
RUN = '{"logger":"supervisor","event":"run_started","level":"info","timestamp":"w"}'
OLD_STATE = '{"process":"main","seq":%d,"before":"%s","after":"%s","event":"state","level":"debug","wall":"w"}'
OLD_RUN = '{"process":"supervisor","event":"run","level":"info","wall":"w"}'


@pytest.mark.parametrize(("run", "state"), [(RUN, STATE), (OLD_RUN, OLD_STATE)], ids=["now", "older"])
def test_the_log_tells_states_by_session(tmp_path: Path, run: str, state: str) -> None:
    path = tmp_path / "log.jsonl"
    path.write_text(
        lines(
            run, state % (3, "idle", "turning"), "torn {", run, state % (8, "idle", "held"), state % (5, "held", "idle")
        )
    )
    warnings: list[str] = []
    read = list(read_log(path, warnings))
    assert warnings == ["log.jsonl: 1 lines cannot be read and are left out"]
    first, second = changes_of(read, 2)
    assert [tuple(change) for change in first] == [(3, "idle", "turning")]
    assert second == ()  # the frames count anew: their times are not known
    assert changes_of(read, 1) == [()]  # a recording is missing, so nobody knows which


def test_the_log_is_shown_without_what_is_for_debugging(tmp_path: Path) -> None:
    path = tmp_path / "log.jsonl"
    odd = {"process": "main", "event": "fault", "level": "warning", "wall": "w", "t_s": 3, "lag_s": 0.05, "why": ""}
    new = {"logger": "main", "event": "frame_late", "level": "warning", "timestamp": "x", "lateness_ms": 51.0}
    said = {"logger": "main", "event": "operator_message", "level": "info", "timestamp": "x", "text": "going on: 1_2"}
    rest = map(json.dumps, (odd, new, said, {"event": 3}))
    path.write_text(lines(STATE % (1, "a", "b"), "[]", *rest))
    read = list(read_log(path, []))
    shown = [line.shown for line in read if line.shown is not None]
    assert [tuple(line) for line in shown] == [
        ("w", 3.0, "warning", "main", "fault: lag 0.05 s"),
        ("x", None, "warning", "main", "frame late: lateness 51 ms"),
        ("x", None, "info", "main", "going on: 1_2"),
    ]


def test_fields_of_the_log_are_words(tmp_path: Path) -> None:
    path = tmp_path / "log.jsonl"
    verdict = {
        "logger": "danger",
        "event": "verdict_changed",
        "code": 0,
        "signal": "estimate",
        "value": 0.31,
        "limit": 0.15,
    }
    counts = {"logger": "danger", "event": "danger_statistics", "edges": {"front_left": 2}, "held": True, "denied": {}}
    path.write_text(
        lines(
            json.dumps(verdict | {"cause": "estimate stale", "severity": 3}),
            json.dumps(verdict | {"cause": ""}),
            json.dumps(counts | {"names": ["a", "b"]}),
        )
    )
    assert [line.shown.text for line in read_log(path, []) if line.shown is not None] == [
        "danger: estimate stale: 0.31 s (limit 0.15 s), event code 0",
        "danger: all is well again",
        "danger statistics: edges front left 2, held yes, names a, b",
    ]


def test_every_topic_that_is_read_is_recorded(recorded: Path) -> None:
    from ccatp.links.topics import BY_NAME
    from ccatp.report.record import TOPICS_READ

    assert all(BY_NAME[name].recorded for name in TOPICS_READ)
    assert {message.topic for message in iter_messages(recorded / "telemetry.mcap")} >= TOPICS_READ - {"danger_event"}
