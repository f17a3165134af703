"""The on-board program of the indoor robot in a process of its own: conformance, ends, and whole missions."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from math import hypot, sqrt
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ccatp.beacons.analysis import open_beacons
from ccatp.commissioning.conformance.runner import Conformance
from ccatp.records.recorder import iter_logged
from tests.faults.linking import Measured
from tests.support.beacon_processes import Devices, Driver, Onboard, options
from tests.support.beacon_rig import PIONEER, SLOWER
from tests.support.runs import NO_REPORT

FEW = ("hello", "hello-robot", "frames-times", "frames-faults", "ttl-drive", "fans", "move-forward", "move-clamp")
# Not applicable: authentication, lockstep, edges, a mirror, fan floor, inertial unit. Only with 20 frames a second do
# the frames show that a lost session is held before its time-to-live would have held it.
LACKING = {
    "mac", "mac-wrong", "mac-missing", "mac-nonce", "mac-role", "frames-edge", "mirror", "fan-floor", "gyroscope",
    "accelerometer",
    "lockstep-drive", "lockstep-permit", "lockstep-ack", "lockstep-step", "lockstep-ages", "lockstep-repeat",
}  # fmt: skip


ONLY_BASE = {"devices__radio__is_used": False, "devices__dish__is_used": False}
# Real encoders have no noise of their own; the base is faster than its mission lets it be.
EXACT = {
    "sim__vehicle__speed_sigma_m_s": 0.0,
    "sim__vehicle__turn_rate_sigma_rad_s": 0.0,
    "vehicle__turn_rate_max_rad_s": 5.0,
    "vehicle__speed_max_m_s": 0.5,
}


@pytest.mark.parametrize("only", [FEW, pytest.param((), marks=pytest.mark.slow)], ids=["few", "all"])
def test_the_program_conforms(tmp_path: Path, only: tuple[str, ...]) -> None:
    robot = ONLY_BASE | {"link__frame_hz": 20.0}
    with Devices(tmp_path, "zigbee", EXACT, robot) as devices, Onboard(devices.config) as onboard:
        onboard.wait_for_hello()
        results = Conformance(("127.0.0.1", onboard.port), None, 5.0).run(motion=True, only=only)
    outcomes = {result.check_id: (result.outcome, result.detail) for result in results}
    assert {name for name, (outcome, _) in outcomes.items() if outcome == "not applicable"} <= LACKING
    assert not {name: seen for name, seen in outcomes.items() if seen[0] in ("fail", "undecided")}


# -- ends of the program ----------------------------------------------------------------------------------------------


def end(onboard: Onboard, number: signal.Signals) -> float:
    """Send a signal to the program; the time before, because the program may act sooner than this process goes on."""
    sent_s = time.monotonic()
    onboard.process.send_signal(number)
    return sent_s


@pytest.mark.slow  # times of real processes, which other tests beside them spoil
@pytest.mark.fault("B19")
def test_the_base_stops_by_itself_after_the_program_was_killed(tmp_path: Path, measured: Measured) -> None:
    with Devices(tmp_path, "zigbee", EXACT, ONLY_BASE) as devices, Onboard(devices.config) as onboard:
        with Driver(onboard, 1.0):
            devices.time_of("moves", 0.0, 60.0)
            time.sleep(0.5)
            killed_s = end(onboard, signal.SIGKILL)
            measured("B19", 1e3 * (devices.time_of("stands", killed_s, 5.0) - killed_s), "ms")
        # A program that is started again takes the base over, whose session is still open.
        with Onboard(devices.config) as again, Driver(again, 1.0):
            devices.time_of("moves", killed_s + 0.7, 60.0)


@pytest.mark.slow
@pytest.mark.fault("B20")
def test_the_base_stops_while_the_program_is_stopped_and_goes_on_with_it(tmp_path: Path, measured: Measured) -> None:
    with (
        Devices(tmp_path, "zigbee", EXACT, ONLY_BASE) as devices,
        Onboard(devices.config) as onboard,
        Driver(onboard, 1.0),
    ):
        devices.time_of("moves", 0.0, 60.0)
        time.sleep(0.5)
        stopped_s = end(onboard, signal.SIGSTOP)
        measured("B20", 1e3 * (devices.time_of("stands", stopped_s, 5.0) - stopped_s), "ms")
        resumed_s = end(onboard, signal.SIGCONT)
        devices.time_of("moves", resumed_s, 5.0)


def test_the_wheels_stop_at_once_when_the_program_ends(tmp_path: Path) -> None:
    with Devices(tmp_path, "zigbee", EXACT, ONLY_BASE) as devices, Onboard(devices.config) as onboard:
        with Driver(onboard, 1.0):
            devices.time_of("moves", 0.0, 60.0)
            ended_s = end(onboard, signal.SIGTERM)
            assert devices.time_of("stands", ended_s, 5.0) - ended_s < 0.45  # before the watchdog of the base
        assert onboard.process.wait(10.0) == 0
        assert time.monotonic() - ended_s < 2.0


# -- missions ---------------------------------------------------------------------------------------------------------


@contextmanager
def program(*arguments: str) -> Iterator[tuple[subprocess.Popen[str], int]]:
    """The program's robot in lockstep in a process of its own, and its port."""
    command = [sys.executable, "-m", "tests.support.beacon_program", *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            yield process, int(process.stdout.readline())
        finally:
            process.terminate()


# Mean of 10 or 20 seeds of the simulated robot, and three standard deviations of a seed; in cricket also 0.1 s at
# 0.3 m/s: the truth is noted when the process of the fake devices has its turn.
RMS_M = {"zigbee": 0.073 + 3 * 0.030, "follow": 0.068 + 3 * 0.032, "cricket": 0.005 + 3 * 0.001 + 0.03}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("system", "world"),
    # Real motes never end to send; those of the world begin when it begins, before the robot listens.
    [("zigbee", {}), ("follow", SLOWER), ("cricket", {"listener__mapping_rounds": 100})],
)
def test_missions_of_the_installed_program_over_serial_lines(
    tmp_path: Path, runtime_dir: Path, system: str, world: dict[str, Any]
) -> None:
    with Devices(tmp_path, system, world, {}) as devices, Onboard(devices.config) as onboard:
        onboard.wait_for_hello()
        summary = run_mission(tmp_path, runtime_dir, system, world, onboard.port)
    *_, (utc_offset_ns, _) = iter_logged(
        tmp_path / "run" / "telemetry.mcap"
    )  # the first are of before the robot's clock
    assert utc_offset_ns is not None
    track, truth = open_beacons(tmp_path / "run").track(), np.array(devices.truth)
    times_s = track["t_s"] + 1e-9 * utc_offset_ns
    is_known = (times_s > truth[0, 0]) & (times_s < truth[-1, 0])
    is_known &= track["t_s"] >= (summary["map"].get("map_time_s") or 0.0)  # before, the robot stands at its start
    x_m, y_m = (np.interp(times_s, truth[:, 0], truth[:, column]) for column in (1, 2))
    errors_m = np.hypot(track["x_m"] - x_m, track["y_m"] - y_m)[is_known]
    rms_m = float(np.sqrt(np.mean(errors_m**2)))
    print(f"{system}: {rms_m:.4f} m over serial lines, at most {RMS_M[system]} m")
    assert len(errors_m) > 0.5 * len(times_s)
    assert rms_m < RMS_M[system]


def run_mission(folder: Path, runtime_dir: Path, system: str, changes: dict[str, Any], port: int) -> dict[str, Any]:
    """Run a mission of the daemon against the robot; its summary."""
    lines = [f"{key.replace('__', '.')} = {json.dumps(value)}" for key, value in (PIONEER | changes).items()]
    config = folder / "mission.toml"
    config.write_text("\n".join([f'system = "{system}"', *lines, f"robot.port = {port}", "dashboard.enabled = false"]))
    run = [sys.executable, "-m", "ccatp", "run", "--config", str(config), "--json"]
    run += ["--run-dir", str(folder / "run"), "--runtime-dir", str(runtime_dir)]
    done = subprocess.run(run, env=os.environ | NO_REPORT, capture_output=True, text=True, timeout=1200, check=False)
    assert done.returncode == 0, done.stderr
    summary: dict[str, Any] = json.loads(done.stdout)
    assert summary["outcome"] == "complete"
    return summary


@pytest.mark.slow
@pytest.mark.parametrize(("system", "changes"), [("zigbee", {}), ("follow", SLOWER), ("cricket", {})])
def test_missions_of_the_processes_through_the_drivers(
    tmp_path: Path, runtime_dir: Path, system: str, changes: dict[str, Any]
) -> None:
    with program(system, *options("set", changes)) as (process, port):
        summary = run_mission(tmp_path, runtime_dir, system, changes, port)
        process.terminate()
        assert process.stdout is not None
        truth = {row[0]: row[2:4] for row in json.loads(process.stdout.read())}
    begun_s = summary["map"].get("map_time_s") or 0.0  # before it has mapped motes, the robot stands at its start
    track = open_beacons(tmp_path / "run").track()
    rows = [k for k, seq in enumerate(track["frame"]) if seq in truth and track["t_s"][k] >= begun_s]
    assert len(rows) > 0.5 * len(track["frame"])
    squares = [hypot(track["x_m"][k] - truth[seq][0], track["y_m"][k] - truth[seq][1]) ** 2
               for k in rows for seq in [track["frame"][k]]]  # fmt: skip
    # Twice the error of the simulated robot of this seed, which draws other noise: 0.038, 0.055 and 0.0053 m.
    assert sqrt(sum(squares) / len(squares)) < {"zigbee": 0.076, "follow": 0.11, "cricket": 0.0106}[system]
