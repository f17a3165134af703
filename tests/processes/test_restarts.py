"""A process may die, or hang, at any instant: the wheels are held, another one takes its place, the survey goes on."""

import os
import signal
import sqlite3
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest

from tests.processes.conftest import NO_CALIBRATION, Run
from tests.processes.killing import child, first_after, log_of, robot_record, send, wall_s

Start = Callable[..., Run]
Measured = Callable[[str, float], None]
SOUND = {"true_edges": 0, "false_edges": 0, "falls": 0, "max_overrun_mm": 0.0}


def fixes(run: Run) -> list[tuple[int, int, int]]:
    """Points of all fixes that were ever committed, replaced ones, too."""
    db = sqlite3.connect(run.run_dir / "mission.sqlite")
    rows = db.execute("SELECT row, col, point FROM fixes ORDER BY id").fetchall()
    db.close()
    return rows


def until_driving(run: Run, done: int) -> None:
    run.until(lambda status: status["done"] >= done and status["state"] == "driving", timeout_s=60.0)


def until_another(run: Run, name: str, pid: int) -> None:
    deadline_s = time.monotonic() + 20.0
    while time.monotonic() < deadline_s:
        try:
            if child(run, name).pid != pid:
                return
        except (StopIteration, psutil.NoSuchProcess):
            pass
        time.sleep(0.01)
    raise AssertionError(f"no other {name} has come")


@pytest.mark.fault("P1", "P2", "P17")
def test_main_and_danger_are_killed_and_the_survey_goes_on(start: Start, measured: Measured) -> None:
    run = start("--panels", "1", *NO_CALIBRATION)
    until_driving(run, 1)
    _, main_s = send(run, "main")
    run.until(lambda status: status["done"] >= 3)
    danger_pid, _ = send(run, "danger")
    until_another(run, "danger", danger_pid)
    run.until(lambda status: status["done"] >= 5)
    main_pid, _ = send(run, "main")
    send(run, "danger")
    until_another(run, "main", main_pid)
    assert run.wait() == 0, run.stderr
    assert run.summary["points"]["measured"] == 9
    assert run.summary["danger"]["falls"] == 0
    assert len(fixes(run)) == len(set(fixes(run))) == 9  # none lost, none measured again, none counted twice
    assert robot_record(run)["fan_changes"] <= 1
    assert "Traceback" not in run.stderr
    measured("P1", 1e3 * first_after(run, main_s, "dataloop", "controller lost"))


@pytest.mark.slow
@pytest.mark.fault("E6")
def test_the_laser_system_is_killed_and_the_survey_goes_on(start: Start) -> None:
    run = start("--panels", "1", *NO_CALIBRATION)
    until_driving(run, 1)
    pid, _ = send(run, "etalon")
    until_another(run, "etalon", pid)
    assert run.wait() == 0, run.stderr
    assert run.summary["points"] == {"total": 9, "measured": 9, "first_arrival_within_10mm": 9, "skipped": 0}


@pytest.mark.fault("P6")
def test_a_main_loop_that_is_stopped_and_goes_on_decides_nothing_by_old_frames(start: Start) -> None:
    run = start("--panels", "1", "--realtime")
    until_driving(run, 0)
    pid, _ = send(run, "main", signal.SIGSTOP)
    time.sleep(1.0)  # of frames that wait for it
    os.kill(pid, signal.SIGCONT)
    run.until(lambda status: status["done"] >= 1)
    assert child(run, "main").pid == pid
    assert run.ask("stop")["ok"]
    assert run.wait() == 4
    record = robot_record(run)
    # The oldest frame that moved the robot is one of the ordinary delay of a busy machine, and not of the second.
    assert record["oldest_ack_frames"] < 30
    assert run.summary["danger"]["falls"] == 0
    withheld = [
        entry for entry in log_of(run) if entry["logger"] == "danger" and entry["event"] == "verdict_changed"
        and entry["cause"] == "estimate stale"
    ]  # fmt: skip
    assert withheld


@pytest.mark.slow
@pytest.mark.fault("P7")
def test_a_main_loop_that_hangs_is_killed_and_another_one_goes_on(start: Start) -> None:
    run = start("--panels", "1", *NO_CALIBRATION)
    until_driving(run, 1)
    pid, _ = send(run, "main", signal.SIGSTOP)
    until_another(run, "main", pid)
    assert run.wait() == 0, run.stderr
    assert "process main sent no heartbeat for 2 s and was killed: restarting it" in run.stderr
    assert run.summary["points"]["measured"] == 9


@pytest.mark.fault("P18")
def test_a_main_loop_that_always_dies_ends_the_run_held(start: Start) -> None:
    run = start("--panels", "1", "--set", "run.restart_limit=2", *NO_CALIBRATION)
    until_driving(run, 0)
    for _ in range(2):
        pid, _ = send(run, "main")
        until_another(run, "main", pid)
    send(run, "main")
    assert run.wait() == 4
    line = "process main was killed by SIGKILL, more than 2 times within 60 s: run ended, wheels held"
    assert run.stderr.count(line) == 1
    assert "Traceback" not in run.stderr


@pytest.mark.slow
@pytest.mark.fault("P1")
def test_an_abort_and_a_pause_survive(start: Start) -> None:
    run = start("--panels", "4", *NO_CALIBRATION)
    run.until(lambda status: status["done"] >= 2)
    assert run.ask("pause")["ok"]
    pid, _ = send(run, "main")
    until_another(run, "main", pid)
    status = run.until(lambda status: status["seq"] >= 0)
    assert (status["state"], status["cause"]) == ("held", "operator")
    identity = "8c0e5f9e-6a1f-4b8e-9a51-0d5b2f4f2f10"
    assert run.ask("emergency", channel="emergency", kind="fire", id=identity)["latched"]
    danger_pid, _ = send(run, "danger")
    send(run, "main")
    until_another(run, "danger", danger_pid)
    assert run.wait() == 3, run.stderr


HALF_OPEN = """
[[link]]
type = "black_hole"
direction = "both"
at_s = 4.0
for_s = 1.0

[[link]]
type = "black_hole"
direction = "to_client"
at_s = 16.0
for_s = 1.0
"""


@pytest.mark.slow
@pytest.mark.fault("L2", "L14")
def test_a_link_that_is_open_and_dead_is_joined_again(start: Start, tmp_path: Path, measured: Measured) -> None:
    plan = tmp_path / "plan.toml"
    plan.write_text(HALF_OPEN)
    run = start("--panels", "1", "--realtime", "--faults", str(plan))
    assert run.wait(180.0) == 0, run.stderr
    assert run.stderr.count("robot link lost: no sensors frame for") == 2
    assert run.stderr.count("again") >= 2
    assert run.summary["points"]["measured"] == 9
    assert run.summary["danger"]["falls"] == 0
    log = log_of(run)
    begun_s = next(
        wall_s(e) for e in log if e["event"] == "fault_begins" and (e["signal"], e["type"]) == ("link", "black_hole")
    )
    noticed_s = next(wall_s(e) for e in log if e["logger"] == "danger" and e["event"] == "sensors_stale")
    assert all(e["samples"] > 0 for e in log if e["event"] == "fault_injected")
    measured("L2", 1e3 * (noticed_s - begun_s))


@pytest.fixture
def begun(start: Start, tmp_path: Path) -> Iterator[Callable[..., Run]]:
    """Starts runs in the run directory of another one."""
    runs: list[Run] = []

    def again(before: Run, *args: str) -> Run:
        runs.append(Run(before.run_dir, before.runtime_dir, *args))
        return runs[-1]

    yield again
    for run in runs:
        run.end()


@pytest.mark.fault("P4", "P5", "P17")
def test_a_service_that_is_restarted_waits_for_an_operator(
    start: Start, begun: Callable[..., Run], measured: Measured
) -> None:
    run = start("--panels", "1", *NO_CALIBRATION)
    until_driving(run, 2)
    orphans = psutil.Process(run.process.pid).children()
    run.process.kill()
    run.wait()
    _, alive = psutil.wait_procs(orphans, timeout=10.0)
    assert not alive
    done = len(fixes(run))
    again_s = time.monotonic()
    again = begun(run, "--resume", "--start-held", "--panels", "1")
    status = again.until(lambda status: status["seq"] >= 0)
    measured("P4", time.monotonic() - again_s)
    assert status["state"] == "held"
    assert status["done"] == done
    text = f"restarted: {done} points are measured and will be left out, {9 - done} are to do; 'ccatp resume' goes on"
    assert status["cause"].startswith(text)
    assert status["point"]
    time.sleep(0.3)
    assert again.ask("status")["status"]["done"] == done
    assert again.ask("resume")["ok"]
    assert again.wait() == 0, again.stderr
    assert len(fixes(again)) == len(set(fixes(again))) == 9
    assert again.summary["danger"]["falls"] == 0


@pytest.mark.fault("P23")
@pytest.mark.parametrize(
    "state", ["driving", *(pytest.param(state, marks=pytest.mark.slow) for state in ("measuring", "held", "turning"))]
)
def test_terminated_in_each_state(start: Start, measured: Measured, state: str) -> None:
    run = start("--panels", "1", "--realtime")
    until_driving(run, 0)
    if state == "held":
        assert run.ask("pause")["ok"]
    run.until(lambda status: status["state"] == state)
    run.process.terminate()
    at_s = time.monotonic()
    assert run.wait() == 130
    took_s = time.monotonic() - at_s
    assert took_s < 5.0
    measured("P23", took_s)
