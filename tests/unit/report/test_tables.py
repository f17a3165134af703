"""A survey for other tools: tables that astropy reads, ROS 2 bags read by rosbags, trajectories judged by evo."""

import csv
import json
import shutil
import sqlite3
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from astropy.table import Table
from rosbags.highlevel import AnyReader
from rosbags.interfaces import ConnectionExtRosbag2, QosDurability
from scipy.spatial.transform import Rotation

from ccatp.cli import main
from ccatp.errors import ConfigError
from ccatp.links.robot_messages import Sensors
from ccatp.links.topics import DangerEvent, MissionStatus
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.records.recorder import iter_logged
from ccatp.records.run_reader import Recording, Trace, in_order, open_recordings
from ccatp.report.run_page import report_run
from ccatp.studies.replay import replay
from tests.support.command import answered, printed, refused
from tests.support.recorded import record, recorder_in
from tests.unit.records.test_recorder import full_beyond

# What a header of YAML in comments could take for something else.
OPERATOR = 'J. D\u00f6\u00e9: "night" # {1}, \u2028 \\ \U0001f52d \''
FIX = (
    "x_m", "y_m", "z_m", "cov_xx_m2", "cov_xy_m2", "cov_xz_m2", "cov_yy_m2", "cov_yz_m2", "cov_zz_m2", "t_s", "dop",
    "residual_rms_m",
)  # fmt: skip
UNITS = {"t_s": "s", "x_m": "m", "cov_xx_m2": "m2", "deviation_um": "um", "first_arrival_mm": "mm", "dop": None}


@pytest.fixture(scope="module")
def survey(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four points of one panel, aborted, with metadata; its tables in ``tables``."""
    run_dir = record(
        tmp_path_factory.mktemp("tables") / "tonight",
        only=4,
        observation__telescope="FYST",
        observation__operator=OPERATOR,
        observation__robot_serial_number="7",
        observation__laser_serial_number="null",
        observation__retroreflector_serial_number="0012",
    )
    report_run(run_dir, tables_dir=run_dir / "tables")
    return run_dir


def read(run_dir: Path, name: str) -> Any:
    return Table.read(run_dir / "tables" / f"{name}.ecsv", format="ascii.ecsv")


def test_fixes_are_those_of_the_database(survey: Path) -> None:
    table = read(survey, "fixes")
    for name, unit in UNITS.items():
        assert table[name].unit == unit
    assert (table["row"].dtype, table["x_m"].dtype, table["status"].dtype.kind) == (np.int64, np.float64, "U")
    with closing(sqlite3.connect(survey / "mission.sqlite")) as db:
        points = db.execute("SELECT row, col, point, status FROM points ORDER BY row, col, point").fetchall()
        fixes = db.execute(f"SELECT row, col, point, {', '.join(FIX)} FROM fixes").fetchall()
    assert [tuple(row) for row in table["row", "col", "point", "status"]] == points
    stored = {row[:3]: row[3:] for row in fixes}
    assert 4 <= len(stored) < 9
    for row in table:
        values = stored.get((row["row"], row["col"], row["point"]))
        if values is None:
            assert all(np.ma.is_masked(row[name]) for name in (*FIX, "channels", "deviation_um", "first_arrival_mm"))
        else:
            assert tuple(row[FIX]) == values  # to the last bit
            assert row["channels"].split()


def test_panels_and_moves_are_those_of_the_alignment(survey: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (panel,) = answered(capsys, "align", survey)["panels"]
    (row,) = read(survey, "panels")
    found = read(survey, "panels")
    assert [str(found[name].unit) for name in ("piston_um", "tip_urad", "sigma_tilt_urad")] == ["um", "urad", "urad"]
    assert [row["piston_um"], row["tip_urad"], row["tilt_urad"]] == [
        panel["piston_um"], panel["tip_urad"], panel["tilt_urad"],
    ]  # fmt: skip
    assert [row[f"sigma_{name}"] for name in ("piston_um", "tip_urad", "tilt_urad")] == panel["sigma"]
    assert np.ma.is_masked(row["outliers"])
    moves = read(survey, "moves")
    assert moves["move_um"].unit == "um"
    assert list(moves["move_um"]) == panel["adjusters_um"]
    assert list(moves["sigma_move_um"]) == panel["adjusters_sigma_um"]
    assert list(moves["adjuster"]) == ["V1", "V2", "V3", "V4", "V5"]
    # A move takes the fitted plane away where the adjuster is.
    plane = panel["piston_um"] + panel["tip_urad"] * moves["y_m"] + panel["tilt_urad"] * moves["x_m"]
    assert np.allclose(moves["move_um"], -plane, rtol=0.0, atol=1e-3)  # 1 nm: places are rounded to 1 um


def test_the_worst_corner_is_that_of_the_plane(survey: Path) -> None:
    (row,) = read(survey, "panels")
    # A panel of fyst-m1 is 0.67 m by 0.75 m, a little more along its slopes.
    reach = abs(row["tilt_urad"]) * 0.67 / 2.0 + abs(row["tip_urad"]) * 0.75 / 2.0
    assert abs(row["worst_corner_um"]) == pytest.approx(abs(row["piston_um"]) + reach, rel=0.03)
    # Four points lie to one side, so its parts are correlated; standard deviations obey the triangle all the same.
    parts_um = [row["sigma_piston_um"], row["sigma_tilt_urad"] * 0.67 / 2.0, row["sigma_tip_urad"] * 0.75 / 2.0]
    assert 2.0 * max(parts_um) - sum(parts_um) < 1.03 * row["sigma_worst_corner_um"] < 1.06 * sum(parts_um)
    assert row["sigma_worst_corner_um"] > 0.0


@pytest.mark.parametrize("name", ["fixes", "panels", "moves"])
def test_every_table_says_what_it_is_of(survey: Path, name: str) -> None:
    reported = read(survey, name).meta
    assert reported["operator"] == OPERATOR
    assert (reported["telescope"], reported["mirror"], reported["run"]) == ("FYST", "fyst-m1", "tonight")
    assert reported["robot_serial_number"] == "7"
    assert reported["laser_serial_number"] == "null"  # not a null of YAML
    assert reported["retroreflector_serial_number"] == "0012"  # nor a number
    assert reported["date_obs"] == reported["date_end"] == "2026-01-01T12:00:00.5Z"
    assert "comment" not in reported
    assert reported["points_of_the_mirror"] == 9 * reported["panels_of_the_mirror"]
    lines = (survey / "tables" / f"{name}.csv").read_text(encoding="utf-8").split("\n")
    head = [line for line in lines if line.startswith("#")]
    assert '# telescope: "FYST"' in head
    rows = list(csv.DictReader(line for line in lines if not line.startswith("#")))
    table = read(survey, name)
    assert len(rows) == len(table)
    assert list(rows[0]) == table.colnames


def test_panels_without_a_result_have_masked_values(tmp_path: Path) -> None:
    run_dir = record(tmp_path / "short", only=1)
    report_run(run_dir, tables_dir=run_dir / "tables")
    (row,) = read(run_dir, "panels")
    assert row["points"] < 3
    assert np.ma.is_masked(row["piston_um"])
    assert len(read(run_dir, "moves")) == 0
    (run_dir / "mission.sqlite").unlink()
    report_run(run_dir, tables_dir=tmp_path / "none")
    assert len(Table.read(tmp_path / "none" / "fixes.ecsv", format="ascii.ecsv")) == 0
    assert sorted(path.name for path in (tmp_path / "none").iterdir()) == ["fixes.csv", "fixes.ecsv"]


def test_the_command_writes_tables(survey: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    reported = answered(capsys, "report", survey, "--out", tmp_path / "a.html", "--tables", tmp_path / "tables")
    assert reported["observation"]["operator"] == OPERATOR
    assert reported["coverage"]["panels_determined"] == 1
    assert len(list((tmp_path / "tables").iterdir())) == 6
    page = (tmp_path / "a.html").read_text()
    for text in ("FYST", "J. D\u00f6\u00e9: &#34;night&#34;", "robot serial number", "0012"):
        assert text in page
    (tmp_path / "file").write_text("")
    assert "cannot be written" in refused(capsys, "report", survey, "--tables", tmp_path / "file" / "tables")
    assert "FITS: TELESCOP" in printed(capsys, "config", "schema")


def test_a_table_that_cannot_be_written_is_named(survey: Path, tmp_path: Path) -> None:
    (tmp_path / "tables" / "fixes.csv").mkdir(parents=True)
    with pytest.raises(ConfigError, match=r"fixes\.csv: cannot be written: Is a directory"):
        report_run(survey, tmp_path / "a.html", tables_dir=tmp_path / "tables")


# -- recordings: ROS 2 bags read back by rosbags, trajectories judged by evo -------------------------------------------

NS = 1_000_000_000


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("recorded") / "run", only=2)


@pytest.fixture(scope="module")
def recording(run_dir: Path) -> Recording:
    return open_recordings(run_dir)[-1]


@pytest.fixture(scope="module")
def mirror(recording: Recording) -> Mirror:
    return build_mirror(recording.config({}).mirror)


@pytest.fixture(scope="module")
def frames(recording: Recording) -> list[Sensors]:
    return [one.message for one in recording.messages() if isinstance(one.message, Sensors)]


@pytest.fixture(scope="module")
def truth(recording: Recording, frames: list[Sensors]) -> Trace:
    found = recording.truth()  # of the messages that were read
    assert found is not None
    return found


@pytest.fixture(scope="module")
def estimates(recording: Recording, mirror: Mirror, frames: list[Sensors]) -> Trace:
    return recording.recorded(mirror)


@pytest.fixture(scope="module")
def bag(run_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bags") / "new" / "bag"
    assert main(["recording", "export", str(run_dir), "--ros2", str(folder)]) == 0
    return folder


def messages(bag: Path, *topics: str) -> Iterator[tuple[str, int, Any]]:
    with AnyReader([bag]) as reader:
        connections = [one for one in reader.connections if not topics or one.topic in topics]
        for connection, time_ns, data in reader.messages(connections):
            yield connection.topic, time_ns, reader.deserialize(data, connection.msgtype)


def utc_offset_ns(recording: Recording) -> int:
    """UTC minus the robot's clock, which in a simulation is the same all the time."""
    (offset,) = {found for found, (topic, t_s, _) in iter_logged(recording.path) if t_s > 0.0 and topic == "sensors"}
    assert offset is not None
    return offset


def stamp_ns(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec) * NS + int(stamp.nanosec)


def test_every_sample_is_a_message_of_its_own(
    bag: Path, recording: Recording, frames: list[Sensors], estimates: Trace, truth: Trace
) -> None:
    recorded = Counter(topic for _, (topic, *_) in iter_logged(recording.path))
    assert Counter(topic for topic, *_ in messages(bag)) == {
        "/imu": sum(len(frame.imu) for frame in frames),
        "/joint_states": sum(len(frame.enc) for frame in frames),
        "/odom": len(estimates.seq),
        "/tf": len(estimates.seq),
        "/ground_truth/odom": len(truth.seq),
        "/laser/position": recorded["fix"],
        "/diagnostics": recorded["mission"],
        "/tf_static": 1,
    }


def test_samples_have_their_own_times_in_utc(bag: Path, recording: Recording, frames: list[Sensors]) -> None:
    offset_ns = utc_offset_ns(recording)
    inertial = [sample for frame in frames for sample in frame.imu]
    wheels = [sample for frame in frames for sample in frame.enc]
    found = list(messages(bag, "/imu"))
    assert [(time_ns, stamp_ns(one)) for _, time_ns, one in found] == [
        (offset_ns + round(t_s * NS), offset_ns + round(t_s * NS)) for t_s, *_ in inertial
    ]
    assert [(one.linear_acceleration.x, one.angular_velocity.z) for *_, one in found] == [
        (sample.ax_m_s2, sample.wz_rad_s) for sample in inertial
    ]
    *_, first = found[0]
    assert first.header.frame_id == "imu_link"
    assert first.orientation_covariance[0] == -1.0  # not measured, by the message's definition
    assert 0.0 < first.angular_velocity_covariance[8] < first.angular_velocity_covariance[0]
    rates = list(messages(bag, "/joint_states"))
    assert [(stamp_ns(one), *one.velocity) for *_, one in rates] == [
        (offset_ns + round(t_s * NS), right, left) for t_s, right, left in wheels
    ]
    assert rates[0][2].name == ["wheel_right", "wheel_left"]


def test_odometry_is_the_recorded_estimate_with_the_covariance_of_the_replay(
    bag: Path, recording: Recording, mirror: Mirror, estimates: Trace
) -> None:
    cfg = recording.config({})
    replayed = replay(cfg, mirror, in_order(recording.messages())).trace
    assert replayed.covariance is not None
    found = [one for *_, one in messages(bag, "/odom")]
    assert {(one.header.frame_id, one.child_frame_id) for one in found} == {("map", "base_link")}
    offset_ns = utc_offset_ns(recording)
    assert [stamp_ns(one) for one in found] == [offset_ns + round(t_s * NS) for t_s in estimates.t_s.tolist()]
    places = [(one.pose.pose.position.x, one.pose.pose.position.y, one.pose.pose.position.z) for one in found]
    np.testing.assert_allclose(places, estimates.place, rtol=0.0, atol=1e-12)
    covariances = np.array([one.pose.covariance.reshape(6, 6) for one in found])
    np.testing.assert_array_equal(covariances[:, [[0], [1], [5]], [0, 1, 5]], replayed.covariance)
    q = found[-1].pose.pose.orientation
    ahead, left, up = Rotation.from_quat((q.x, q.y, q.z, q.w)).as_matrix().T
    last = mirror.robot_axes(type(mirror.base_pose)(*estimates.pose[-1].tolist()))
    np.testing.assert_allclose((ahead, left, up), last, atol=1e-12)


def test_the_twist_is_that_of_the_path(bag: Path, truth: Trace) -> None:
    speed_m_s = np.linalg.norm(np.diff(truth.place, axis=0), axis=1) / np.diff(truth.t_s)
    turn_rad_s = np.diff(np.unwrap(truth.pose[:, 2])) / np.diff(truth.t_s)
    found = [one.twist for *_, one in messages(bag, "/odom")]
    n = min(len(found), len(turn_rad_s))
    v = np.array([one.twist.linear.x for one in found[:n]])
    w = np.array([one.twist.angular.z for one in found[:n]])
    # wheels slip by some per cent in a hard world, and a step of the truth is half a frame older
    assert np.abs(np.abs(v) - speed_m_s[:n]).mean() < 0.05 * np.abs(v).max()
    assert np.corrcoef(w, turn_rad_s[:n])[0, 1] > 0.95  # the fans shake the robot
    variances = np.array([np.diag(one.covariance.reshape(6, 6)) for one in found[:n]])
    assert (variances[:, [0, 5]] > 0.0).all()
    assert variances[np.abs(v) > 0.05, 0].min() > variances[np.abs(v) < 1e-3, 0].max()  # slip grows with the speed


def test_frames_lead_from_the_world_to_every_sensor(bag: Path, recording: Recording, mirror: Mirror) -> None:
    ((*_, fixed),) = messages(bag, "/tf_static")
    parents = {one.child_frame_id: one for one in fixed.transforms}
    assert {name: one.header.frame_id for name, one in parents.items()} == {
        "map": "world",
        **dict.fromkeys(("imu_link", "puck_link"), "base_link"),
        **{f"edge_{end}_{side}_link": "base_link" for end in ("front", "rear") for side in ("left", "right")},
    }
    robot, front = recording.config({}).robot, parents["edge_front_left_link"].transform.translation
    assert (front.x, front.y) == robot.edge_sensors_m[0]
    assert front.x > 0.0  # x ahead,
    assert front.y > 0.0  # y to the left
    assert parents["puck_link"].transform.translation.z == robot.puck_height_m
    turn, shift = parents["map"].transform.rotation, parents["map"].transform.translation
    turned = Rotation.from_quat((turn.x, turn.y, turn.z, turn.w)).apply((0.3, -0.4, 0.5))
    assert turned + np.array((shift.x, shift.y, shift.z)) == pytest.approx(mirror.world_from_deck((0.3, -0.4, 0.5)))
    with AnyReader([bag]) as reader:
        (latched,) = [one for one in reader.connections if one.topic == "/tf_static"]
        assert isinstance(latched.ext, ConnectionExtRosbag2)
        assert [qos.durability for qos in latched.ext.offered_qos_profiles] == [QosDurability.TRANSIENT_LOCAL]
    poses = [one.pose.pose for *_, one in messages(bag, "/odom")]
    moves = [one.transforms[0] for *_, one in messages(bag, "/tf")]
    assert {(one.header.frame_id, one.child_frame_id) for one in moves} == {("map", "base_link")}
    assert [(m.transform.translation.x, m.transform.rotation.z) for m in moves] == [
        (pose.position.x, pose.orientation.z) for pose in poses
    ]


def test_a_fix_has_its_place_and_covariance(bag: Path, recording: Recording) -> None:
    fixes = [json.loads(payload) for _, (topic, _, payload) in iter_logged(recording.path) if topic == "fix"]
    for (*_, found), fix in zip(messages(bag, "/laser/position"), fixes, strict=True):
        assert found.header.frame_id == "world"
        place = found.pose.pose.position
        assert [place.x, place.y, place.z] == fix["position_m"]
        assert found.pose.covariance.reshape(6, 6)[:3, :3].ravel().tolist() == fix["covariance_m2"]


def test_verdicts_alarms_and_mission_become_diagnostics(tmp_path: Path, run_dir: Path) -> None:
    other = tmp_path / "run"
    other.mkdir()
    recorder = recorder_in(other, {"config": (run_dir / "config.toml").read_text()})
    rim = DangerEvent(
        seq=5, t_s=0.05, code=1, cause="edge ahead", signal="front_left", value=0.1, limit=0.2, off=(True,) * 4,
        severity=3, active=[("earthquake", "the mirror shakes", 4)],
    )  # fmt: skip
    status = {"seq": 6, "t_s": 0.06, "state": "held", "cause": "earthquake", "severity": 4, "alarms": []}
    alarm = {
        "name": "earthquake", "severity": "hold", "cause": "the mirror shakes", "advice": "", "since": "", "since_s": 0,
    }  # fmt: skip
    status["alarms"] = [alarm, {**alarm, "name": "fire", "ended": "2026-01-01T12:00:00Z"}]
    recorder.write("sensors", 0.04, b'{"seq":4,"t_s":0.04,"lines":[]}')
    recorder.write("danger_event", 0.05, msgspec.json.encode(rim))
    recorder.write("mission", 0.06, msgspec.json.encode(msgspec.convert(status, MissionStatus)))
    recorder.close()
    assert main(["recording", "export", str(other), "--ros2", str(tmp_path / "bag")]) == 0
    (*_, danger), (*_, mission) = messages(tmp_path / "bag", "/diagnostics")
    assert [(one.name, int(one.level), one.message) for one in danger.status] == [
        ("ccatp: danger", 1, "edge ahead"),
        ("ccatp: danger earthquake", 2, "the mirror shakes"),
    ]
    assert {one.key: one.value for one in danger.status[0].values}["signal"] == "front_left"
    assert [(one.name, int(one.level), one.message) for one in mission.status] == [
        ("ccatp: mission", 2, "held"),
        ("ccatp: alarm earthquake", 2, "the mirror shakes"),
    ]


def copied(run_dir: Path, folder: Path, recording: bytes) -> Path:
    folder.mkdir()
    shutil.copy(run_dir / "config.toml", folder)
    (folder / "telemetry.mcap").write_bytes(recording)
    return folder


def test_what_is_left_of_a_torn_recording_is_exported(
    run_dir: Path, bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = (run_dir / "telemetry.mcap").read_bytes()
    torn = copied(run_dir, tmp_path / "torn", whole[: len(whole) // 2])
    assert main(["recording", "export", str(torn), "--ros2", str(tmp_path / "bag")]) == 0
    (line,) = capsys.readouterr().err.splitlines()
    assert "damaged or cut off at byte" in line
    kept, everything = ([stamp_ns(one) for *_, one in messages(folder, "/imu")] for folder in (tmp_path / "bag", bag))
    assert 100 < len(kept) < len(everything)
    assert kept == everything[: len(kept)]


def test_what_cannot_be_exported_is_one_line(
    run_dir: Path, bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    export = ("recording", "export", run_dir)
    assert "give --tum, --truth or --ros2" in refused(capsys, *export)
    assert f"--ros2: {bag} exists already; name a new directory" in refused(capsys, *export, "--ros2", bag)
    new = tmp_path / "full"
    with full_beyond(100_000):
        assert f"--ros2: cannot write {new}: File too large" in refused(capsys, *export, "--ros2", new)
    assert not new.exists()
    begun = tmp_path / "begun"  # a run that ended before the first frame
    begun.mkdir()
    recorder_in(begun, {"config": (run_dir / "config.toml").read_text()}).close()
    for option in ("--tum", "--ros2"):
        assert "no sensors frames in it" in refused(capsys, "recording", "export", begun, option, new)
    text = tmp_path / "notes.txt"
    text.write_text("no recording")
    named = "no recording of a run; name a telemetry.mcap, or the directory of a run"
    assert f"{text}: {named}" in refused(capsys, "recording", "export", text, "--ros2", new)
    for name in [one for one in sys.modules if one.startswith(("ccatp.studies.ros_bag", "rosbags"))]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "rosbags", None)
    assert "pip install ccatp[ros]" in refused(capsys, *export, "--ros2", new)


def test_evo_finds_the_errors_that_a_replay_prints(
    run_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))  # where evo writes settings
    from evo.core import metrics, sync
    from evo.tools import file_interface

    estimate, truth = str(tmp_path / "estimate.tum"), str(tmp_path / "truth.tum")
    # A recording may be named as well as the directory of its run.
    recording = str(run_dir / "telemetry.mcap")
    assert main(["recording", "export", recording, "--tum", estimate, "--truth", truth]) == 0
    capsys.readouterr()
    ours = answered(capsys, "replay", run_dir)["recorded"]["position_error_mm"]
    pair = sync.associate_trajectories(*(file_interface.read_tum_trajectory_file(file) for file in (truth, estimate)))
    error = metrics.APE(metrics.PoseRelation.translation_part)
    error.process_data(pair)
    theirs = error.get_all_statistics()
    found = [1e3 * theirs[name] for name in ("mean", "median", "max", "rmse")]
    assert found == pytest.approx([ours[name] for name in ("mean", "p50", "max", "rms")], rel=1e-3)
