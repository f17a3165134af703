"""Tests of the check before a mission: its rules and its probes."""

import asyncio
import json
import socket
import threading
import time
from collections import namedtuple
from collections.abc import Callable, Sequence
from fcntl import LOCK_EX, flock
from pathlib import Path

import msgspec
import numpy as np
import pytest

from ccatp.cli import main
from ccatp.commissioning.preflight import (
    ROBOT_NAMES,
    CheckOutcome,
    PreflightResult,
    RobotReport,
    as_json,
    check_air,
    check_fix,
    check_lasers,
    check_robot,
    failed,
    has_failed,
    lines,
    passed,
    skipped,
    warned,
)
from ccatp.commissioning.probes import probe_keys, probe_laser, probe_machine, probe_robot
from ccatp.config.load import load_config
from ccatp.config.models import Config
from ccatp.core import Fix, GravitySample, ImuSample, Vector3, WheelSample
from ccatp.links.multiline import Environment
from ccatp.links.robot_messages import Hello, RobotData, Sensors
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.sim.robot import Robot

FRAMES = 300


def stand(cfg: Config) -> tuple[Mirror, RobotReport]:
    """What a robot that nobody drives says for three seconds."""
    mirror = build_mirror(cfg.mirror)
    robot = Robot(cfg, mirror, np.random.default_rng(cfg.run.seed))
    robot.join("monitor")
    frames: list[Sensors] = []
    while len(frames) < FRAMES:
        robot.advance()
        if robot.delivered is not None:
            frames.append(robot.delivered)
    data = RobotData(
        cfg.robot.wheel_radius_m, cfg.robot.wheel_base_m, cfg.robot.edge_sensors_m, (0.0, 0.0, cfg.robot.puck_height_m),
        cfg.robot.max_wheel_rad_s, cfg.sim.robot.fan_floor if mirror.overhang else 0.0,
    )  # fmt: skip
    hello = Hello("ccatp-robot/1", 7, "0" * 32, "none", False, 100.0, 0.25, data)
    return mirror, RobotReport(hello, frames, [0.01 * k for k in range(FRAMES)])


@pytest.fixture(scope="module")
def cfg() -> Config:
    return load_config()


@pytest.fixture(scope="module")
def stood(cfg: Config) -> tuple[Mirror, RobotReport]:
    return stand(cfg)


@pytest.mark.parametrize("mirror", ["fyst-m1", "fyst-m2", "thesis-m1"])
def test_a_sound_robot_passes(mirror: str) -> None:
    cfg = load_config(None, {"run.mirror": mirror})
    found = check_robot(cfg, *stand(cfg))
    assert [finding.name for finding in found] == list(ROBOT_NAMES)
    assert {finding.outcome for finding in found} == {CheckOutcome.PASS}, lines(found)


Change = Callable[[Sensors], None]


def every(**fields: object) -> Change:
    def change(frame: Sensors) -> None:
        for name, value in fields.items():
            setattr(frame, name, value)

    return change


def edge(*values: int) -> Change:
    return lambda frame: setattr(frame, "edge", [(t, *values) for t, *_ in frame.edge])


def turning(frame: Sensors) -> None:
    frame.enc = [WheelSample(t, 0.1, left) for t, _, left in frame.enc]


def spinning(frame: Sensors) -> None:
    frame.imu = [ImuSample(t, ax, wz + 0.2) for t, ax, wz in frame.imu]


def frozen(frame: Sensors) -> None:
    frame.imu = [ImuSample(t, 0.1, 0.01) for t, *_ in frame.imu]


def flat(frame: Sensors) -> None:
    frame.gravity = None if frame.gravity is None else GravitySample(frame.gravity[0], 0.0, 0.0, -1.0)


@pytest.mark.parametrize(
    ("change", "name", "outcome", "told"),
    [
        (every(faults=["fan_left"]), "faults", CheckOutcome.FAIL, "reports fan_left"),
        (every(enc=[]), "encoders", CheckOutcome.FAIL, "right: 0 samples a second, 50 are needed"),
        (turning, "encoders", CheckOutcome.FAIL, "right wheel turns at 0.100 rad/s"),
        (every(imu=[]), "inertial unit", CheckOutcome.FAIL, "0 samples a second"),
        (frozen, "inertial unit", CheckOutcome.FAIL, "readings in a row are the same"),
        (spinning, "inertial unit", CheckOutcome.FAIL, "zero rate +0.1992"),
        (every(edge=[]), "edge sensors", CheckOutcome.FAIL, "0 samples a second"),
        (edge(0, 1, 1, 0), "edge sensors", CheckOutcome.FAIL, "front left and rear right see no panel"),
        (flat, "gravity", CheckOutcome.FAIL, "is this the right mirror"),
        (every(gravity=None), "gravity", CheckOutcome.WARN, "too few readings"),
        (every(soc=0.1), "battery", CheckOutcome.FAIL, "10%"),
        (every(soc=0.5), "battery", CheckOutcome.WARN, "50%, for 36 min"),
    ],
)
def test_what_is_wrong_is_found(
    cfg: Config, stood: tuple[Mirror, RobotReport], change: Change, name: str, outcome: CheckOutcome, told: str
) -> None:
    mirror, report = stood
    frames = [msgspec.convert(msgspec.to_builtins(frame), Sensors) for frame in report.frames]
    for frame in frames:
        change(frame)
    found = check_robot(cfg, mirror, report._replace(frames=frames))
    (wrong,) = [finding for finding in found if finding.outcome is not CheckOutcome.PASS]
    assert (wrong.name, wrong.outcome) == (name, outcome)
    assert told in wrong.found
    assert wrong.todo


def test_a_sensor_that_flickers_is_told(cfg: Config, stood: tuple[Mirror, RobotReport]) -> None:
    mirror, report = stood
    frames = [msgspec.convert(msgspec.to_builtins(frame), Sensors) for frame in report.frames]
    edge(1, 0, 1, 1)(frames[5])
    (wrong,) = [
        f for f in check_robot(cfg, mirror, report._replace(frames=frames)) if f.outcome is not CheckOutcome.PASS
    ]
    assert "front right see the panel on and off" in wrong.found


@pytest.mark.parametrize(
    ("arrived_s", "name", "outcome", "told"),
    [
        ([0.02 * k for k in range(FRAMES)], "frames", CheckOutcome.FAIL, "50.0 a second"),
        ([0.01 * k + 0.2 * (k > 100) for k in range(FRAMES)], "frames", CheckOutcome.FAIL, "longest gap 210 ms"),
        ([0.01 * k + 0.06 * (k > 100) for k in range(FRAMES)], "frames", CheckOutcome.WARN, "longest gap 70 ms"),
        ([0.0105 * k for k in range(FRAMES)], "robot clock", CheckOutcome.FAIL, "runs at 0.95"),
    ],
)
def test_time_that_is_wrong_is_found(
    cfg: Config,
    stood: tuple[Mirror, RobotReport],
    arrived_s: Sequence[float],
    name: str,
    outcome: CheckOutcome,
    told: str,
) -> None:
    mirror, report = stood
    found = {f.name: f for f in check_robot(cfg, mirror, report._replace(arrived_s=arrived_s))}
    assert found[name].outcome is outcome
    assert told in found[name].found


def test_one_frame_is_not_enough(cfg: Config, stood: tuple[Mirror, RobotReport]) -> None:
    mirror, report = stood
    alone = report._replace(frames=report.frames[:1], arrived_s=report.arrived_s[:1])
    assert check_robot(cfg, mirror, alone)[1].found == "a single frame"


def test_another_robot_and_lockstep_are_told(cfg: Config, stood: tuple[Mirror, RobotReport]) -> None:
    mirror, report = stood
    other = msgspec.structs.replace(report.hello.robot, wheel_base_m=0.2)
    hello = msgspec.structs.replace(report.hello, robot=other, lockstep=True)
    found = {f.name: f for f in check_robot(cfg, mirror, report._replace(hello=hello))}
    assert "wheel_base_m is 0.15 here and 0.2 there" in found["robot geometry"].found
    assert found["robot clock"].outcome is CheckOutcome.WARN


def test_fans_below_the_floor_are_told() -> None:
    cfg = load_config(None, {"run.mirror": "fyst-m2"})
    mirror, report = stand(cfg)
    frames = [msgspec.convert(msgspec.to_builtins(frame), Sensors) for frame in report.frames]
    frames[7].fans = (0.6, 0.3)
    found = {f.name: f for f in check_robot(cfg, mirror, report._replace(frames=frames))}
    assert "the robot would fall" in found["fans"].todo
    weak = load_config(None, {"run.mirror": "fyst-m2", "robot.fan_duty": [0.5, 0.8]})
    assert "raise robot.fan_duty" in {f.name: f for f in check_robot(weak, mirror, report)}["fans"].todo


def test_lasers_and_air() -> None:
    assert check_lasers(connected=True, laser_ready=True).outcome is CheckOutcome.PASS
    assert "no laser" in check_lasers(connected=False, laser_ready=True).found
    assert "not warm" in check_lasers(connected=True, laser_ready=False).found
    assert check_air(Environment(-5.0, 525.0, 30.0)).outcome is CheckOutcome.PASS
    for air in (Environment(99.0, 525.0, 30.0), Environment(-5.0, 52.5, 30.0), Environment(-5.0, 525.0, 130.0)):
        assert "not the air of any telescope" in check_air(air).found


def test_a_fix_is_where_a_robot_at_base_has_its_puck(cfg: Config, stood: tuple[Mirror, RobotReport]) -> None:
    mirror = stood[0]
    at_base = mirror.puck_world(mirror.base_pose, cfg.robot.puck_height_m)

    def fix(position_m: Vector3) -> PreflightResult:
        return check_fix(cfg, mirror, Fix(0.0, position_m, (0.0,) * 9, 1.0, (1, 2, 3, 4), 1e-6))

    assert fix(at_base).outcome is CheckOutcome.PASS
    high = mirror.puck_world(mirror.base_pose, cfg.robot.puck_height_m + 0.01)
    assert "puck_height_m" in fix(high).todo
    assert "set the robot down at base" in fix((at_base[0] + 0.4, at_base[1], at_base[2])).todo
    assert fix((1e3 * at_base[0], 1e3 * at_base[1], 1e3 * at_base[2])).outcome is CheckOutcome.FAIL  # millimetres


def test_the_table() -> None:
    found = [passed("a", "well"), warned("bcd", "so", "look"), failed("e", "bad", "mend"), *skipped(["f"], "no e")]
    assert lines(found) == [
        "pass  a    well",
        "warn  bcd  so",
        "           -> look",
        "fail  e    bad",
        "           -> mend",
        "skip  f    no e",
        "not ready: 1 pass, 1 warn, 1 fail, 1 skip",
    ]
    assert has_failed(found)
    assert not has_failed(found[:2])
    assert as_json(found[:1]) == {
        "ready": True,
        "checks": [{"name": "a", "outcome": "pass", "found": "well", "todo": ""}],
    }


def by_name(found: list[PreflightResult]) -> dict[str, PreflightResult]:
    return {finding.name: finding for finding in found}


def test_nobody_there(free_port: int) -> None:
    cfg = load_config(None, {"robot.port": free_port, "etalon.port": free_port, "etalon.retries": 0})
    mirror = build_mirror(cfg.mirror)
    robot = by_name(asyncio.run(probe_robot(cfg, mirror)))
    assert "cannot reach the robot" in robot["robot link"].found
    assert robot["gravity"].outcome is CheckOutcome.SKIP
    laser = by_name(asyncio.run(probe_laser(cfg, mirror)))
    assert "start the MultiLine server" in laser["laser server"].todo
    assert laser["laser fix"].outcome is CheckOutcome.SKIP


def test_somebody_else_there() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:

        def greet() -> None:
            peer, _ = server.accept()
            with peer:
                peer.sendall(b"220 mail ready\r\n")
                peer.recv(1)

        thread = threading.Thread(target=greet)
        thread.start()
        cfg = load_config(None, {"robot.port": server.getsockname()[1], "robot.connect_timeout_s": 0.5})
        robot = by_name(asyncio.run(probe_robot(cfg, build_mirror(cfg.mirror))))
        thread.join()
    assert robot["robot link"].outcome is CheckOutcome.FAIL


def test_keys(tmp_path: Path) -> None:
    key = tmp_path / "link.key"
    cfg = load_config(None, {"robot.key_file": str(key)})
    assert "cannot read" in probe_keys(cfg, sim=False).found
    assert by_name(asyncio.run(probe_robot(cfg, build_mirror(cfg.mirror))))["robot link"].outcome is CheckOutcome.FAIL
    key.write_text("secret")
    key.chmod(0o644)
    assert "is open to others" in probe_keys(cfg, sim=False).found
    key.chmod(0o600)
    assert probe_keys(cfg, sim=False).outcome is CheckOutcome.PASS


def test_the_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cfg = load_config()
    found = by_name(probe_machine(cfg, tmp_path / "runs", tmp_path / "rt", {}))
    assert found["disk space"].outcome is CheckOutcome.PASS
    assert found["runtime directory"].outcome is CheckOutcome.PASS
    assert not (tmp_path / "runs").exists()  # nothing is made
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr("ccatp.commissioning.probes.shutil.disk_usage", lambda _: usage(1, 1, 1_000_000))
    monkeypatch.setattr("ccatp.commissioning.probes._slowest_write_s", lambda _: 0.5)
    found = by_name(probe_machine(cfg, tmp_path, tmp_path / "rt", {}))
    assert found["disk space"].outcome is CheckOutcome.FAIL
    assert "took 500.0 ms" in found["disk writes"].found

    def refuse(_: Path) -> float:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("ccatp.commissioning.probes._slowest_write_s", refuse)
    assert by_name(probe_machine(cfg, tmp_path, tmp_path / "rt", {}))["disk writes"].outcome is CheckOutcome.FAIL


def test_no_run_can_be_written_there(tmp_path: Path) -> None:
    cfg = load_config()
    (tmp_path / "file").touch()
    for where, told in (("file", "is no directory"), ("file/runs", "no directory"), ("nowhere/runs", "no directory")):
        found = by_name(probe_machine(cfg, tmp_path / where, tmp_path / "rt", {}))
        assert found["disk"].outcome is CheckOutcome.FAIL
        assert told in found["disk"].found
        assert "disk space" not in found


def test_a_daemon_that_runs_is_told(tmp_path: Path) -> None:
    cfg = load_config()
    (tmp_path / "rt").mkdir(mode=0o700)
    with (tmp_path / "rt" / "lock").open("w") as file:
        flock(file, LOCK_EX)
        found = by_name(probe_machine(cfg, tmp_path, tmp_path / "rt", {}))
    assert "a daemon runs in" in found["runtime directory"].found
    (tmp_path / "rt").chmod(0o777)
    found = by_name(probe_machine(cfg, tmp_path, tmp_path / "rt", {}))
    assert "others may write there" in found["runtime directory"].found


def test_a_clock_that_was_never_set(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    then = time.gmtime(0)
    monkeypatch.setattr("ccatp.commissioning.probes.time.gmtime", lambda: then)
    found = by_name(probe_machine(load_config(), tmp_path, tmp_path / "rt", {}))
    assert found["machine clock"].outcome is CheckOutcome.FAIL


def test_real_time_that_is_not_permitted(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("ccatp.commissioning.probes.os.geteuid", lambda: 1000)
    monkeypatch.setattr("ccatp.commissioning.probes.resource.getrlimit", lambda _: (0, 0))
    found = by_name(probe_machine(load_config(), tmp_path, tmp_path / "rt", {}))
    assert found["real time"].outcome is CheckOutcome.WARN
    cfg = load_config(None, {"run.realtime_priority": 0})
    assert by_name(probe_machine(cfg, tmp_path, tmp_path / "rt", {}))["real time"].outcome is CheckOutcome.PASS


def test_the_command_fails_where_one_fails(tmp_path: Path, free_port: int, capsys: pytest.CaptureFixture[str]) -> None:
    config = tmp_path / "a.toml"
    config.write_text(f"[robot]\nport = {free_port}\n[etalon]\nport = {free_port}\nretries = 0\n")
    command = ["check", "--config", str(config), "--runtime-dir", str(tmp_path / "rt"), "--runs-dir", str(tmp_path)]
    assert main(command) == 1
    out = capsys.readouterr().out
    assert "fail  robot link" in out
    assert "not ready: " in out
    assert main([*command, "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["ready"] is False
    config.write_text("[robot]\nport = 'x'\n")
    assert main(command) == 1
    assert "fail  configuration" in capsys.readouterr().out
    assert main(["check"]) == 2
    assert "--config FILE, or add --sim" in capsys.readouterr().err
    config.write_text("[observatory]\nendpoint = 'tcp://127.0.0.1:7020'\nkey_file = 'a'\nclients_file = 'b'\n")
    assert main(command) == 1
    assert "fail  observatory keys" in capsys.readouterr().out
