"""The Python interface on recorded runs: complete, in progress, damaged, of beacons; tables, samples and errors."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

import ccatp
from ccatp.analysis.run import Run
from ccatp.analysis.survey import SurveyRun
from ccatp.analysis.table import Table
from ccatp.beacons.analysis import BeaconRun
from ccatp.core import PanelId
from ccatp.daemon.operator.alarms import ALARMS_FILE
from ccatp.links.runtime_dir import RUN_LOCK, locked
from ccatp.records.recorder import read_metadata
from ccatp.records.run_reader import RunReadError, open_recordings
from tests.support.recorded import FRAMES, OFF_M, record_beacons, record_surveyed


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One panel in a hard world, complete. Not to be written to."""
    return record_surveyed(tmp_path_factory)


@pytest.fixture(scope="module")
def survey(recorded: Path) -> SurveyRun:
    run = ccatp.open_run(recorded)
    assert isinstance(run, SurveyRun)
    return run


@pytest.fixture
def spoilt(recorded: Path, tmp_path: Path) -> Path:
    """A copy by hard links: a test may remove files of it, or write them anew."""
    for file in recorded.iterdir():
        (tmp_path / file.name).hardlink_to(file)
    return tmp_path


def test_points_fixes_panels_and_moves_of_a_survey(survey: SurveyRun) -> None:
    summary = survey.summary
    assert summary is not None
    assert len(survey.points) == len(survey.fixes) == summary["points"]["measured"] == 9
    assert set(survey.points["status"]) == {"measured"}
    assert survey.points["first_arrival_mm"].max() < 10.0  # the requirement
    assert np.isfinite(survey.fixes["cov_xx_m2"]).all()
    assert set(survey.fixes["metrology"]) == {"good"}
    (panel,) = survey.panels
    injected = survey.findings.record.injected
    assert injected is not None
    piston_m, tip_rad, _ = injected[PanelId(int(panel["row"]), int(panel["col"]))]
    assert abs(panel["piston_um"] - 1e6 * piston_m) < 5.0 * panel["sigma_piston_um"]
    assert abs(panel["tip_urad"] - 1e6 * tip_rad) < 5.0 * panel["sigma_tip_urad"]
    moves = survey.adjuster_moves
    assert len(moves) == len(set(moves["adjuster"])) > 2
    assert moves["move_um"] == pytest.approx([panel[f"{name}_um"] for name in moves["adjuster"]])


def test_the_track_has_the_truth_of_its_frames(survey: SurveyRun) -> None:
    track = survey.track()
    error_m = np.hypot(track["x_m"] - track["true_x_m"], track["y_m"] - track["true_y_m"])
    assert error_m.max() < 0.02
    assert (error_m < 5.0 * track["sigma_m"]).mean() > 0.99
    assert (np.diff(track["frame"]) > 0).all()
    shifted = np.hypot(track["x_m"][1:] - track["true_x_m"][:-1], track["y_m"][1:] - track["true_y_m"][:-1])
    moving = np.hypot(np.diff(track["true_x_m"]), np.diff(track["true_y_m"])) > 5e-4
    assert shifted[moving].mean() > error_m[1:][moving].mean()  # the truth of another frame is further away


@pytest.mark.parametrize("name", ["imu", "enc", "edge", "gravity"])
def test_samples_are_those_that_were_recorded(name: str, survey: SurveyRun, recorded: Path) -> None:
    table = survey.samples(name)
    frames = [frame.sensors for frame in open_recordings(recorded)[0].frames()]
    if name == "gravity":
        sent = [frame.gravity for frame in frames if frame.gravity is not None]
    else:
        sent = [sample for frame in frames for sample in getattr(frame, name)]
    assert len(table) == len(sent)
    for at, field in enumerate(sent[0]._fields):
        expected = [np.nan if sample[at] is None else sample[at] for sample in sent]
        assert table[field] == pytest.approx(np.array(expected, dtype=float), abs=1e-9, nan_ok=True)


def test_the_state_of_the_robot_is_a_sample_of_each_frame(survey: SurveyRun) -> None:
    table = survey.samples("frame")
    assert len(table) == len(survey.track())
    assert set(np.unique(table["is_held"])) <= {0.0, 1.0}
    assert table["t_s"] == pytest.approx(survey.track()["t_s"], abs=1e-6)


def test_a_table_is_an_array_and_a_data_frame(survey: SurveyRun) -> None:
    table = survey.points[survey.points["point"] > 7]
    assert isinstance(table, Table)
    assert isinstance(table["first_arrival_mm"], np.ndarray)
    assert not isinstance(table["first_arrival_mm"], Table)
    assert table.descriptions["first_arrival_mm"].startswith("distance")
    pandas = pytest.importorskip("pandas")
    frame = table.to_pandas()
    assert isinstance(frame, pandas.DataFrame)
    assert list(frame["point"]) == [8, 9]
    assert list(frame.columns) == list(table.dtype.names or ())


def test_without_pandas_one_line_says_so(survey: SurveyRun, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match="pandas is not installed: pip install pandas"):
        survey.points.to_pandas()


def test_alarms_are_rows_with_their_end_and_who_acknowledged_them(spoilt: Path) -> None:
    events = [
        {"utc": "2026-01-01T00Z", "t_s": 1.0, "event": "raised", "severity": "slow", "cause": "few"},
        {"utc": "2026-01-01T01Z", "t_s": 2.0, "event": "raised", "severity": "hold", "cause": "fewer"},
        {"utc": "2026-01-01T02Z", "t_s": 3.0, "event": "ended", "severity": "hold", "cause": "fewer"},
        {
            "utc": "2026-01-01T00:00:03Z",
            "t_s": 4.0,
            "event": "acknowledged",
            "severity": "hold",
            "cause": "",
            "by": "B",
        },
        {"utc": "2026-01-01T04Z", "t_s": 5.0, "event": "raised", "severity": "slow", "cause": "again"},
    ]
    (spoilt / ALARMS_FILE).unlink(missing_ok=True)
    (spoilt / ALARMS_FILE).write_text("".join(json.dumps({"name": "few", **event}) + "\n" for event in events))
    first, second = ccatp.open_run(spoilt).alarms
    assert (first["severity"], first["cause"]) == ("hold", "fewer")
    assert np.isnan([first["raised_t_s"], first["ended_t_s"]]).all()  # no recorded status has it
    assert (first["ended_utc"], first["acknowledged_by"]) == ("2026-01-01T02Z", "B")
    assert (second["severity"], second["ended_utc"], second["acknowledged_by"]) == ("slow", "", "")


def test_all_tables_of_a_resumed_run_have_one_axis_of_time(recorded: Path, spoilt: Path, survey: SurveyRun) -> None:
    """The second recording begins again with the frames and times of the robot of the first."""
    (spoilt / "telemetry.1.mcap").hardlink_to(recorded / "telemetry.mcap")
    run = ccatp.open_run(spoilt)
    assert isinstance(run, SurveyRun)
    track, imu, gyroscope = run.track(), run.samples("imu"), survey.samples("imu")
    assert (np.diff(track["t_s"]) > 0.0).all()
    for table in (track, imu):
        assert set(table["session"]) == {1, 2}
    begin_s = track["t_s"][track["session"] == 2][0]
    later = imu["t_s"][imu["session"] == 2]
    assert later == pytest.approx(gyroscope["t_s"] + begin_s - survey.track()["t_s"][0])
    assert run.fixes["t_s"] == pytest.approx(survey.fixes["t_s"] + begin_s - survey.track()["t_s"][0])


def test_a_fix_without_its_recording_has_no_time(recorded: Path, spoilt: Path) -> None:
    (spoilt / "telemetry.mcap").unlink()
    run = ccatp.open_run(spoilt)
    assert isinstance(run, SurveyRun)
    assert len(run.fixes) == 9
    assert np.isnan(run.fixes["t_s"]).all()


def test_a_run_in_progress_or_without_some_files_opens_and_says_what_is_missing(spoilt: Path) -> None:
    for name in ("summary.json", "mission.sqlite"):
        (spoilt / name).unlink()
    run = ccatp.open_run(spoilt)
    assert isinstance(run, SurveyRun)
    assert run.summary is None
    assert [len(table) for table in (run.points, run.fixes, run.panels, run.adjuster_moves)] == [0, 0, 0, 0]
    assert len(run.track()) > 1000
    assert len([line for line in run.warnings if line.startswith(("summary.json", "mission.sqlite"))]) == 2
    (spoilt / "telemetry.mcap").unlink()
    run = ccatp.open_run(spoilt)
    assert len(run.track()) == 0
    with pytest.raises(RunReadError, match=r"no telemetry\.mcap there, so no samples"):
        run.samples("imu")


def test_a_run_that_goes_on_opens_and_its_recorder_is_not_disturbed(recorded: Path, spoilt: Path) -> None:
    (spoilt / "summary.json").unlink()
    data = (recorded / "telemetry.mcap").read_bytes()
    (spoilt / "telemetry.mcap").unlink()
    (spoilt / "telemetry.mcap").write_bytes(data[: 2 * len(data) // 3])  # without index, in the middle of a chunk
    before = {file.name: file.read_bytes() for file in spoilt.iterdir()}
    with locked(spoilt / RUN_LOCK, "held by another"):
        run = ccatp.open_run(spoilt)
        assert isinstance(run, SurveyRun)
        assert len(run.fixes) == 9
        assert 0 < len(run.track()) < len(ccatp.open_run(recorded).track())
        assert run.summary is None
        assert any("telemetry.mcap: still being written" in line for line in run.warnings)
    assert {file.name: file.read_bytes() for file in spoilt.iterdir() if file.name in before} == before


def rewritten(recording: Path, out: Path, metadata: dict[str, str], texts: dict[bytes, bytes]) -> None:
    """A recording with other metadata and texts, and the robot's clock for both times, as up to format 2."""
    with recording.open("rb") as file, out.open("wb") as copy:
        reader, writer = make_reader(file), Writer(copy)
        writer.start()
        writer.add_metadata("ccatp", metadata)
        channels: dict[str, int] = {}
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            if channel.topic not in channels:
                assert schema is not None
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.topic] = writer.register_channel(channel.topic, channel.message_encoding, number)
            data, t_ns = message.data, message.publish_time
            for present, old in texts.items():
                data = data.replace(present, old)
            writer.add_message(channels[channel.topic], log_time=t_ns, data=data, publish_time=t_ns)
        writer.finish()  # type: ignore[no-untyped-call]


OLD_TEXTS = {b'"missed_deadlines":': b'"slips":', b'"worst_lateness_ms":': b'"lag_ms":'}


def test_a_run_of_an_older_format_has_the_same_tables(recorded: Path, spoilt: Path) -> None:
    (spoilt / "telemetry.mcap").unlink()
    metadata = {**read_metadata(recorded / "telemetry.mcap"), "format": "2"}
    rewritten(recorded / "telemetry.mcap", spoilt / "telemetry.mcap", metadata, OLD_TEXTS)
    old, new = ccatp.open_run(spoilt), ccatp.open_run(recorded)
    assert isinstance(old, SurveyRun)
    assert isinstance(new, SurveyRun)
    assert old.track().tobytes() == new.track().tobytes()
    assert old.samples("imu").tobytes() == new.samples("imu").tobytes()
    assert list(old.points["first_arrival_mm"]) == list(new.points["first_arrival_mm"])


def test_a_recording_of_a_newer_format_is_refused_in_one_line(recorded: Path, spoilt: Path) -> None:
    (spoilt / "telemetry.mcap").unlink()
    rewritten(recorded / "telemetry.mcap", spoilt / "telemetry.mcap", {"format": "99", "ccatp": "9.9"}, {})
    with pytest.raises(RunReadError, match=r"recorded in format 99 by ccatp 9\.9, .*: read it with a newer ccatp"):
        ccatp.open_run(spoilt)


def test_a_damaged_recording_gives_what_is_left(recorded: Path, spoilt: Path) -> None:
    data = (recorded / "telemetry.mcap").read_bytes()
    (spoilt / "telemetry.mcap").unlink()
    (spoilt / "telemetry.mcap").write_bytes(data[: len(data) // 2])
    run = ccatp.open_run(spoilt)
    assert any("telemetry.mcap" in warning for warning in run.warnings)
    assert 0 < len(run.track()) < len(ccatp.open_run(recorded).track())
    assert len(run.samples("imu")) > 0


@pytest.mark.parametrize("part", range(6))
def test_a_damaged_database_is_one_line_and_the_rest_is_there(recorded: Path, spoilt: Path, part: int) -> None:
    whole = ccatp.open_run(recorded)
    assert isinstance(whole, SurveyRun)
    data = bytearray((recorded / "mission.sqlite").read_bytes())
    at = part * len(data) // 6
    data[at : at + 20_000] = b"\x55" * 20_000
    (spoilt / "mission.sqlite").unlink()
    (spoilt / "mission.sqlite").write_bytes(data)
    run = ccatp.open_run(spoilt)
    assert isinstance(run, SurveyRun)
    assert run.track().tobytes() == whole.track().tobytes()
    found = [line for line in run.warnings if line.startswith("mission.sqlite: damaged")]
    assert "\n" not in "".join(found)
    # Either it is damaged and nothing of it is used, or the space that is reserved in it was hit.
    assert (len(run.fixes) == 0) if found else (run.fixes.tobytes() == whole.fixes.tobytes())
    assert found or part > 0


def test_what_is_no_run_and_unknown_names_are_refused(survey: Run, tmp_path: Path, spoilt: Path) -> None:
    with pytest.raises(RunReadError, match="no such directory; name the directory of a run"):
        ccatp.open_run(tmp_path / "none")
    with pytest.raises(ValueError, match="no samples named 'radar'; there are imu, enc, edge, gravity, frame"):
        survey.samples("radar")
    with pytest.raises(AttributeError, match="module 'ccatp' has no attribute 'open_runs'"):
        _ = ccatp.open_runs  # type: ignore[attr-defined]
    (spoilt / "config.toml").unlink()
    with pytest.raises(RunReadError, match=r"no config\.toml there"):
        ccatp.open_run(spoilt)


def test_a_mission_among_beacons(tmp_path: Path) -> None:
    run = ccatp.open_run(record_beacons(tmp_path / "run"))
    assert isinstance(run, BeaconRun)
    track = run.track()
    assert len(track) == FRAMES
    assert np.hypot(track["x_m"] - track["true_x_m"], track["y_m"] - track["true_y_m"]) == pytest.approx(OFF_M)
    assert list(run.beacons["error_m"]) == pytest.approx([0.1, 0.0])
    assert len(run.arrivals) == 1
    with pytest.raises(ValueError, match=r"no samples named 'x'; there are imu, .*, steer, radio, scan, dist"):
        run.samples("x")


def test_the_import_brings_nothing_else() -> None:
    code = "import sys; before = set(sys.modules); import ccatp; print(*sorted(set(sys.modules) - before))"
    new = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert [name for name in new if name.startswith("ccatp")] == ["ccatp"]
    assert {name.split(".")[0] for name in new} - {"ccatp"} <= sys.stdlib_module_names
