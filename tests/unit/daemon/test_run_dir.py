"""Run directory, runtime directory, options and start of a run."""

import os
import re
import socket
import subprocess
from contextlib import ExitStack
from dataclasses import replace
from datetime import UTC, datetime
from importlib.util import find_spec
from pathlib import Path

import pytest

from ccatp.beacons.config.load import load_radio_config
from ccatp.beacons.daemon.beacon_run import PROCESSES as BEACON_PROCESSES
from ccatp.config.load import dump_config, load_config
from ccatp.config.models import Config
from ccatp.daemon.loops.emergency_file import EMERGENCIES_FILE
from ccatp.daemon.supervision.process import run_dir_in
from ccatp.daemon.supervision.run_dir import (
    UNFINISHED_FILE,
    RunOptions,
    await_predecessors,
    clear_finished,
    default_run_dir,
    find_resumable,
    find_unfinished,
    finished_summary,
    keep_origin,
    make_run_dir,
    mark_resumable,
    own_runtime_dir,
    read_run_id,
    take_over_emergencies,
    take_runtime_dir,
    with_origin,
)
from ccatp.daemon.supervision.supervisor import PROCESSES, run
from ccatp.errors import ConfigError, ExitStatus, RefusedError
from ccatp.links.runtime_dir import (
    LOCK_FILE,
    MAX_SOCKET_NAME_BYTES,
    MAX_SOCKET_PATH_BYTES,
    RUN_LOCK,
    TRUTH_LOCK_FILE,
    is_held,
    locked,
    make_runtime_dir,
    running_in,
    runtime_dir_path,
)
from ccatp.records.recorder import TELEMETRY, Recorder

NOW = datetime(2026, 3, 4, 5, 6, 7, tzinfo=UTC)
ONE_PANEL = {"run.panels": 1}


def options(**fields: object) -> RunOptions:
    return RunOptions(sim=True, **fields)  # type: ignore[arg-type]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_the_tables_name_real_modules_and_main_stops_first() -> None:
    assert [p.name for p in PROCESSES] == ["dashboard", "dataloop", "etalon", "danger", "main"]
    assert all(find_spec(p.module) is not None for p in PROCESSES)
    assert [p.name for p in BEACON_PROCESSES] == ["dashboard", "dataloop", "danger", "main"]
    for processes, lasting in ((PROCESSES, {"dataloop"}), (BEACON_PROCESSES, {"dataloop", "main"})):
        assert {p.name for p in processes if not p.is_replaceable} == lasting
        assert processes[-1].name == "main"  # stopping is in the reverse order


OBSERVATORY = {"endpoint": "tcp://127.0.0.1:0", "key_file": "k", "clients_file": "none.toml"}


@pytest.mark.parametrize(
    ("overrides", "why"),
    [
        (
            {f"observatory.{name}": value for name, value in OBSERVATORY.items()},
            r"observatory\.clients_file: cannot read none\.toml: No such file",
        ),
        ({"dashboard.token_file": "none"}, r"dashboard\.token_file: cannot read"),
        ({"robot.key_file": "none"}, r"robot\.key_file: cannot read none: No such file"),
    ],
)
def test_what_is_refused_before_anything_is_made(tmp_path: Path, overrides: dict[str, object], why: str) -> None:
    with pytest.raises(ConfigError, match=why):
        run(options(overrides=overrides, runtime_dir=tmp_path / "rt", run_dir=tmp_path / "run"))
    assert list(tmp_path.iterdir()) == []


def test_a_port_in_use(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        wanted = options(overrides={"sim.robot.port": port}, runtime_dir=tmp_path / "rt", run_dir=tmp_path / "run")
        why = rf"sim\.robot\.port: cannot listen on 127\.0\.0\.1:{port}: Address already in use; .*--set"
        with pytest.raises(ConfigError, match=why):
            run(wanted)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("fields", "why"),
    [
        ({"resume": True}, "--resume: a mission among beacons cannot be resumed"),
        ({"recover": True}, "--resume-last: a mission among beacons cannot be resumed"),
        ({"faults_file": Path("plan.toml")}, "--faults: plans are for surveys"),
    ],
)
def test_what_missions_among_beacons_do_not_have(tmp_path: Path, fields: dict[str, object], why: str) -> None:
    path = tmp_path / "radio.toml"
    path.write_text(dump_config(load_radio_config(None)))
    with pytest.raises(ConfigError, match=why):
        run(options(config_file=path, **fields))


# -- the run directory ------------------------------------------------------------------------------------------------


def test_the_directory_of_a_run_that_goes_on_is_not_offered_for_a_resume(tmp_path: Path) -> None:
    (tmp_path / "mission.sqlite").touch()
    with (
        locked(tmp_path / RUN_LOCK, "taken"),
        pytest.raises(ConfigError, match=f"another ccatp runs in {tmp_path}; name another folder"),
    ):
        make_run_dir(options(run_dir=tmp_path), load_config())


@pytest.mark.parametrize(
    ("resume", "changes", "why"),
    [
        (False, ONE_PANEL, "holds a mission already; give --resume"),
        (True, {"run.panels": 2}, "run.panels was 1 in .* and is 2 now"),
        (True, {**ONE_PANEL, "run.order": "optimised"}, "run.order was thesis in .* and is optimised now"),
        (True, {**ONE_PANEL, "run.mirror": "thesis-m2"}, "run.mirror was fyst-m1 in .* and is thesis-m2 now"),
        (True, {**ONE_PANEL, "run.seed": 2}, "run.seed was 1 in .* and is 2 now; leave it out"),
        (True, {**ONE_PANEL, "run.world": "hard"}, "run.world was thesis in .* and is hard now"),
        (True, {**ONE_PANEL, "run.filter": "ukf"}, "run.filter was ekf in .* and is ukf now; leave it out"),
        (True, {**ONE_PANEL, "sim.robot.physics": "motors"}, "sim.robot.physics was lag in .* and is motors now"),
        (
            True,
            {**ONE_PANEL, "mirror.panels.points_x_mm": [-200.0, 0.0, 200.0]},
            "section mirror.panels is not that of",
        ),
        (True, {**ONE_PANEL, "world.start_position_sigma_m": 0.5}, "section world is not that of"),
    ],
)
def test_a_survey_is_resumed_with_its_own_points(
    tmp_path: Path, resume: bool, changes: dict[str, object], why: str
) -> None:
    (tmp_path / "mission.sqlite").touch()
    same = load_config(overrides=ONE_PANEL)
    assert make_run_dir(options(run_dir=tmp_path, resume=True), same) == tmp_path  # whatever it was
    (tmp_path / "config.toml").write_text(before := dump_config(same))
    with pytest.raises(ConfigError, match=why):
        make_run_dir(options(run_dir=tmp_path, resume=resume), load_config(overrides=changes))
    assert (tmp_path / "config.toml").read_text() == before
    assert make_run_dir(options(run_dir=tmp_path, resume=True), same) == tmp_path


def test_runs_of_one_second_have_directories_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ccatp.daemon.supervision.run_dir.default_run_dir", lambda *_: Path("runs/same"))
    made = []
    for _ in range(3):
        made.append(make_run_dir(options(), load_config()))
        (made[-1] / "mission.sqlite").touch()
    assert [path.name for path in made] == ["same", "same-2", "same-3"]
    monkeypatch.setattr(
        "ccatp.daemon.supervision.run_dir.default_run_dir", lambda *_: Path("runs/same/mission.sqlite/x")
    )
    with pytest.raises(ConfigError, match=r"--run-dir: cannot make .*; name another folder"):
        make_run_dir(options(), load_config())


def test_a_run_is_resumed_simulated_or_not_as_it_began(tmp_path: Path) -> None:
    resumed = RunOptions(sim=False, run_dir=tmp_path, resume=True)
    assert with_origin(resumed) is resumed  # of an older version, and without a recording
    Recorder(tmp_path / TELEMETRY, [], is_simulation=True).close()
    assert with_origin(resumed).sim  # of an older version
    assert with_origin(replace(resumed, realtime=True)).realtime  # which does not say how it was
    assert read_run_id(tmp_path) == ""
    keep_origin(tmp_path, is_sim=True, is_realtime=False, is_new=False)
    assert read_run_id(tmp_path) == ""  # its files have none
    keep_origin(tmp_path, is_sim=False, is_realtime=False, is_new=True)
    assert (first := read_run_id(tmp_path))
    assert not with_origin(resumed).sim
    with pytest.raises(ConfigError, match=r"--sim: the run in .* is of a real robot; leave --sim out to resume it"):
        with_origin(replace(resumed, sim=True))
    keep_origin(tmp_path, is_sim=True, is_realtime=False, is_new=False)
    assert read_run_id(tmp_path) == first
    keep_origin(tmp_path, is_sim=True, is_realtime=False, is_new=True)
    assert read_run_id(tmp_path) != first
    assert with_origin(resumed).sim
    assert not with_origin(replace(resumed, resume=False)).sim
    assert not with_origin(resumed).realtime
    with pytest.raises(ConfigError, match=r"--realtime: the run in .* began without it; leave it out"):
        with_origin(replace(resumed, realtime=True))
    keep_origin(tmp_path, is_sim=True, is_realtime=True, is_new=True)
    assert with_origin(resumed).realtime  # the wall clock of its operators, not the speed of the machine


def test_directories_that_cannot_be_used(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "mission.sqlite").touch()
    for cfg, wanted, why in (
        (load_config(), options(run_dir=tmp_path / "new", resume=True), "--resume: no mission in"),
        (load_config(), options(run_dir=tmp_path / "file" / "run"), "--run-dir: cannot make"),
        (load_radio_config(None), options(run_dir=tmp_path), "holds a mission already; name another folder"),
    ):
        with pytest.raises(ConfigError, match=why):
            make_run_dir(wanted, cfg)


@pytest.mark.parametrize("mirror", ["fyst-m2", "elsewhere/fyst-m2.toml"])
def test_a_run_directory_is_named_by_time_mirror_and_seed(mirror: str) -> None:
    assert default_run_dir(mirror, 3, NOW) == Path("runs/20260304T050607Z-fyst-m2-s3")


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
def test_a_mission_is_finished_when_its_summary_reports_it(text: str, is_finished: bool, tmp_path: Path) -> None:
    assert finished_summary(tmp_path) is None
    (tmp_path / "summary.json").write_text(text)
    assert (finished_summary(tmp_path) is not None) is is_finished


@pytest.mark.parametrize(
    ("sim", "realtime", "is_paced"), [(True, False, False), (True, True, True), (False, False, True)]
)
def test_a_real_robot_keeps_the_walls_time(sim: bool, realtime: bool, is_paced: bool) -> None:
    assert RunOptions(sim=sim, realtime=realtime).is_paced is is_paced


# -- the run that did not finish --------------------------------------------------------------------------------------


def test_a_service_continues_with_the_run_that_did_not_finish(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[RunOptions] = []

    def run_once(wanted: RunOptions, _cfg: Config, fork_server: None) -> int:
        asked.append(wanted)
        assert wanted.run_dir is not None
        wanted.run_dir.mkdir(parents=True, exist_ok=True)
        (wanted.run_dir / "mission.sqlite").touch()
        return 4 if len(asked) == 1 else 0

    monkeypatch.setattr("ccatp.daemon.supervision.supervisor._run", run_once)
    assert [run(options(recover=True)) for _ in range(3)] == [4, 0, 0]
    assert [(one.resume, one.held) for one in asked] == [(False, False), (True, True), (False, False)]
    assert asked[1].run_dir == asked[0].run_dir


def test_the_only_run_that_is_not_complete_is_found() -> None:
    for number, counts in enumerate(('{"measured": 9, "total": 9}', '{"measured": 8, "total": 9}'), start=1):
        with pytest.raises(ConfigError, match=r"--resume: 0 unfinished runs in \./runs; name one"):
            find_unfinished()
        run_dir = Path(f"runs/{number}")
        run_dir.mkdir(parents=True)
        (run_dir / "mission.sqlite").touch()
        (run_dir / "summary.json").write_text(f'{{"points": {counts}}}')
    assert find_unfinished() == run_dir
    Path("runs/3").mkdir()
    Path("runs/3/mission.sqlite").touch()
    with pytest.raises(ConfigError, match=r"--resume: 2 unfinished runs in .*: runs/2, runs/3; name one"):
        find_unfinished()


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
    mark_resumable(run_dir)
    (run_dir / "mission.sqlite").unlink()  # it never began
    assert find_resumable() is None


@pytest.mark.fault("O7")
@pytest.mark.parametrize("kept", ['{"active": [{"id": "a", "kind": "fire", "note": ""}], "cleared": []}', "{"])
def test_an_emergency_outlives_the_run(tmp_path: Path, kept: str) -> None:
    first, second, third = begin(tmp_path), tmp_path / "runs" / "two", tmp_path / "runs" / "three"
    assert not take_over_emergencies(second)
    (first / EMERGENCIES_FILE).write_text(kept)
    clear_finished(ExitStatus.ABORTED, first)
    assert find_resumable() is None
    assert take_over_emergencies(second)
    assert (second / EMERGENCIES_FILE).read_text() == kept
    (second / EMERGENCIES_FILE).write_text('{"active": [], "cleared": ["a"]}')
    clear_finished(ExitStatus.COMPLETE, second)
    assert not take_over_emergencies(third)


def test_notes_that_cannot_be_read_or_written(tmp_path: Path) -> None:
    latched = tmp_path / "runs" / EMERGENCIES_FILE
    latched.mkdir(parents=True)
    UNFINISHED_FILE.mkdir()
    (tmp_path / EMERGENCIES_FILE).write_text("{")
    with pytest.raises(ConfigError, match="--resume-last: cannot read"):
        find_resumable()
    with pytest.raises(ConfigError, match="--resume-last: cannot take over"):
        take_over_emergencies(tmp_path)
    with pytest.raises(ConfigError, match="--resume-last: cannot keep"):
        clear_finished(ExitStatus.COMPLETE, tmp_path)
    with pytest.raises(ConfigError, match="--resume-last: cannot write"):
        mark_resumable(tmp_path)


# -- the runtime directory --------------------------------------------------------------------------------------------


def test_a_daemon_waits_for_the_children_of_the_one_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with ExitStack() as stack:
        locks = await_predecessors(stack, tmp_path)
        child = subprocess.Popen(["cat"], stdin=subprocess.PIPE, pass_fds=locks)
    monkeypatch.setattr("ccatp.daemon.supervision.run_dir.PREDECESSORS_S", 0.0)
    with child, ExitStack() as stack:
        with pytest.raises(RefusedError, match="processes of an earlier run still use"):
            await_predecessors(stack, tmp_path)
        child.communicate()
        await_predecessors(stack, tmp_path)


def test_simulations_run_beside_each_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usual = tmp_path / "rt"
    monkeypatch.setenv("CCATP_RUNTIME_DIR", str(usual))
    places = [usual, usual / "sim-2", usual / "sim-3"]
    with ExitStack() as stack, locked(make_runtime_dir("", os.environ) / TRUTH_LOCK_FILE, ""):
        # Beside a simulated robot that runs alone.
        assert [take_runtime_dir(stack, "", is_sim=True) for _ in range(2)] == places[1:]
        assert running_in(usual) == places[1:]
    with ExitStack() as first, ExitStack() as others:
        assert take_runtime_dir(first, "", is_sim=True) == usual
        assert [take_runtime_dir(others, "", is_sim=True) for _ in range(2)] == places[1:]
        assert running_in(usual) == places
        for configured, is_sim in ((str(usual), True), ("", False)):
            with pytest.raises(RefusedError, match="another ccatp runs in"):
                take_runtime_dir(others, configured, is_sim=is_sim)
        first.close()
        assert running_in(usual) == places[1:]
        assert take_runtime_dir(first, "", is_sim=True) == usual
    assert running_in(usual) == []


def test_the_sockets_go_with_the_daemon(tmp_path: Path) -> None:
    for is_sim, left in ((False, {"puck", "main2", "truth"}), (True, {"main2"})):
        with ExitStack() as stack:
            own_runtime_dir(stack, tmp_path, is_sim=is_sim)
            for name in ("control", "puck", "truth", "main2"):
                with socket.socket(socket.AF_UNIX) as made:
                    (tmp_path / name).unlink(missing_ok=True)
                    made.bind(str(tmp_path / name))
            (tmp_path / "main").write_text("no socket")
            assert is_held(tmp_path / LOCK_FILE) is not False
        assert {path.name for path in tmp_path.iterdir() if path.is_socket()} == left
        assert is_held(tmp_path / LOCK_FILE) is False
        assert (tmp_path / "main").read_text() == "no socket"


@pytest.mark.parametrize(
    ("configured", "environ", "path"),
    [
        ("/a", {"CCATP_RUNTIME_DIR": "/b", "XDG_RUNTIME_DIR": "/c"}, "/a"),
        ("", {"CCATP_RUNTIME_DIR": "/b", "XDG_RUNTIME_DIR": "/c"}, "/b"),
        ("", {"XDG_RUNTIME_DIR": "/c"}, "/c/ccatp"),
        ("", {}, f"/tmp/ccatp-{os.getuid()}"),
    ],
)
def test_the_configured_folder_comes_first(
    configured: str, environ: dict[str, str], path: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.gettempdir", lambda: "/tmp")
    assert runtime_dir_path(configured, environ) == Path(path)


def test_the_folder_is_made_for_its_owner_alone(tmp_path: Path) -> None:
    path = make_runtime_dir("", {"XDG_RUNTIME_DIR": str(tmp_path)})
    assert path == tmp_path / "ccatp"
    assert path.stat().st_mode & 0o777 == 0o700
    assert make_runtime_dir(str(path), {}) == path  # a second time


def test_a_path_just_short_enough_for_a_socket_is_taken() -> None:
    path = "/" + "x" * (MAX_SOCKET_PATH_BYTES - MAX_SOCKET_NAME_BYTES - 2)
    assert runtime_dir_path(path, {}) == Path(path)
    with pytest.raises(ConfigError, match="108 bytes with a socket's name, a unix socket takes at most 107"):
        runtime_dir_path(path + "x", {})


def test_folders_that_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "link").symlink_to(tmp_path)
    refused = {"file": "File exists; choose another with --runtime-dir", "link": "is a link, not a folder"}
    for mode in (0o777, 0o720, 0o702):
        (tmp_path / f"{mode:o}").mkdir()
        (tmp_path / f"{mode:o}").chmod(mode)
        refused[f"{mode:o}"] = rf"is open to others \(mode {mode:04o}\); chmod 700"
    for name, why in refused.items():
        with pytest.raises(ConfigError, match=why):
            make_runtime_dir(str(tmp_path / name), {})
    owner = tmp_path.stat().st_uid
    monkeypatch.setattr(os, "getuid", lambda: owner + 1)
    with pytest.raises(ConfigError, match=f"belongs to user {owner}, not to {owner + 1}"):
        make_runtime_dir(str(tmp_path), {})


WHOLE = dump_config(load_config())


@pytest.mark.parametrize("mark", ["origin.json", "mission.sqlite"])
@pytest.mark.parametrize("kept", sorted({0, 1, 2, *range(95, len(WHOLE), 997), len(WHOLE) - 1}))
def test_no_beginning_of_the_configuration_of_a_run_is_taken_for_all_of_it(
    tmp_path: Path, mark: str, kept: int
) -> None:
    path = tmp_path / "config.toml"
    (tmp_path / mark).write_text('{"simulation": true, "run_id": "1"}')
    path.write_text(WHOLE)
    assert load_config(path) == load_config()
    path.write_text(WHOLE[:kept])
    with pytest.raises(ConfigError, match=r"config\.toml"):
        load_config(path)
    elsewhere = tmp_path / "of_a_user.toml"
    elsewhere.write_text("run.seed = 2\n")
    assert load_config(elsewhere).run.seed == 2


LINES = WHOLE.splitlines(keepends=True)
EDITED = WHOLE.replace("seed = 1\n", "seed = 2\n")
CHANGES = {
    "beginning is missing": "".join(LINES[3:]),
    "middle is missing": "".join([*LINES[:20], *LINES[60:]]),
    "one line is missing": "".join([*LINES[:20], *LINES[21:]]),
    "edited": EDITED,
    "continued": WHOLE + "\n[run]\nseed = 2\n",
    "comment after it": WHOLE + "# resumed twice\n",
}


@pytest.mark.parametrize("text", CHANGES.values(), ids=[*CHANGES])
def test_a_configuration_of_a_run_that_is_not_as_the_run_wrote_it_is_refused(tmp_path: Path, text: str) -> None:
    assert text != WHOLE
    path = tmp_path / "config.toml"
    (tmp_path / "mission.sqlite").touch()
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"config\.toml") as refusal:
        load_config(path)
    assert "\n" not in str(refusal.value)


def test_an_edited_configuration_of_a_run_says_how_it_is_used_and_is_used_so(tmp_path: Path) -> None:
    path = tmp_path / "config.toml"
    (tmp_path / "origin.json").write_text('{"simulation": true, "run_id": "1"}')
    path.write_text(EDITED)
    advice = "put back a copy; if you edited it on purpose, rename it and name it with --config"
    with pytest.raises(ConfigError, match=advice):
        load_config(path)
    assert load_config(path.rename(tmp_path / "edited.toml")).run.seed == 2


@pytest.mark.parametrize("newline", ["\r\n", "\r"])
def test_a_copy_of_the_configuration_with_other_line_ends_is_the_same(tmp_path: Path, newline: str) -> None:
    path = tmp_path / "config.toml"
    (tmp_path / "mission.sqlite").touch()
    path.write_bytes(b"\xef\xbb\xbf" + WHOLE.replace("\n", newline).encode())
    assert load_config(path) == load_config()


def test_configurations_of_runs_of_older_versions_are_read(tmp_path: Path) -> None:
    path = tmp_path / "config.toml"
    (tmp_path / "mission.sqlite").touch()
    without_checksum = re.sub(r", checksum [0-9a-f]{8}\.\n$", ".\n", WHOLE)
    for text in (without_checksum, "".join(LINES[2:-2])):  # the first versions wrote neither head nor end
        assert text != WHOLE
        path.write_text(text)
        assert load_config(path) == load_config()


@pytest.mark.parametrize("content", [b"", b"{", b"null", b"[]", b"{}", b"\0" * 64, b'{"simulation": 1}', b"\xff"])
def test_a_damaged_origin_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "origin.json").write_bytes(content)
    for use in (
        lambda: read_run_id(tmp_path),
        lambda: with_origin(RunOptions(sim=True, run_dir=tmp_path, resume=True)),
        lambda: keep_origin(tmp_path, is_sim=True, is_realtime=False, is_new=False),
    ):
        with pytest.raises(ConfigError, match=r"origin\.json: is empty or damaged; put back a copy"):
            use()


@pytest.mark.parametrize("content", [b"", b"\n", b"/runs/a", b"\0" * 8])
def test_a_damaged_name_of_the_last_run_is_no_new_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: bytes
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "unfinished").write_bytes(content)
    with pytest.raises(ConfigError, match="is damaged, so the run that did not finish is not known"):
        find_resumable()


@pytest.mark.parametrize("content", [b"", b"\n", b" ", b"/runs/a"])
def test_a_cut_name_of_the_run_of_a_daemon_is_no_name(tmp_path: Path, content: bytes) -> None:
    assert run_dir_in(tmp_path) is None
    (tmp_path / "run_dir").write_bytes(content)
    assert run_dir_in(tmp_path) is None  # not the present directory
    (tmp_path / "run_dir").write_bytes(b"/runs/a\n")
    assert run_dir_in(tmp_path) == Path("/runs/a")
