"""Tests of the check before a mission: its rules and its probes."""

import asyncio
import json
import socket
import threading
import time
from collections import namedtuple
from collections.abc import Callable
from dataclasses import replace
from fcntl import LOCK_EX, flock
from functools import cache
from operator import mul
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from ccatp.commissioning.preflight import (
    ROBOT_CHECKS,
    CheckOutcome,
    PreflightResult,
    RobotReport,
    as_json,
    check_air,
    check_fix,
    check_lasers,
    check_robot,
    check_time,
    failed,
    has_failed,
    lines,
    named,
    passed,
    skipped,
    warned,
)
from ccatp.commissioning.probes import probe_key, probe_laser, probe_machine, probe_robot
from ccatp.config.load import load_config
from ccatp.core import EdgeSample, Fix, GravitySample, ImuSample, Vector3, WheelSample
from ccatp.links.multiline import Environment
from ccatp.links.robot_messages import Sensors
from ccatp.mirror.mirror import build_mirror
from ccatp.sim.robot import Robot
from tests.support.command import printed, refused

FRAMES = 300
PASS, WARN, FAIL, SKIP = CheckOutcome


@cache
def stood(mirror_name: str = "fyst-m1") -> RobotReport:
    """What a robot that nobody drives says for three seconds."""
    cfg = load_config(None, {"run.mirror": mirror_name})
    mirror = build_mirror(cfg.mirror)
    robot = Robot(cfg, mirror, np.random.default_rng(cfg.run.seed))
    robot.join("monitor")
    frames: list[Sensors] = []
    while len(frames) < FRAMES:
        robot.advance()
        if robot.delivered is not None:
            frames.append(robot.delivered)
    hello = robot.hello(boot=7, nonce="0" * 32, auth="none", lockstep=False)
    return RobotReport(cfg, mirror, hello, frames, [0.01 * k for k in range(FRAMES)])


@pytest.mark.parametrize("mirror", ["fyst-m1", "fyst-m2", "thesis-m1"])
def test_a_sound_robot_passes(mirror: str) -> None:
    found = check_robot(stood(mirror))
    assert [finding.name for finding in found] == list(ROBOT_CHECKS)
    assert {finding.outcome for finding in found} == {PASS}, lines(found)


Change = Callable[[Sensors], None]


def every(**fields: object) -> Change:
    def change(frame: Sensors) -> None:
        for name, value in fields.items():
            setattr(frame, name, value)

    return change


def edge(*values: int, only: int | None = None) -> Change:
    def change(frame: Sensors) -> None:
        if only is None or frame.seq == stood().frames[only].seq:
            frame.edge = [EdgeSample(sample[0], *values) for sample in frame.edge]

    return change


def turning(frame: Sensors) -> None:
    frame.enc = [WheelSample(t, 0.1, left) for t, _, left in frame.enc]


def spinning(frame: Sensors) -> None:
    frame.imu = [ImuSample(t, ax, wz + 0.2) for t, ax, wz in frame.imu]


def frozen(frame: Sensors) -> None:
    frame.imu = [ImuSample(t, 0.1, 0.01) for t, *_ in frame.imu]


def flat(frame: Sensors) -> None:
    frame.gravity = None if frame.gravity is None else GravitySample(frame.gravity[0], 0.0, 0.0, -1.0)


def thinned(name: str, frames: int, samples: int) -> Change:
    """So many samples in every n-th frame only."""

    def change(frame: Sensors) -> None:
        setattr(frame, name, [] if frame.seq % frames else getattr(frame, name)[:samples])

    return change


def seldom_gravity(frame: Sensors) -> None:
    if frame.seq % 2:
        frame.gravity = None


def gravity(*signs: float) -> Change:
    def change(frame: Sensors) -> None:
        if frame.gravity is not None:
            t, *parts = frame.gravity
            frame.gravity = GravitySample(t, *map(mul, signs, parts))

    return change


@pytest.mark.parametrize(
    ("change", "name", "outcome", "reported"),
    [
        (every(faults=["fan_left"]), "faults", FAIL, "reports fan_left"),
        (every(enc=[]), "encoders", FAIL, "right: wheel encoders deliver no samples"),
        (thinned("enc", 2, 1), "encoders", FAIL, "deliver 50 samples/s, at least 80 are needed"),
        (turning, "encoders", FAIL, "right wheel turns at 0.100 rad/s"),
        (every(imu=[]), "inertial unit", FAIL, "accelerometer and gyroscope deliver no samples"),
        (thinned("imu", 10, 1), "inertial unit", FAIL, "deliver 10 samples/s, at least 20 are needed"),
        (frozen, "inertial unit", FAIL, "readings in a row are the same"),
        (spinning, "inertial unit", FAIL, "zero rate +0.1992"),
        (every(edge=[]), "edge sensors", FAIL, "edge sensors deliver no samples"),
        (thinned("edge", 1, 1), "edge sensors", FAIL, "edge sensors deliver 100 samples/s, at least 200 are needed"),
        (edge(0, 1, 1, 0), "edge sensors", FAIL, "front left and rear right see no panel"),
        (edge(1, 0, 1, 1, only=5), "edge sensors", FAIL, "front right see the panel on and off"),
        (flat, "gravity", FAIL, "is this the right mirror"),
        (gravity(-1.0, -1.0, -1.0), "gravity", FAIL, "the robot reports the reaction (up)"),
        (gravity(1.0, -1.0, 1.0), "gravity", FAIL, "y has the wrong sign"),
        (every(gravity=None), "gravity", WARN, "gravity sensors deliver no samples"),
        (seldom_gravity, "gravity", WARN, "gravity sensors deliver 10 samples/s, at least 14 are needed"),
        (every(soc=0.1), "battery", FAIL, "10%"),
        (every(soc=0.5), "battery", WARN, "50%, for 36 min"),
    ],
)
def test_what_is_wrong_is_found(change: Change, name: str, outcome: CheckOutcome, reported: str) -> None:
    report = stood()
    frames = [msgspec.convert(msgspec.to_builtins(frame), Sensors) for frame in report.frames]
    for frame in frames:
        change(frame)
    (wrong,) = [finding for finding in check_robot(report._replace(frames=frames)) if finding.outcome is not PASS]
    assert (wrong.name, wrong.outcome) == (name, outcome)
    assert reported in wrong.found
    assert wrong.todo


def other_robot(**changes: Any) -> dict[str, Any]:
    robot = msgspec.structs.replace(stood().hello.robot, wheel_base_m=0.2)
    return {"hello": msgspec.structs.replace(stood().hello, robot=robot, **changes)}


@pytest.mark.parametrize(
    ("change", "name", "outcome", "reported"),
    [
        ({"arrived_s": [0.02 * k for k in range(FRAMES)]}, "frames", FAIL, "50.0 a second"),
        ({"arrived_s": [0.01 * k + 0.2 * (k > 100) for k in range(FRAMES)]}, "frames", FAIL, "longest gap 210 ms"),
        ({"arrived_s": [0.01 * k + 0.06 * (k > 100) for k in range(FRAMES)]}, "frames", WARN, "longest gap 70 ms"),
        ({"arrived_s": [0.0105 * k for k in range(FRAMES)]}, "robot clock", FAIL, "runs at 0.95"),
        ({"frames": stood().frames[:1], "arrived_s": [0.0]}, "frames", FAIL, "a single frame"),
        (other_robot(), "robot geometry", FAIL, "wheel_base_m is 0.15 here and 0.2 there"),
        (other_robot(lockstep=True), "robot clock", WARN, "simulated, in lockstep"),
    ],
)
def test_a_wrong_time_or_robot_is_found(
    change: dict[str, Any], name: str, outcome: CheckOutcome, reported: str
) -> None:
    found = by_name(check_robot(stood()._replace(**change)))
    assert found[name].outcome is outcome
    assert reported in found[name].found


def test_fans_below_the_floor_are_reported() -> None:
    report = stood("fyst-m2")
    frames = [msgspec.structs.replace(frame, fans=(0.6, 0.3)) for frame in report.frames]
    assert "the robot would fall" in by_name(check_robot(report._replace(frames=frames)))["fans"].todo
    weak = load_config(None, {"run.mirror": "fyst-m2", "robot.fan_duty": [0.5, 0.8]})
    assert "raise robot.fan_duty" in by_name(check_robot(report._replace(cfg=weak)))["fans"].todo


def test_lasers_and_air() -> None:
    assert check_lasers(connected=True, laser_ready=True).outcome is PASS
    assert "no laser" in check_lasers(connected=False, laser_ready=True).found
    assert "not warm" in check_lasers(connected=True, laser_ready=False).found
    assert check_air(Environment(-5.0, 525.0, 30.0)).outcome is PASS
    for air in (Environment(99.0, 525.0, 30.0), Environment(-5.0, 52.5, 30.0), Environment(-5.0, 525.0, 130.0)):
        assert "not the air of any telescope" in check_air(air).found


def test_a_fix_is_where_a_robot_at_base_has_its_puck() -> None:
    cfg, mirror, *_ = stood()
    at_base = mirror.puck_world(mirror.base_pose, cfg.robot.puck_height_m)

    def fix(position_m: Vector3) -> PreflightResult:
        return check_fix(cfg, mirror, Fix(0.0, position_m, (0.0,) * 9, 1.0, (1, 2, 3, 4), 1e-6))

    assert fix(at_base).outcome is PASS
    high = mirror.puck_world(mirror.base_pose, cfg.robot.puck_height_m + 0.01)
    assert "puck_height_m" in fix(high).todo
    assert "set the robot down at base" in fix((at_base[0] + 0.4, at_base[1], at_base[2])).todo
    assert fix((1e3 * at_base[0], 1e3 * at_base[1], 1e3 * at_base[2])).outcome is FAIL  # millimetres


def test_a_fix_whose_lengths_contradict_each_other_is_no_pass() -> None:
    cfg, mirror, *_ = stood()
    fix = Fix(0.0, mirror.puck_world(mirror.base_pose, cfg.robot.puck_height_m), (0.0,) * 9, 1.0, (1, 2, 3, 4), 1e-6)
    for one, found in (
        (replace(fix, metrology="good"), None),
        (
            replace(fix, metrology="unreliable", suspects=(2, 7)),
            "the lengths contradict each other: channels 2 7",
        ),
        (replace(fix, metrology="good", left_out=(3,)), "not used: channels 3"),
        (replace(fix, metrology="unchecked"), "too few lengths to contradict each other"),
    ):
        result = check_fix(cfg, mirror, one)
        assert (result.outcome is PASS) is (found is None), found
        assert found is None or result.found.endswith(found)
        assert bool(result.todo) is (found is not None)


def test_the_table() -> None:
    found = [*named(a=passed("well"), bc_d=warned("so", "look"), e=failed("bad", "mend")), *skipped(["f"], "no e")]
    assert lines(found) == [
        "pass  a     well",
        "warn  bc d  so",
        "            -> look",
        "fail  e     bad",
        "            -> mend",
        "skip  f     no e",
        "not ready: 1 pass, 1 warn, 1 fail, 1 skip",
    ]
    assert not has_failed(found[:2])
    checks = [{"name": "a", "outcome": "pass", "found": "well", "todo": ""}]
    assert as_json(found[:1]) == {"ready": True, "checks": checks}


def by_name(found: list[PreflightResult]) -> dict[str, PreflightResult]:
    return {finding.name: finding for finding in found}


def test_nobody_there(free_port: int) -> None:
    cfg = load_config(None, {"robot.port": free_port, "etalon.port": free_port, "etalon.retries": 0})
    mirror = build_mirror(cfg.mirror)
    robot = by_name(asyncio.run(probe_robot(cfg, mirror)))
    assert "cannot reach the robot" in robot["robot link"].found
    assert robot["gravity"].outcome is SKIP
    laser = by_name(asyncio.run(probe_laser(cfg, mirror)))
    assert "start the MultiLine server" in laser["laser server"].todo
    assert laser["laser fix"].outcome is SKIP


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
    assert robot["robot link"].outcome is FAIL


def test_keys(tmp_path: Path) -> None:
    key = tmp_path / "link.key"
    cfg = load_config(None, {"robot.key_file": str(key)})
    assert "cannot read" in probe_key(cfg, sim=False).found
    assert by_name(asyncio.run(probe_robot(cfg, build_mirror(cfg.mirror))))["robot link"].outcome is FAIL
    key.write_text("secret")
    key.chmod(0o644)
    assert "is open to others" in probe_key(cfg, sim=False).found
    key.chmod(0o600)
    assert probe_key(cfg, sim=False).outcome is PASS


def machine(tmp_path: Path, runs_dir: str = "runs", realtime_priority: int | None = None) -> dict[str, PreflightResult]:
    cfg = load_config(None, {"run.realtime_priority": realtime_priority})
    return by_name(probe_machine(cfg, tmp_path / runs_dir, tmp_path / "rt", {}))


def test_the_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = machine(tmp_path)
    assert found["disk space"].outcome is found["runtime directory"].outcome is PASS
    assert not (tmp_path / "runs").exists()  # nothing is made
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr("ccatp.commissioning.probes.shutil.disk_usage", lambda _: usage(1, 1, 1_000_000))
    monkeypatch.setattr("ccatp.commissioning.probes._slowest_write_s", lambda _: 0.5)
    found = machine(tmp_path)
    assert found["disk space"].outcome is FAIL
    assert "took 500.0 ms" in found["disk writes"].found

    def refuse(_: Path) -> float:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("ccatp.commissioning.probes._slowest_write_s", refuse)
    assert machine(tmp_path)["disk writes"].outcome is FAIL


def test_no_run_can_be_written_there(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for where, reported in (
        ("file", "is no directory"),
        ("file/runs", "no directory"),
        ("nowhere/runs", "no directory"),
    ):
        found = machine(tmp_path, where)
        assert found["disk"].outcome is FAIL
        assert reported in found["disk"].found
        assert "disk space" not in found


def test_a_daemon_that_runs_is_reported(tmp_path: Path) -> None:
    (tmp_path / "rt").mkdir(mode=0o700)
    with (tmp_path / "rt" / "lock").open("w") as file:
        flock(file, LOCK_EX)
        assert "a daemon runs in" in machine(tmp_path)["runtime directory"].found
    (tmp_path / "rt").chmod(0o777)
    assert "open to others" in machine(tmp_path)["runtime directory"].found


def test_clock_and_real_time(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    then = time.gmtime(0)
    monkeypatch.setattr("ccatp.commissioning.probes.time.gmtime", lambda: then)
    monkeypatch.setattr("ccatp.commissioning.probes.os.geteuid", lambda: 1000)
    monkeypatch.setattr("ccatp.commissioning.probes.resource.getrlimit", lambda _: (0, 0))
    found = machine(tmp_path)
    assert found["machine clock"].outcome is FAIL
    assert found["real time"].outcome is WARN
    assert machine(tmp_path, realtime_priority=0)["real time"].outcome is PASS


def test_the_command_fails_where_one_fails(tmp_path: Path, free_port: int, capsys: pytest.CaptureFixture[str]) -> None:
    config = tmp_path / "a.toml"
    config.write_text(f"[robot]\nport = {free_port}\n[etalon]\nport = {free_port}\nretries = 0\n")
    command = ["check", "--config", str(config), "--runtime-dir", str(tmp_path / "rt"), "--runs-dir", str(tmp_path)]
    out = printed(capsys, *command, status=1)
    assert "fail  robot link" in out
    assert "not ready: " in out
    assert json.loads(printed(capsys, *command, "--json", status=1))["ready"] is False
    config.write_text("[robot]\nport = 'x'\n")
    assert "fail  configuration" in printed(capsys, *command, status=1)
    assert "--config FILE, or add --sim" in refused(capsys, "check")
    config.write_text("[observatory]\nendpoint = 'tcp://127.0.0.1:7020'\nkey_file = 'a'\nclients_file = 'b'\n")
    assert "fail  observatory keys" in printed(capsys, *command, status=1)


@pytest.mark.parametrize(
    ("settings", "outcome", "todo"),
    [
        ({"run.panels": 2}, "pass", ""),
        ({"run.panels": 8, "run.budget_s": 360.0}, "warn", 'run.order = "optimised" takes about '),
        ({"run.panels": 8, "run.budget_s": 60.0}, "warn", "no order keeps it"),
    ],
)
def test_a_survey_that_takes_longer_than_its_budget_is_reported(
    settings: dict[str, object], outcome: str, todo: str
) -> None:
    cfg = load_config(None, settings)
    found = check_time(cfg, build_mirror(cfg.mirror))
    assert found.outcome == outcome
    assert found.todo.startswith(todo)
    assert ("more than run.budget_s" in found.found) == (outcome == "warn")


def test_a_survey_without_a_way_fails_the_check() -> None:
    cfg = load_config(None, {"run.panels": 1, "mission.leg_clearance_m": 0.12})
    found = check_time(cfg, build_mirror(cfg.mirror))
    assert (found.outcome, found.todo) == ("fail", "see ccatp plan")
