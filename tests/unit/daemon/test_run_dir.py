"""Run directory, runtime directory, options and start of a run."""

import os
import socket
from contextlib import ExitStack
from datetime import UTC, datetime
from importlib.util import find_spec
from pathlib import Path

import pytest

from ccatp.config.load import dump_config, load_config
from ccatp.daemon.danger_loop import FILE as EMERGENCIES
from ccatp.daemon.run_dir import (
    FILE,
    RunOptions,
    clear_finished,
    default_run_dir,
    find_resumable,
    finished_summary,
    mark_resumable,
    own_runtime_dir,
    owned,
    survey_run_dir,
    take_over_emergencies,
)
from ccatp.daemon.supervisor import PROCESSES, _recover, run_survey
from ccatp.errors import ConfigError, ExitStatus, RefusedError, RuntimeDirError
from ccatp.links.runtime_dir import (
    MAX_SOCKET_NAME_BYTES,
    MAX_SOCKET_PATH_BYTES,
    is_deserted,
    make_runtime_dir,
    runtime_dir_path,
)


def options(**fields: object) -> RunOptions:
    return RunOptions(sim=True, **fields)  # type: ignore[arg-type]


def test_the_table_names_real_modules_and_main_stops_first() -> None:
    assert [p.name for p in PROCESSES] == ["dashboard", "dataloop", "etalon", "danger", "main"]
    assert all(find_spec(p.module) is not None for p in PROCESSES)
    assert PROCESSES[-1].name == "main"  # stopping is in the reverse order


def test_a_port_in_use(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        wanted = options(overrides={"sim.robot.port": port}, runtime_dir=tmp_path / "rt", run_dir=tmp_path / "run")
        with pytest.raises(ConfigError, match=rf"sim\.robot\.port: cannot listen on 127\.0\.0\.1:{port}: .*--set"):
            run_survey(wanted)
    assert not (tmp_path / "run").exists()


def test_a_run_directory_with_a_mission_wants_resume(tmp_path: Path) -> None:
    (tmp_path / "mission.sqlite").touch()
    with pytest.raises(ConfigError, match="holds a mission already; give --resume"):
        survey_run_dir(options(run_dir=tmp_path), load_config())
    assert survey_run_dir(options(run_dir=tmp_path, resume=True), load_config()) == tmp_path


def test_nothing_to_resume(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no mission in"):
        survey_run_dir(options(run_dir=tmp_path, resume=True), load_config())


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"run.panels": 2}, "run.panels was 1 in .* and is 2 now"),
        ({"run.panels": 1, "run.order": "optimised"}, "run.order was thesis in .* and is optimised now"),
        ({"run.panels": 1, "run.mirror": "thesis-m2"}, "run.mirror was fyst-m1 in .* and is thesis-m2 now"),
    ],
)
def test_a_survey_is_resumed_with_its_own_points(tmp_path: Path, changes: dict[str, object], told: str) -> None:
    (tmp_path / "mission.sqlite").touch()
    before = dump_config(load_config(overrides={"run.panels": 1}))
    (tmp_path / "config.toml").write_text(before)
    with pytest.raises(ConfigError, match=told):
        survey_run_dir(options(run_dir=tmp_path, resume=True), load_config(overrides=changes))
    assert (tmp_path / "config.toml").read_text() == before
    same = load_config(overrides={"run.panels": 1})
    assert survey_run_dir(options(run_dir=tmp_path, resume=True), same) == tmp_path


def test_a_run_directory_that_cannot_be_made(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="cannot make"):
        survey_run_dir(options(run_dir=tmp_path / "file" / "run"), load_config())


def test_one_daemon_in_a_runtime_directory(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    with owned(path, "--runtime-dir"), pytest.raises(RefusedError, match="another ccatp runs in"):  # noqa: SIM117
        with owned(path, "--runtime-dir"):
            pass
    with owned(path, "--runtime-dir"):
        pass


def test_the_sockets_go_with_the_daemon(tmp_path: Path) -> None:
    for is_sim, left in ((False, {"puck", "main2", "truth"}), (True, {"main2"})):
        with ExitStack() as stack:
            own_runtime_dir(stack, tmp_path, is_sim=is_sim)
            for name in ("control", "puck", "truth", "main2"):
                with socket.socket(socket.AF_UNIX) as made:
                    (tmp_path / name).unlink(missing_ok=True)
                    made.bind(str(tmp_path / name))
            (tmp_path / "main").write_text("no socket")
            assert not is_deserted(tmp_path)
        assert {path.name for path in tmp_path.iterdir() if path.is_socket()} == left
        assert is_deserted(tmp_path)
        assert (tmp_path / "main").read_text() == "no socket"


def test_a_list_of_clients_that_cannot_be_used_is_refused_before_anything_is_made(tmp_path: Path) -> None:
    keys = {"key_file": str(tmp_path / "k"), "clients_file": str(tmp_path / "none.toml")}
    observatory = {f"observatory.{name}": value for name, value in keys.items()}
    wanted = options(
        overrides={"observatory.endpoint": "tcp://127.0.0.1:0", **observatory},
        runtime_dir=tmp_path / "rt",
        run_dir=tmp_path / "run",
    )
    with pytest.raises(ConfigError, match=r"observatory\.clients_file: cannot read .*none\.toml: No such file"):
        run_survey(wanted)
    assert list(tmp_path.iterdir()) == []


def test_a_service_goes_on_with_the_run_that_did_not_finish(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[RunOptions] = []

    def run(wanted: RunOptions) -> int:
        asked.append(wanted)
        assert wanted.run_dir is not None
        wanted.run_dir.mkdir(parents=True, exist_ok=True)
        (wanted.run_dir / "mission.sqlite").touch()
        return 4 if len(asked) == 1 else 0

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("ccatp.daemon.supervisor.run_survey", run)
    assert [_recover(options(recover=True)) for _ in range(2)] == [4, 0]
    first, second = asked
    assert (first.resume, first.held) == (False, False)
    assert (second.resume, second.held, second.run_dir) == (True, True, first.run_dir)
    assert _recover(options(recover=True)) == 0
    assert not asked[2].resume  # the second one finished


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def begin(tmp_path: Path) -> Path:
    run_dir = tmp_path / "runs" / "one"
    run_dir.mkdir(parents=True)
    (run_dir / "mission.sqlite").touch()
    mark_resumable(run_dir)
    return run_dir


def test_a_run_is_found_until_it_has_finished(tmp_path: Path) -> None:
    assert find_resumable() is None
    run_dir = begin(tmp_path)
    for status in (ExitStatus.HELD, ExitStatus.INTERRUPTED, ExitStatus.UNREACHABLE):
        clear_finished(status, run_dir)
        assert find_resumable() == run_dir
    clear_finished(ExitStatus.COMPLETE, run_dir)
    assert find_resumable() is None


@pytest.mark.fault("O7")
@pytest.mark.parametrize("kept", ['{"active": [{"id": "a", "kind": "fire", "note": ""}], "cleared": []}', "{"])
def test_an_emergency_outlives_the_run(tmp_path: Path, kept: str) -> None:
    first, second, third = begin(tmp_path), tmp_path / "runs" / "two", tmp_path / "runs" / "three"
    assert not take_over_emergencies(second)
    (first / EMERGENCIES).write_text(kept)
    clear_finished(ExitStatus.ABORTED, first)
    assert find_resumable() is None
    assert take_over_emergencies(second)
    assert (second / EMERGENCIES).read_text() == kept
    (second / EMERGENCIES).write_text('{"active": [], "cleared": ["a"]}')
    clear_finished(ExitStatus.COMPLETE, second)
    assert not take_over_emergencies(third)


def test_a_run_that_never_began_is_none(tmp_path: Path) -> None:
    (begin(tmp_path) / "mission.sqlite").unlink()
    assert find_resumable() is None
    FILE.write_text("")
    assert find_resumable() is None


def test_a_note_that_cannot_be_read_or_written(tmp_path: Path) -> None:
    FILE.parent.mkdir()
    FILE.mkdir()
    with pytest.raises(ConfigError, match="--recover: cannot read"):
        find_resumable()
    FILE.rmdir()
    FILE.parent.rmdir()
    FILE.parent.write_text("")
    with pytest.raises(ConfigError, match="--recover: cannot write"):
        mark_resumable(tmp_path)


@pytest.mark.parametrize(
    ("text", "is_finished"),
    [
        ('{"points": {"measured": 9, "total": 9}}', True),
        ('{"points": {"measured": 8, "total": 9}}', False),
        ('{"points": {"measured": 0, "total": 0}}', False),
        ('{"points": {"measured": 9', False),
        ('{"points": 9}', False),
        ("[]", False),
    ],
)
def test_a_mission_is_finished_when_its_summary_says_so(text: str, is_finished: bool, tmp_path: Path) -> None:
    assert finished_summary(tmp_path) is None
    (tmp_path / "summary.json").write_text(text)
    assert (finished_summary(tmp_path) is not None) is is_finished


NOW = datetime(2026, 3, 4, 5, 6, 7, tzinfo=UTC)


@pytest.mark.parametrize("mirror", ["fyst-m2", "elsewhere/fyst-m2.toml"])
def test_a_run_directory_is_named_by_time_mirror_and_seed(mirror: str) -> None:
    assert default_run_dir(mirror, 3, NOW) == Path("runs/20260304T050607Z-fyst-m2-s3")


@pytest.mark.parametrize(
    ("sim", "realtime", "is_paced"), [(True, False, False), (True, True, True), (False, False, True)]
)
def test_a_real_robot_keeps_the_walls_time(sim: bool, realtime: bool, is_paced: bool) -> None:
    assert RunOptions(sim=sim, realtime=realtime).is_paced is is_paced


def test_the_configured_folder_comes_first() -> None:
    environ = {"CCATP_RUNTIME_DIR": "/b", "XDG_RUNTIME_DIR": "/c"}
    assert runtime_dir_path("/a", environ) == Path("/a")
    assert runtime_dir_path("", environ) == Path("/b")
    assert runtime_dir_path("", {"XDG_RUNTIME_DIR": "/c"}) == Path("/c/ccatp")
    assert runtime_dir_path("", {}).name == f"ccatp-{os.getuid()}"


def test_the_folder_is_made_for_its_owner_alone(tmp_path: Path) -> None:
    path = make_runtime_dir("", {"XDG_RUNTIME_DIR": str(tmp_path)})
    assert path == tmp_path / "ccatp"
    assert path.stat().st_mode & 0o777 == 0o700
    assert make_runtime_dir(str(path), {}) == path  # a second time


def test_a_path_just_short_enough_for_a_socket_is_taken() -> None:
    longest = MAX_SOCKET_PATH_BYTES - MAX_SOCKET_NAME_BYTES - 1
    path = "/" + "x" * (longest - 1)
    assert runtime_dir_path(path, {}) == Path(path)
    with pytest.raises(RuntimeDirError, match="108 bytes with a socket's name, a unix socket takes at most 107"):
        runtime_dir_path(path + "x", {})


def test_a_file_is_no_folder(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(RuntimeDirError, match="File exists; choose another with --runtime-dir"):
        make_runtime_dir(str(tmp_path / "file"), {})


def test_a_link_is_refused(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path)
    with pytest.raises(RuntimeDirError, match="is a link, not a folder"):
        make_runtime_dir(str(tmp_path / "link"), {})


@pytest.mark.parametrize("mode", [0o777, 0o720, 0o702])
def test_a_folder_that_others_may_write_is_refused(tmp_path: Path, mode: int) -> None:
    path = tmp_path / "open"
    path.mkdir()
    path.chmod(mode)
    with pytest.raises(RuntimeDirError, match=rf"others may write there \(mode {mode:04o}\); chmod 700"):
        make_runtime_dir(str(path), {})


def test_a_folder_of_somebody_else_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    owner = tmp_path.stat().st_uid
    monkeypatch.setattr(os, "getuid", lambda: owner + 1)
    with pytest.raises(RuntimeDirError, match=f"belongs to user {owner}, not to {owner + 1}"):
        make_runtime_dir(str(tmp_path), {})
