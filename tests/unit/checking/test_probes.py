"""Tests of the probes: what is not there is told in one line, with what to do."""

import asyncio
import json
import socket
import threading
import time
from collections import namedtuple
from fcntl import LOCK_EX, flock
from pathlib import Path

import pytest

from ccatp.cli import main
from ccatp.commissioning.preflight import CheckOutcome, PreflightResult
from ccatp.commissioning.probes import probe_keys, probe_laser, probe_machine, probe_robot
from ccatp.config.load import load_config
from ccatp.mirror.mirror import build_mirror


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
