"""The command line: the arguments that reach the commands, the output and the exit status."""

import getpass
import importlib.metadata
import json
import sys
import threading
from collections.abc import Callable, Iterator
from io import StringIO
from pathlib import Path
from types import ModuleType
from typing import Any

import click
import pytest

import ccatp
from ccatp.cli import cli, main
from ccatp.cli.common import configured_folder, parse_setting, working
from ccatp.config.models import Config
from ccatp.config.package import configs_dir
from ccatp.daemon.loops.emergency_file import EMERGENCIES_FILE
from ccatp.daemon.supervision.process import RUN_DIR_FILE
from ccatp.daemon.supervision.run_dir import RunOptions
from ccatp.errors import ConfigError, DaemonUnreachableError, RefusedError
from ccatp.links.runtime_dir import LOCK_FILE, TRUTH_LOCK_FILE, locked
from tests.support.command import answered, printed, refused
from tests.support.runs import until
from tests.unit.links.test_auth import serving

EMERGENCY_ID = "6f1c3c1e-5a0f-4d0e-9f2b-0c8f5b6a7d11"

Stub = Callable[[str, str, Any], list[tuple[Any, ...]]]


@pytest.fixture
def stub(monkeypatch: pytest.MonkeyPatch) -> Stub:
    """Puts a module with one function in the place of a room below; returns the list of its calls."""

    def put(module: str, name: str, answer: Any) -> list[tuple[Any, ...]]:
        calls: list[tuple[Any, ...]] = []

        def function(*args: Any, **kwargs: Any) -> Any:
            calls.append((*args, kwargs) if kwargs else args)
            if isinstance(answer, BaseException):
                raise answer
            return answer

        stand_in = ModuleType(module)
        setattr(stand_in, name, function)
        monkeypatch.setitem(sys.modules, module, stand_in)
        return calls

    return put


def commands(group: click.Group, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    yield path
    context = click.Context(group)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        assert command is not None
        assert command.name == name
        if isinstance(command, click.Group):
            yield from commands(command, (*path, name))
        else:
            yield (*path, name)


@pytest.mark.parametrize("path", list(commands(cli)), ids=lambda path: " ".join(path) or "ccatp")
def test_every_help_shows_an_example(path: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    text = printed(capsys, *path, "--help")
    assert "Example:" in text
    assert f"    {' '.join(('ccatp', *path))}" in text


def test_the_commands_are_those_of_the_contract_the_map_and_the_conformance() -> None:
    assert {" ".join(path) for path in commands(cli) if path} - {"plot", "conformance", "dashboard"} == {
        "run", "status", "alarms", "alarms ack", "alarms history", "pause", "resume", "abort", "stop", "emergency",
        "sim", "sim robot", "sim etalon", "config", "config check", "config diff",
        "config init", "config schema", "config show", "runs", "runs list", "runs rm", "runs show",
        "study", "replay", "bench",
        "keys", "keys generate", "keys show-public", "clear", "align", "plan", "report", "compare",
        "recording", "recording export", "recording info", "recording repair",
        "stream", "calibrate", "check", "completion", "onboard", "onboard tune",
        "radio", "radio slam", "radio calibrate", "radio fix", "radio fuzzy", "radio map",
    }  # fmt: skip


def test_the_version_is_that_of_the_package(capsys: pytest.CaptureFixture[str]) -> None:
    assert printed(capsys, "--version") == f"ccatp {ccatp.__version__}\n"
    assert importlib.metadata.version("click")  # the only package that help and version need


def test_a_shipped_configuration_is_taken_by_its_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "zigbee").mkdir()
    assert printed(capsys, "config", "check", "zigbee").endswith("zigbee.toml: ok: system zigbee, seed 1\n")
    (tmp_path / "cricket").write_text("[run]\nseed = 7\n")  # a file of the user comes first
    assert printed(capsys, "config", "check", "cricket").startswith("cricket: ok: mirror fyst-m1")


def test_no_command_shows_the_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 2
    assert "Usage: ccatp" in capsys.readouterr().err


def test_run_hands_over_what_was_asked_for_and_nothing_else(stub: Stub, tmp_path: Path) -> None:
    calls = stub("ccatp.daemon.supervision.supervisor", "run", 3)
    argv = "run --sim --mirror fyst-m2 --world thesis-x2 --filter kf --panels 4 --seed 2 --realtime --json"
    more = ["--run-dir", str(tmp_path), "--runtime-dir", "/run/x", "--set", "limits.v_max_m_s=0.05"]
    assert main([*argv.split(), *more]) == 3
    overrides = {
        "run.mirror": "fyst-m2", "run.world": "thesis-x2", "run.seed": 2, "run.panels": 4, "run.filter": "kf",
        "limits.v_max_m_s": 0.05,
    }  # fmt: skip
    asked = RunOptions(
        sim=True, overrides=overrides, realtime=True, run_dir=tmp_path, json_output=True, runtime_dir=Path("/run/x")
    )
    assert main(["run", "--config", "mine.toml"]) == 3
    assert [options for options, _ in calls] == [asked, RunOptions(sim=False, config_file=Path("mine.toml"))]
    assert all(server.start("time", []) is None for _, server in calls)  # each has ended with its command


def test_a_resumed_run_takes_the_configuration_of_its_directory(
    stub: Stub, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    calls = stub("ccatp.daemon.supervision.supervisor", "run", 0)
    config = tmp_path / "config.toml"
    assert main(["run", "--sim", "--resume", "--run-dir", str(tmp_path)]) == 2
    assert f"--resume: {tmp_path}: no config.toml there; name the directory of a run" in capsys.readouterr().err
    config.touch()
    assert main(["run", "--sim", "--resume", "--run-dir", str(tmp_path)]) == 0
    options, _ = calls[0]
    assert (options.config_file, options.run_dir, options.resume) == (config, tmp_path, True)


@pytest.mark.parametrize(
    ("error", "status", "line"),
    [
        (ConfigError("a.toml:3: run.seed is odd"), 2, "ccatp: a.toml:3: run.seed is odd\n"),
        (DaemonUnreachableError("robot 127.0.0.1:1 refuses"), 5, "ccatp: robot 127.0.0.1:1 refuses\n"),
        (RefusedError("resume refused: not paused"), 1, "ccatp: resume refused: not paused\n"),
        (KeyboardInterrupt(), 130, "ccatp: interrupted\n"),
    ],
)
def test_expected_errors_are_one_line_and_their_exit_status(
    error: BaseException, status: int, line: str, stub: Stub, capsys: pytest.CaptureFixture[str]
) -> None:
    stub("ccatp.daemon.supervision.supervisor", "run", error)
    assert main(["run", "--sim"]) == status
    assert capsys.readouterr().err.lstrip("\n") == line


@pytest.mark.parametrize("command", ["status", "pause", "resume", "abort", "stop"])
def test_the_operator_commands_ask_the_daemon(
    command: str, runtime_dir: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("CCATP_RUNTIME_DIR", str(runtime_dir))
    with serving(runtime_dir, "control", lambda _: {"ok": True, "id": "7", "code": 2}) as asked:
        assert main([command, "--timeout", "3"]) == 0
    assert asked == [{"cmd": command} | ({"by": getpass.getuser()} if command != "status" else {})]
    assert capsys.readouterr().out == "id    7\ncode  2\n"


ALARM = {
    "name": "fan_weak", "severity": "return", "cause": "the left fan gets weak", "advice": "Replace it.", "since": "A",
    "since_s": 1.0, "count": 2, "ended": "B", "acknowledged": "C", "acknowledged_by": "anna",
}  # fmt: skip


def test_alarms_are_shown_acknowledged_and_kept(
    runtime_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("CCATP_RUNTIME_DIR", str(runtime_dir))
    status = {"seq": 1, "t_s": 1.0, "state": "held", "alarms": [ALARM]}
    with serving(runtime_dir, "control", lambda _: {"ok": True, "status": status}) as asked:
        assert printed(capsys, "alarms").splitlines() == [
            "return  fan_weak: the left fan gets weak",
            "        since A, 2 times, ended B, acknowledged by anna C",
            "        Replace it.",
        ]
        assert answered(capsys, "alarms") == {"alarms": [ALARM], "emergencies": []}
        assert printed(capsys, "alarms", "ack", "fan_weak") == "ok\n"
        assert asked[-1] == {"cmd": "acknowledge", "name": "fan_weak", "by": getpass.getuser()}
    assert main(["alarms", "--json", "ack", "x"]) == 2
    assert "options go behind the command, as in ccatp alarms ack" in capsys.readouterr().err
    line = (
        '{"utc":"A","t_s":1.0,"event":"acknowledged","name":"fan_weak","severity":"return","cause":"weak","by":"anna"}'
    )
    (tmp_path / "config.toml").touch()
    (tmp_path / "alarms.jsonl").write_text(f"{line}\n{line[:40]}")
    assert printed(capsys, "alarms", "history", tmp_path) == "A  acknowledged by anna: return fan_weak: weak\n"
    assert answered(capsys, "alarms", "history", tmp_path) == {"history": [json.loads(line)]}
    for folder in (tmp_path / "none", runtime_dir):
        assert "no such run; name its directory" in refused(capsys, "alarms", "history", folder)


def test_an_emergency_is_one_entry_of_the_alarms_with_the_command_that_ends_it(
    runtime_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("CCATP_RUNTIME_DIR", str(runtime_dir))
    (runtime_dir / RUN_DIR_FILE).write_text(f"{tmp_path}\n")
    note = {"kind": "weather", "id": "7", "note": "wind 25 m/s"}
    (tmp_path / EMERGENCIES_FILE).write_text(json.dumps({"active": [note], "cleared": []}))
    alarm = {**ALARM, "name": "emergency", "cause": "emergency: weather", "count": 1, "ended": "", "acknowledged": ""}
    status = {"seq": 1, "t_s": 1.0, "state": "held", "alarms": [alarm]}
    with serving(runtime_dir, "control", lambda _: {"ok": True, "status": status}):
        assert printed(capsys, "alarms").splitlines() == [
            "return  emergency: emergency: weather",
            "        since A",
            "        Replace it.",
            "        weather: wind 25 m/s; ended by 'ccatp clear 7'",
        ]
        assert answered(capsys, "alarms")["emergencies"] == [{"alarm": "emergency", **note}]
        (tmp_path / EMERGENCIES_FILE).write_text("{")
        assert answered(capsys, "alarms")["emergencies"] == []


def test_an_answer_may_be_shown_as_json_or_be_empty(
    runtime_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    reply = {"ok": True, "state": "driving", "error_mm": 0.25}
    (tmp_path / "mine.toml").write_text(f'[run]\nruntime_dir = "{runtime_dir}"\n')
    here = ["--runtime-dir", str(runtime_dir)]
    with serving(runtime_dir, "control", lambda asked: reply if asked["cmd"] == "status" else {"ok": True}):
        for where in (here, ["--config", str(tmp_path / "mine.toml")]):
            assert answered(capsys, "status", *where) == reply
        assert main(["pause", *here]) == 0
    assert capsys.readouterr().out == "ok\n"


def test_an_emergency_goes_to_the_danger_process_with_an_id_of_its_own(runtime_dir: Path) -> None:
    here = ["--runtime-dir", str(runtime_dir)]
    answer = {"ok": True, "latched": True, "code": 2}
    with serving(runtime_dir, "emergency", lambda request: answer | {"id": request["id"]}) as asked:
        assert main(["emergency", "fire", "--note", "smoke", "--id", EMERGENCY_ID, *here]) == 0
        assert asked[0] == {"cmd": "emergency", "kind": "fire", "id": EMERGENCY_ID, "note": "smoke"}
        assert main(["emergency", "power", *here]) == main(["emergency", "power", *here]) == 0
    assert len({request["id"] for request in asked}) == 3


@pytest.mark.parametrize(
    "answer",
    [
        {"ok": True},
        {"ok": True, "id": EMERGENCY_ID, "code": 0},
        {"ok": True, "id": EMERGENCY_ID, "latched": False, "code": 0},
        {"ok": True, "id": EMERGENCY_ID, "latched": 1, "code": 2},
        {"ok": True, "id": "7f1c3c1e-5a0f-4d0e-9f2b-0c8f5b6a7d11", "latched": True, "code": 2},
        {"ok": False},
    ],
)
def test_an_emergency_that_is_not_in_force_is_no_success(
    answer: dict[str, Any], runtime_dir: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    argv = ("emergency", "fire", "--id", EMERGENCY_ID, "--runtime-dir", runtime_dir)
    with serving(runtime_dir, "emergency", lambda _: answer):
        refused(capsys, *argv, status=5 if answer["ok"] else 1)


def test_the_robot_alone_gets_its_address(stub: Stub) -> None:
    calls = stub("ccatp.daemon.loops.sim_robot", "run_alone", 0)
    argv = "sim robot --host 0.0.0.0 --port 0 --mirror fyst-m2 --seed 4 --lockstep --set sim.open_to_network=true"
    assert main(argv.split()) == main(["sim", "robot"]) == 0
    (cfg, options), (_, usual) = calls
    assert isinstance(cfg, Config)
    assert (cfg.sim.robot.host, cfg.sim.robot.port, cfg.mirror.name, cfg.run.seed) == ("0.0.0.0", 0, "fyst-m2", 4)
    assert options == {"lockstep": True, "faults": None, "runtime_dir": None}
    assert usual == {"lockstep": False, "faults": None, "runtime_dir": None}  # paced unless told otherwise


def test_two_robots_alone_want_two_places(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with locked(tmp_path / TRUTH_LOCK_FILE, ""):
        tmp_path.chmod(0o700)
        for option in (["--port", "0"], ["--config", str(configs_dir() / "zigbee.toml")]):
            err = refused(capsys, "sim", "robot", *option, "--runtime-dir", tmp_path, status=1)
            assert err.startswith(f"ccatp: another simulated robot uses {tmp_path}; end it, or give this")
        err = refused(capsys, "run", "--sim", "--runtime-dir", tmp_path, status=1)
        assert f"a simulated robot runs alone in {tmp_path}" in err


@pytest.mark.parametrize("command", [["status"], ["stop"], ["emergency", "fire"], ["dashboard"], ["stream"]])
def test_of_several_runs_one_is_chosen(
    command: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CCATP_RUNTIME_DIR", str(tmp_path))
    beside = tmp_path / "sim-2"
    beside.mkdir()
    (beside / "run_dir").write_text("/runs/tonight\n")
    with locked(tmp_path / LOCK_FILE, ""), locked(beside / LOCK_FILE, ""):
        err = refused(capsys, *command)
    choice = f"{tmp_path} (starts), {beside} (tonight)"
    assert err == f"ccatp: 2 runs are in progress; choose one with --runtime-dir: {choice}\n"
    with locked(beside / LOCK_FILE, ""):
        assert configured_folder(None, None) == beside


def test_a_daemon_that_is_gone_is_reported_at_once(runtime_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    here = ("status", "--runtime-dir", runtime_dir)
    expected = f"ccatp: no daemon in {runtime_dir}; start one with ccatp run, or name its folder with --runtime-dir\n"
    assert refused(capsys, *here, status=5) == expected
    with serving(runtime_dir, "control", lambda _: {"ok": True}) as asked:
        with locked(runtime_dir / LOCK_FILE, ""):
            assert main([*map(str, here)]) == 0
        capsys.readouterr()
        assert refused(capsys, *here, status=5) == expected
    assert len(asked) == 1


def test_the_laser_system_alone_gets_its_puck(stub: Stub, tmp_path: Path) -> None:
    calls = stub("ccatp.daemon.loops.sim_etalon", "run_alone", 0)
    argv = "sim etalon --port 2002 --puck 0.1 -0.5 3.4 --set etalon.retries=1"
    assert main(argv.split()) == main(["sim", "etalon", "--runtime-dir", str(tmp_path)]) == 0
    (cfg, *where), (_, *of_robot) = calls
    assert (cfg.sim.etalon.port, cfg.etalon.retries) == (2002, 1)
    assert where == [(0.1, -0.5, 3.4), None]
    assert of_robot == [None, f"ipc://{tmp_path}/puck"]


@pytest.mark.parametrize(
    ("text", "lines"),
    [
        ("[localizer.four_state]\nslip_fraction = 0.1\n",
         ["localizer.four_state.slip_fraction = 0.1 has no effect with run.filter = ekf; it is for kf"]),
        ("[localizer]\nslip_fraction = 0.1\n",  # where it was in older versions
         ["localizer.four_state.slip_fraction = 0.1 has no effect with run.filter = ekf; it is for kf"]),
        ('[run]\nfilter = "kf"\n[localizer.four_state]\nslip_fraction = 0.1\n', []),
        ('[run]\nfilter = "kf"\n[localizer.full_state]\nslip_mean = 0.1\n[localizer.full_state.use]\nseams = false\n',
         ["localizer.full_state.slip_mean = 0.1 has no effect with run.filter = kf; it is for ekf and ukf",
          "localizer.full_state.use.seams = false has no effect with run.filter = kf; it is for ekf and ukf"]),
        ("[localizer]\nhistory_s = 0.3\n", []),
        ('system = "zigbee"\n[mission]\nlaps = 1\nfollow_s = 9.0\n[cricket.batch]\nuses_shapes = false\n',
         ["mission.follow_s = 9.0 has no effect unless follow.is_active = true",
          "cricket.batch.uses_shapes = false has no effect without motes; it is for cricket"]),
    ],
)  # fmt: skip
def test_keys_without_effect_are_reported(
    text: str, lines: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "telescope.toml"
    file.write_text(text)
    assert main(["config", "check", str(file)]) == 0
    assert capsys.readouterr().err.splitlines() == [f"ccatp: warning: {file}: {line}" for line in lines]


def test_config_check_lists_every_problem(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "mine.toml"
    file.write_text("[run]\nseed = 3\n")
    assert printed(capsys, "config", "check", file) == f"{file}: ok: mirror fyst-m1, 77 panels, world thesis, seed 3\n"
    file.write_text("[run]\nseed = -3\nsed = 2\n")
    assert main(["config", "check", str(file)]) == 2
    out, err = capsys.readouterr()
    assert not out
    assert err.splitlines() == [
        f"ccatp: {file}:3: run.sed is unknown; did you mean run.seed?",
        f"ccatp: {file}:2: run.seed = -3 must be greater than or equal to 0",
    ]


@pytest.mark.parametrize(
    ("text", "setting"),
    [
        ("run.seed=2", ("run.seed", 2)),
        (" limits.v_max_m_s = 5e-2", ("limits.v_max_m_s", 0.05)),
        ("run.mirror=fyst-m2", ("run.mirror", "fyst-m2")),
        ('run.mirror="fyst-m2"', ("run.mirror", "fyst-m2")),
        ("robot.fan_duty=[0.7, 0.7]", ("robot.fan_duty", [0.7, 0.7])),
        ("robot.key_file=", ("robot.key_file", "")),
        ("x=" + "[" * 50_000, ("x", "[" * 50_000)),
        ("x=1\ny = 2", ("x", "1\ny = 2")),
        ("x=" + "9" * 9000, ("x", "9" * 9000)),
    ],
)
def test_settings_are_toml_or_text(text: str, setting: tuple[str, object]) -> None:
    assert parse_setting(text) == setting


# -- commands that take long -------------------------------------------------------------------------------------------


class Terminal(StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(("stream", "said"), [(Terminal, True), (StringIO, False)])
def test_a_command_that_takes_long_says_so_on_a_terminal(
    monkeypatch: pytest.MonkeyPatch, stream: type[StringIO], said: bool
) -> None:
    screen = stream()
    monkeypatch.setattr(sys, "stderr", screen)
    monkeypatch.setattr("ccatp.cli.common.PATIENCE_S", 0.01)
    threads = threading.active_count()
    with working("reading runs/tonight"):
        until(lambda: screen.getvalue() or not said)
        assert threading.active_count() == threads  # beside another thread the report would not draw on two cores
    shown = "\rccatp: reading runs/tonight, 0 s"
    assert screen.getvalue().startswith(shown) is said
    assert screen.getvalue().endswith(f"\r{' ' * len(shown[1:])}\r") is said  # nothing of it is left


def test_a_command_that_is_done_soon_says_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    with working("reading runs/tonight"):
        pass
    assert screen.getvalue() == ""
