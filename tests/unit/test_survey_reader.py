"""What an alignment is computed from, read out of run directories good and bad, without a change to them."""

import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

from ccatp.core import PanelId
from ccatp.errors import ConfigError
from ccatp.mirror.misalignment import PanelMisalignment
from ccatp.records.recorder import Recorder
from ccatp.records.run_reader import RunReadError
from ccatp.records.store import read_survey
from ccatp.records.survey_reader import read_run
from tests.unit.aligning.conftest import exact_fix, load
from tests.unit.run_folder import make_run, record_truth

CFG, M1 = load("fyst-m1")
PANEL = PanelId(3, 7)
LIES = PanelMisalignment(1e-5, 2e-5, -3e-5)
POINTS = M1.point_ids(PANEL)


@pytest.fixture
def run_dir(tmp_path: Path) -> Path:
    """Nine points planned, five of them measured."""
    return make_run(tmp_path / "run", CFG, POINTS, [exact_fix(M1, p, LIES) for p in POINTS[:5]], {PANEL: LIES})


def test_a_run_is_read(run_dir: Path) -> None:
    found = read_run(run_dir, {})
    assert found.cfg == CFG
    assert found.planned == POINTS
    assert [one.point for one in found.measured] == list(POINTS[:5])
    assert found.measured[2] == exact_fix(M1, POINTS[2], LIES)
    assert found.injected == {PANEL: (1e-5, 2e-5, -3e-5)}
    assert (found.is_simulation, found.warnings) == (True, ())


def test_nothing_is_written(run_dir: Path) -> None:
    before = {path.name: path.read_bytes() for path in run_dir.iterdir()}
    read_run(run_dir, {})
    assert {path.name: path.read_bytes() for path in run_dir.iterdir()} == before


def test_overrides_act(run_dir: Path) -> None:
    assert read_run(run_dir, {"robot.puck_height_m": 0.06}).cfg.robot.puck_height_m == 0.06
    with pytest.raises(ConfigError, match="puck_height"):
        read_run(run_dir, {"robot.puck_height_m": "high"})


def test_a_run_that_goes_on_is_read_beside_its_writer(run_dir: Path) -> None:
    with closing(sqlite3.connect(run_dir / "mission.sqlite", isolation_level=None)) as writer:
        writer.execute("BEGIN IMMEDIATE")
        writer.execute("DELETE FROM events")
        assert len(read_run(run_dir, {}).measured) == 5
        writer.execute("ROLLBACK")


def test_a_run_that_was_killed_in_a_commit_is_read(run_dir: Path, tmp_path: Path) -> None:
    killed = tmp_path / "killed"
    with closing(sqlite3.connect(run_dir / "mission.sqlite", isolation_level=None)) as writer:
        writer.execute("PRAGMA journal_mode = PERSIST")
        writer.execute("PRAGMA cache_size = 1")  # pages go to the file before the commit
        writer.execute("BEGIN IMMEDIATE")
        writer.execute("UPDATE points SET status = 'planned', fix_id = NULL, t_s = NULL")
        writer.execute("UPDATE reserve SET filler = zeroblob(3901)")
        shutil.copytree(run_dir, killed)
        writer.execute("ROLLBACK")
    # Without its journal the copy would show half of the transaction.
    assert (killed / "mission.sqlite").read_bytes() != (run_dir / "mission.sqlite").read_bytes()
    before = (killed / "mission.sqlite").read_bytes()
    assert [one.point for one in read_run(killed, {}).measured] == list(POINTS[:5])
    assert (killed / "mission.sqlite").read_bytes() == before


def test_a_damaged_fix_is_left_out(run_dir: Path) -> None:
    with closing(sqlite3.connect(run_dir / "mission.sqlite")) as db:
        db.execute("UPDATE fixes SET x_m = x_m + 1 WHERE point = 2")
        db.commit()
    found = read_run(run_dir, {})
    assert [one.point.point for one in found.measured] == [1, 3, 4, 5]
    assert found.warnings == ("point 3/7/2: its stored fix is damaged and left out; measure it again",)


def gone(run_dir: Path) -> None:
    shutil.rmtree(run_dir)


def without(name: str) -> Callable[[Path], None]:
    def remove(run_dir: Path) -> None:
        (run_dir / name).unlink()

    return remove


def zeroed(run_dir: Path) -> None:
    (run_dir / "mission.sqlite").write_bytes(bytes(5000))


def torn(run_dir: Path) -> None:
    path = run_dir / "mission.sqlite"
    path.write_bytes(path.read_bytes()[:20_000])


def of_another_mirror(run_dir: Path) -> None:
    with closing(sqlite3.connect(run_dir / "mission.sqlite")) as db:
        db.execute("UPDATE meta SET value = 'fyst-m2' WHERE key = 'mirror'")
        db.commit()


def newer(run_dir: Path) -> None:
    with closing(sqlite3.connect(run_dir / "mission.sqlite")) as db:
        db.execute("UPDATE meta SET value = '99' WHERE key = 'schema_version'")
        db.commit()


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (gone, "run: no such directory; name the directory of a run"),
        (without("config.toml"), "run: no config.toml there; name the directory of a run"),
        (without("mission.sqlite"), "mission.sqlite: no such file; name the directory of a run"),
        (zeroed, "mission.sqlite: damaged or not a mission store: file is not a database"),
        (torn, "mission.sqlite: damaged"),
        (of_another_mirror, "mission.sqlite: damaged: meta data or targets do not match their checksum"),
        (newer, "mission.sqlite: schema version 99, this program has 1; use a new run directory"),
    ],
)
def test_what_is_no_run_is_refused_in_one_line(spoil: Callable[[Path], None], message: str, run_dir: Path) -> None:
    spoil(run_dir)
    with pytest.raises(RunReadError, match=message) as caught:
        read_run(run_dir, {})
    assert "\n" not in str(caught.value)
    assert caught.value.exit_status == 2


def test_a_survey_of_another_mirror_is_refused(run_dir: Path) -> None:
    with pytest.raises(Exception, match="is a survey of fyst-m1, not of fyst-m2"):
        read_survey(run_dir / "mission.sqlite", "fyst-m2")


def test_a_real_robot_has_no_truth(run_dir: Path) -> None:
    (run_dir / "telemetry.mcap").unlink()
    record_truth(run_dir, {PANEL: LIES}, is_simulation=False)
    found = read_run(run_dir, {})
    assert (found.injected, found.is_simulation) == (None, False)


def test_a_run_without_recording_is_read(run_dir: Path) -> None:
    (run_dir / "telemetry.mcap").unlink()
    found = read_run(run_dir, {})
    assert (found.injected, found.is_simulation, len(found.measured)) == (None, None, 5)


@pytest.mark.parametrize("topic", ["truth", "misalignment"])
def test_a_recording_that_does_not_tell_the_truth_is_no_hindrance(topic: str, run_dir: Path) -> None:
    (run_dir / "telemetry.mcap").unlink()
    recorder = Recorder(run_dir / "telemetry.mcap", [(topic, {})], is_simulation=True)
    recorder.write(topic, 1.0, b'{"seq": 0}')
    recorder.close()
    found = read_run(run_dir, {})
    assert (found.injected, found.is_simulation) == (None, True)


def test_only_the_beginning_of_a_recording_is_searched(run_dir: Path) -> None:
    # One made before the truth of the panels was recorded may hold hours of other messages.
    (run_dir / "telemetry.mcap").unlink()
    recorder = Recorder(run_dir / "telemetry.mcap", [("truth", {}), ("misalignment", {})], is_simulation=True)
    recorder.write("truth", 1.0, b'{"seq":0,"t_s":0.0,"rows":[]}')
    recorder.write("misalignment", 2.0, b'{"seq":0,"t_s":0.0,"panels":[[3,7,1e-5,0.0,0.0]]}')
    recorder.close()
    assert read_run(run_dir, {}).injected is None


def test_a_resumed_run_has_the_truth_of_its_sessions_where_it_is_one(run_dir: Path) -> None:
    record_truth(run_dir, {PANEL: LIES})
    assert read_run(run_dir, {}).injected == {PANEL: (1e-5, 2e-5, -3e-5)}
    record_truth(run_dir, {PANEL: PanelMisalignment(9e-5, 0.0, 0.0)})
    found = read_run(run_dir, {})
    assert found.injected is None
    assert found.warnings == (
        "the sessions of this run simulated differently misaligned panels; the truth is not compared",
    )


def test_a_recording_that_cannot_be_read_is_told(run_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(path: Path) -> dict[str, str]:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("ccatp.records.survey_reader.read_metadata", fails)
    found = read_run(run_dir, {})
    assert found.injected is None
    assert found.warnings == (
        f"{run_dir / 'telemetry.mcap'}: cannot be read: Permission denied; the truth is not compared",
    )
