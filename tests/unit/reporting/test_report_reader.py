"""What a report is made of, read out of run directories whole, torn, resumed and of real robots."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ccatp.errors import ConfigError
from ccatp.records.recorder import iter_messages
from ccatp.records.run_reader import RunReadError
from ccatp.records.state_log import changes_of, read_log
from ccatp.report.findings import findings_of
from ccatp.report.record import read_record
from tests.unit.reporting.recorded import record


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
    found = findings_of(read_record(record(tmp_path / "real", is_simulation=False)))
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
        "log.jsonl: what the processes said, and when the mission changed its state",
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
