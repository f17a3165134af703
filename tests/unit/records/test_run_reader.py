"""Run directories: recordings and surveys that are read, and those that are refused."""

import json
import shutil
import sqlite3
from contextlib import closing
from math import cos, hypot, sin
from pathlib import Path
from typing import Any

import msgspec
import pytest

from ccatp.cli import main
from ccatp.config.load import dump_config, load_config
from ccatp.core import PanelId
from ccatp.errors import ConfigError
from ccatp.filters.base import FilterDiverged
from ccatp.links.robot_codec import RobotFrame, encode
from ccatp.links.robot_messages import CommandEcho, Sensors
from ccatp.links.topics import ArrivalMessage, Message, Rest, SensorLines, TrackMessage, TruthMessage
from ccatp.mirror.mirror import build_mirror
from ccatp.mirror.misalignment import PanelMisalignment
from ccatp.records.recorder import RECORD_FORMAT, Recorder
from ccatp.records.run_reader import RunReadError, open_recordings, read_run
from ccatp.studies import replay as player
from tests.support.command import printed, refused
from tests.support.recorded import make_run, record_truth, recorder_in
from tests.support.scenario import world_of
from tests.unit.mirror.test_panel_alignment import exact_fix


def line_of(seq: int) -> bytes:
    t_s = 0.01 * seq
    still = CommandEcho(-1, 0.0, 0.0, False)
    return encode(RobotFrame(seq, t_s, [(t_s, 0.0, 0.0)], [], [], None, (0.0, 0.0), 1.0, still, ())).strip()


def batch(*seqs: int) -> SensorLines:
    return SensorLines(seq=seqs[-1], t_s=0.01 * seqs[-1], lines=[msgspec.Raw(line_of(seq)) for seq in seqs])


def track(*seqs: int) -> TrackMessage:
    rows = [(seq, 0.01 * seq, 1, 2, 0.001 * seq, 0.0, 0.0, 1e-3) for seq in seqs]
    return TrackMessage(seq=seqs[-1], t_s=0.01 * seqs[-1], rows=rows)


def record(run_dir: Path, messages: list[tuple[str, Message]], **metadata: str) -> Path:
    run_dir.mkdir(exist_ok=True)
    recorder = recorder_in(run_dir, metadata)
    for name, message in messages:
        recorder.write(name, message.t_s, msgspec.json.encode(message))
    recorder.close()
    return recorder.path


@pytest.fixture
def config_text() -> str:
    return dump_config(load_config(None, {"run.filter": "kf", "run.seed": 5}))


def test_what_a_recording_holds(tmp_path: Path, config_text: str) -> None:
    truth = TruthMessage(seq=0, t_s=0.0, rows=[(0, 0.0, 1.0, 2.0, 0.5, 1.0, 2.0, 3.0, 0.1, 0, 0)])
    record(
        tmp_path,
        [
            ("rest", Rest(seq=1, t_s=0.01)),
            ("arrival", ArrivalMessage(seq=1, t_s=0.01, point=(1, 2, 3), error_mm=1.0)),
            ("track", track(0, 1)),
            ("sensors", batch(0, 1)),
            ("truth", truth),
        ],
        config=config_text,
        format=str(RECORD_FORMAT),
    )
    (recording,) = open_recordings(tmp_path)
    found = list(recording.messages())
    assert isinstance(found[0].message, Rest)
    assert [(one.number, one.t_s) for one in found] == [(1, 0.01), (0, 0.0), (1, 0.01)]
    assert isinstance(found[2].message, Sensors)
    assert found[2].message.imu[0].t_s == 0.01
    cfg = recording.config({})
    assert (cfg.run.seed, cfg.run.filter) == (5, "kf")
    assert recording.recorded(build_mirror(cfg.mirror)).seq.tolist() == [0, 1]
    known = recording.truth()
    assert known is not None
    assert known.pose.tolist() == [[1.0, 2.0, 0.5]]
    assert known.height_m.tolist() == [3.0]
    assert recording.arrivals == [1]
    assert recording.is_simulation
    assert not recording.warnings


def test_each_part_of_a_resumed_run_has_the_configuration_it_ran_with(tmp_path: Path, config_text: str) -> None:
    record(tmp_path, [("sensors", batch(0))], config=config_text)
    later = dump_config(load_config(None, {"run.filter": "ekf", "run.seed": 6}))
    record(tmp_path, [("sensors", batch(0))], config=later)
    (tmp_path / "config.toml").write_text(later)
    parts = open_recordings(tmp_path)
    assert [part.config({}).run.seed for part in parts] == [5, 6]
    assert [part.config({"run.filter": "ukf"}).run.filter for part in parts] == ["ukf", "ukf"]


def test_an_older_recording_is_read_with_the_configuration_beside_it(tmp_path: Path, config_text: str) -> None:
    record(tmp_path, [("sensors", batch(0))])
    (tmp_path / "config.toml").write_text(config_text)
    assert open_recordings(tmp_path)[0].config({}).run.seed == 5


def test_a_session_without_a_frame_is_left_out_and_named(tmp_path: Path, config_text: str) -> None:
    """A resume that was refused leaves such a recording; the frames of the run are in an older one."""
    record(tmp_path, [("sensors", batch(0, 1))], config=config_text)
    record(tmp_path, [("rest", Rest(seq=0, t_s=0.0))], config=config_text)
    (recording,) = open_recordings(tmp_path)
    assert (recording.path.name, len(list(recording.messages()))) == ("telemetry.1.mcap", 2)
    assert recording.notes == [f"{tmp_path / 'telemetry.mcap'}: not used, it holds no frame of the robot"]
    (alone,) = open_recordings(tmp_path / "telemetry.mcap")
    assert not alone.has_frames()


def test_missing_frames_are_counted(tmp_path: Path, config_text: str) -> None:
    record(tmp_path, [("sensors", batch(0, 1)), ("sensors", batch(4, 5, 9))], config=config_text)
    (recording,) = open_recordings(tmp_path)
    assert len(list(recording.messages())) == 5
    assert recording.warnings == [f"{recording.path}: 5 frames are missing in between"]


def test_what_cannot_be_read_is_not_used_and_reported_once(tmp_path: Path, config_text: str) -> None:
    bad = SensorLines(seq=1, t_s=0.01, lines=[msgspec.Raw(b'{"type":"sensors"}')])
    record(tmp_path, [("sensors", batch(0)), ("sensors", bad), ("sensors", bad)], config=config_text)
    (recording,) = open_recordings(tmp_path)
    assert len(list(recording.messages())) == 1
    (warning,) = recording.warnings
    assert "what cannot be read is not used" in warning


def test_a_torn_file_is_read_up_to_its_damage(tmp_path: Path, config_text: str) -> None:
    batches: list[tuple[str, Message]] = [("sensors", batch(*range(k, k + 100))) for k in range(0, 3000, 100)]
    path = record(tmp_path, batches, config=config_text)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    (recording,) = open_recordings(tmp_path)
    frames = [one.number for one in recording.messages()]
    assert frames == list(range(len(frames)))
    assert 100 <= len(frames) < 3000
    (warning,) = recording.warnings
    assert "damaged or cut off" in warning
    assert f"its last frame is of {0.01 * frames[-1]:.2f} s" in warning


def test_what_is_no_run(tmp_path: Path, config_text: str) -> None:
    with pytest.raises(RunReadError, match="no such directory; name the directory of a run"):
        open_recordings(tmp_path / "none")
    with pytest.raises(RunReadError, match=r"no telemetry\.mcap there"):
        open_recordings(tmp_path)
    record(tmp_path, [])
    with pytest.raises(RunReadError, match=r"no config\.toml there"):
        open_recordings(tmp_path)


@pytest.mark.parametrize("number", [str(RECORD_FORMAT + 1), "two"])
def test_a_newer_format_is_refused(number: str, tmp_path: Path, config_text: str) -> None:
    record(tmp_path, [], config=config_text, format=number, ccatp="9.9")
    with pytest.raises(RunReadError, match=rf"recorded in format {number} by ccatp 9\.9, this one reads up to"):
        open_recordings(tmp_path)


def test_a_file_that_cannot_be_read(tmp_path: Path) -> None:
    (tmp_path / "telemetry.mcap").mkdir()
    with pytest.raises(RunReadError, match="cannot be read: Is a directory"):
        open_recordings(tmp_path)


# -- the command -------------------------------------------------------------------------------------------------------


def replay(capsys: pytest.CaptureFixture[str], *argv: object) -> tuple[int, str, str]:
    status = main(["replay", *map(str, argv)])
    out, err = capsys.readouterr()
    return status, out, err


@pytest.fixture
def run_dir(tmp_path: Path, config_text: str) -> Path:
    frames = range(200)
    record(tmp_path / "run", [("sensors", batch(*frames)), ("track", track(*frames))], config=config_text)
    return tmp_path / "run"


def test_a_replay_as_json_and_nothing_else(run_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, out, err = replay(capsys, run_dir, "--json", "--filter", "ekf")
    result: dict[str, Any] = json.loads(out)
    assert (status, err) == (0, "")
    assert result["frames"] == 200
    assert result["filter"] == "ekf"
    assert result["settings"] == {"run.filter": "ekf"}
    assert result["reference"] == "recorded"
    assert result["difference"]["position_mm"]["max"] > 1.0  # the record was made by hand


def test_the_table_and_the_csv(run_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, out, err = replay(capsys, run_dir, "--out", tmp_path / "o.csv")
    assert "error against the recorded estimate" in out
    # The record was made by hand: nothing could reproduce it, and that is an error.
    assert status == 1
    assert "does not reproduce the recorded estimates" in err
    assert len((tmp_path / "o.csv").read_text().splitlines()) == 201
    # Another setting is asked to change something.
    status, out, err = replay(capsys, run_dir, "--filter", "ekf")
    assert (status, err) == (0, "")
    assert out.endswith("the replay differs from the recorded estimates\n")


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["--filter", "efk"], "run.filter = \"efk\" must be 'kf', 'ekf' or 'ukf'; did you mean ekf?"),
        (
            ["--set", "localizer.four_state.slip_fractoin=1"],
            "is unknown; did you mean localizer.four_state.slip_fraction?",
        ),
        (
            ["--set", "localizer.four_state.slip_fraction=-1"],
            "localizer.four_state.slip_fraction = -1 must be greater than or equal to 0",
        ),
        (["--set", "control.gains=thesis"], "control.gains: has no effect on a replay"),
        (["--smooth"], "--smooth: the pose is no state of filter kf; choose --filter ekf or ukf"),
        (["--out", "/nowhere/o.csv"], "--out: no directory /nowhere; make it first"),
        (["--out", "/proc/o.csv"], "--out: cannot write /proc/o.csv"),
    ],
)
def test_misuse_is_one_line_and_exit_2(
    argv: list[str], message: str, run_dir: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert message in refused(capsys, "replay", run_dir, *argv)


def test_a_recording_without_frames_is_one_line(
    tmp_path: Path, config_text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = record(tmp_path, [], config=config_text)
    assert replay(capsys, tmp_path) == (2, "", f"ccatp: {path}: no sensors frames in it\n")


def test_an_estimator_that_gives_up_is_one_line(
    run_dir: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def give_up(*_: object, **__: object) -> None:
        raise FilterDiverged("smoothed states are not finite among 7 steps")

    monkeypatch.setattr(player, "replay", give_up)
    why = "the estimator gave up: smoothed states are not finite among 7 steps; try other settings"
    assert refused(capsys, "replay", run_dir) == f"ccatp: {run_dir}/telemetry.mcap: {why}\n"


def test_warnings_go_to_standard_error(tmp_path: Path, config_text: str, capsys: pytest.CaptureFixture[str]) -> None:
    record(tmp_path, [("sensors", batch(0, 1, 5))], config=config_text)
    status, out, err = replay(capsys, tmp_path, "--json")
    assert status == 0
    assert err == f"ccatp: warning: {tmp_path}/telemetry.mcap: 3 frames are missing in between\n"
    assert json.loads(out)["warnings"] == [err.removeprefix("ccatp: warning: ").rstrip()]


CFG, M1 = world_of()
PANEL = PanelId(3, 7)
LIES = PanelMisalignment(1e-5, 2e-5, -3e-5)
POINTS = M1.point_ids(PANEL)


@pytest.fixture
def survey_dir(tmp_path: Path) -> Path:
    """Nine points planned, five of them measured."""
    return make_run(tmp_path / "run", CFG, POINTS, [exact_fix(M1, p, LIES) for p in POINTS[:5]], {PANEL: LIES})


def test_a_run_is_read(survey_dir: Path) -> None:
    found = read_run(survey_dir, {})
    assert found.cfg == CFG
    assert found.planned == POINTS
    assert [one.point for one in found.measured] == list(POINTS[:5])
    assert found.measured[2] == exact_fix(M1, POINTS[2], LIES)
    assert found.injected == {PANEL: (1e-5, 2e-5, -3e-5)}
    assert (found.is_simulation, found.warnings) == (True, ())


def test_overrides_act(survey_dir: Path) -> None:
    assert read_run(survey_dir, {"robot.puck_height_m": 0.06}).cfg.robot.puck_height_m == 0.06
    with pytest.raises(ConfigError, match="puck_height"):
        read_run(survey_dir, {"robot.puck_height_m": "high"})


def test_a_run_that_continues_is_read_beside_its_writer(survey_dir: Path) -> None:
    with closing(sqlite3.connect(survey_dir / "mission.sqlite", isolation_level=None)) as writer:
        writer.execute("BEGIN IMMEDIATE")
        writer.execute("DELETE FROM events")
        assert len(read_run(survey_dir, {}).measured) == 5
        writer.execute("ROLLBACK")


def test_a_run_that_was_killed_in_a_commit_is_read(survey_dir: Path, tmp_path: Path) -> None:
    killed = tmp_path / "killed"
    with closing(sqlite3.connect(survey_dir / "mission.sqlite", isolation_level=None)) as writer:
        writer.execute("PRAGMA journal_mode = PERSIST")
        writer.execute("PRAGMA cache_size = 1")  # pages go to the file before the commit
        writer.execute("BEGIN IMMEDIATE")
        writer.execute("UPDATE points SET status = 'planned', fix_id = NULL, t_s = NULL")
        writer.execute("UPDATE reserve SET filler = zeroblob(3901)")
        shutil.copytree(survey_dir, killed)
        writer.execute("ROLLBACK")
    # Without its journal the copy would show half of the transaction.
    assert (killed / "mission.sqlite").read_bytes() != (survey_dir / "mission.sqlite").read_bytes()
    before = (killed / "mission.sqlite").read_bytes()
    assert [one.point for one in read_run(killed, {}).measured] == list(POINTS[:5])
    assert (killed / "mission.sqlite").read_bytes() == before


def test_a_damaged_fix_is_not_used(survey_dir: Path) -> None:
    with closing(sqlite3.connect(survey_dir / "mission.sqlite")) as db:
        db.execute("UPDATE fixes SET x_m = x_m + 1 WHERE point = 2")
        db.commit()
    found = read_run(survey_dir, {})
    assert [one.point.point for one in found.measured] == [1, 3, 4, 5]
    assert found.warnings == ("point 3/7/2: its stored fix is damaged and not used; measure it again",)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("", "run: no such directory; name the directory of a run"),
        ("config.toml", "run: no config.toml there; name the directory of a run"),
        ("mission.sqlite", "mission.sqlite: no such file; name the directory of a run"),
        ("zeros", "mission.sqlite: damaged or not a mission store: file is not a database"),
    ],
)
def test_what_is_no_run_is_refused_in_one_line(name: str, message: str, survey_dir: Path) -> None:
    if name == "zeros":
        (survey_dir / "mission.sqlite").write_bytes(bytes(5000))
    elif name:
        (survey_dir / name).unlink()
    else:
        shutil.rmtree(survey_dir)
    with pytest.raises(RunReadError, match=message) as caught:
        read_run(survey_dir, {})
    assert "\n" not in str(caught.value)
    assert caught.value.exit_status == 2


@pytest.mark.parametrize(
    ("topic", "is_simulation"),
    [("truth", True), ("misalignment", True), ("misalignments of panels", False), ("", None)],
)
def test_a_run_without_truth_is_read(topic: str, is_simulation: bool | None, survey_dir: Path) -> None:
    """A recording that does not tell it, of a real robot, and none."""
    (survey_dir / "telemetry.mcap").unlink()
    if is_simulation is False:
        record_truth(survey_dir, {PANEL: LIES}, is_simulation=False)
    elif topic:
        recorder = Recorder(survey_dir / "telemetry.mcap", [(topic, {})], is_simulation=True)
        recorder.write(topic, 1.0, b'{"seq": 0}')
        recorder.close()
    found = read_run(survey_dir, {})
    assert (found.injected, found.is_simulation, len(found.measured)) == (None, is_simulation, 5)


def test_a_resumed_run_has_the_truth_of_its_sessions_where_it_is_one(survey_dir: Path) -> None:
    record_truth(survey_dir, {PANEL: LIES})
    assert read_run(survey_dir, {}).injected == {PANEL: (1e-5, 2e-5, -3e-5)}
    record_truth(survey_dir, {PANEL: PanelMisalignment(9e-5, 0.0, 0.0)})
    found = read_run(survey_dir, {})
    assert found.injected is None
    assert found.warnings == (
        "the sessions of this run simulated differently misaligned panels; the truth is not compared",
    )


def test_a_recording_that_cannot_be_read_is_reported(survey_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(path: Path) -> dict[str, str]:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("ccatp.records.run_reader.read_metadata", fails)
    found = read_run(survey_dir, {})
    assert found.injected is None
    assert found.warnings == (
        f"{survey_dir / 'telemetry.mcap'}: cannot be read: Permission denied; the truth is not compared",
    )


def test_a_path_is_exported_as_a_trajectory(
    tmp_path: Path, config_text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    run, estimates, truth = tmp_path / "run", tmp_path / "e.tum", tmp_path / "t.tum"
    rows = [(0, 0.0, 1.0, 2.0, 0.5, 1.0, 2.0, 3.0, 0.1, 0, 0)]
    messages: list[tuple[str, Message]] = [("sensors", batch(0, 1)), ("track", track(0, 1))]
    record(run, [*messages, ("truth", TruthMessage(seq=0, t_s=0.0, rows=rows))], config=config_text, simulation="true")
    (run / "config.toml").write_text(config_text, encoding="utf-8")
    reported = printed(capsys, "recording", "export", run, "--tum", estimates, "--truth", truth)
    assert reported == f"{estimates}: 2 poses\n{truth}: 1 poses\n"
    t_s, *place, qx, qy, qz, qw = map(float, truth.read_text().split())
    assert (t_s, place, qx, qy) == (0.0, [1.0, 2.0, 3.0], 0.0, 0.0)
    assert (qz, qw) == pytest.approx((sin(0.25), cos(0.25)), abs=1e-9)
    begin, end = ([*map(float, line.split())] for line in estimates.read_text().splitlines())
    assert end[0] - begin[0] == pytest.approx(0.01)
    assert hypot(end[1] - begin[1], end[2] - begin[2]) == pytest.approx(0.001, abs=1e-6)  # along a panel that is tilted
    assert "--tum: no directory" in refused(capsys, "recording", "export", run, "--tum", tmp_path / "none" / "e.tum")
    other = tmp_path / "robot"
    record(other, messages, config=config_text)
    (other / "config.toml").write_text(config_text, encoding="utf-8")
    text = refused(capsys, "recording", "export", other, "--tum", estimates, "--truth", truth)
    assert "of a real robot and holds no truth" in text
