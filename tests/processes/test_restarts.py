"""A process may die, hang, or find what it left damaged: the wheels are held, the next one goes on with the survey."""

import json
import os
import shutil
import signal
import time
from pathlib import Path

import psutil
import pytest

from ccatp.daemon.supervision.fork_server import MODULE
from ccatp.daemon.supervision.run_dir import CHILDREN_LOCK
from tests.faults.linking import Measured
from tests.processes.conftest import Start
from tests.support.runs import Run, wall_s

# -- the loops --------------------------------------------------------------------------------------------------------


@pytest.mark.fault("P1", "P2", "P17")
def test_main_and_danger_are_killed_and_the_survey_continues(start: Start, measured: Measured) -> None:
    run = start("--panels", "1")
    run.until_state("driving", done=1)
    _, main_s = run.send("main")
    run.until(lambda status: status["done"] >= 2)
    danger_pid, _ = run.send("danger")
    run.child("danger", not_pid=danger_pid)
    run.until(lambda status: status["done"] >= 3)
    main_pid, _ = run.send("main")
    run.send("danger")
    run.child("main", not_pid=main_pid)
    run.until(lambda status: status["done"] >= 4)
    assert run.ask("stop")["ok"]
    assert run.wait() == 4, run.stderr
    assert run.summary["danger"]["falls"] == 0
    # None lost, none measured again, none counted twice.
    assert len(run.fixes) == len(set(run.fixes)) == run.summary["points"]["measured"] == run.measured >= 4
    assert run.robot_record["fan_changes"] <= 1
    assert "Traceback" not in run.stderr
    measured("P1", 1e3 * run.first_after(main_s, "dataloop", "controller lost"))


KILLED = "process etalon was killed by SIGKILL"
HUNG = "process main sent no heartbeat for 2 s and was killed: restarting it"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "number", "line"),
    [
        pytest.param("etalon", signal.SIGKILL, KILLED, marks=pytest.mark.fault("E6")),
        pytest.param("main", signal.SIGSTOP, HUNG, marks=pytest.mark.fault("P7")),
    ],
)
def test_what_is_killed_or_hangs_is_replaced(start: Start, name: str, number: signal.Signals, line: str) -> None:
    run = start("--panels", "1")
    run.until_state("driving", done=1)
    pid, _ = run.send(name, number)
    run.child(name, not_pid=pid)
    assert run.wait() == 0, run.stderr
    assert line in run.stderr
    assert run.summary["points"] == {"total": 9, "measured": 9, "first_arrival_within_10mm": 9, "skipped": 0}


@pytest.mark.fault("P6", "P23")
def test_a_main_loop_that_is_stopped_and_continues_decides_nothing_by_old_frames(
    start: Start, measured: Measured
) -> None:
    run = start("--panels", "1", "--realtime")
    run.until_state("driving")
    pid, _ = run.send("main", signal.SIGSTOP)
    time.sleep(1.0)  # of frames that wait for it
    os.kill(pid, signal.SIGCONT)
    run.until(lambda status: status["done"] >= 1)
    assert run.child("main").pid == pid
    run.until_state("driving")
    measured("P23", terminated(run))
    record = run.robot_record
    # The oldest frame that moved the robot is one of the ordinary delay of a busy machine, and not of the second.
    assert record["oldest_ack_frames"] < 30
    assert run.summary["danger"]["falls"] == 0
    changes = [e for e in run.log if e["logger"] == "danger" and e["event"] == "verdict_changed"]
    assert "estimate stale" in [entry["cause"] for entry in changes]


def terminated(run: Run) -> float:
    """Terminate it; the time it took, s."""
    run.process.terminate()
    at_s = time.monotonic()
    assert run.wait() == 130
    return time.monotonic() - at_s


@pytest.mark.slow
@pytest.mark.fault("P23")
@pytest.mark.parametrize("state", ["measuring", "held", "turning"])
def test_terminated_in_each_state(start: Start, measured: Measured, state: str) -> None:
    run = start("--panels", "1", "--realtime")
    run.until_state("driving")
    if state == "held":
        assert run.ask("pause")["ok"]
    run.until_state(state)
    measured("P23", terminated(run))


@pytest.mark.slow
@pytest.mark.fault("P1")
def test_an_abort_and_a_pause_survive(start: Start) -> None:
    run = start("--panels", "4")
    run.until(lambda status: status["done"] >= 2)
    assert run.ask("pause")["ok"]
    pid, _ = run.send("main")
    run.child("main", not_pid=pid)
    status = run.until(lambda status: status["seq"] >= 0)
    assert (status["state"], status["cause"]) == ("held", "operator")
    identity = "8c0e5f9e-6a1f-4b8e-9a51-0d5b2f4f2f10"
    assert run.ask("emergency", channel="emergency", kind="fire", id=identity)["latched"]
    danger_pid, _ = run.send("danger")
    run.send("main")
    run.child("danger", not_pid=danger_pid)
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
    run = start("--panels", "1", "--realtime", "--faults", str(plan), calibrates=True)
    assert run.wait(180.0) == 0, run.stderr
    assert run.stderr.count("robot link lost: no sensors frame for more than") == 2
    assert run.stderr.count("again") >= 2
    assert run.summary["points"]["measured"] == 9
    assert run.summary["danger"]["falls"] == 0
    log = run.log
    begun_s = next(
        wall_s(e) for e in log if e["event"] == "fault_begins" and (e["signal"], e["type"]) == ("link", "black_hole")
    )
    noticed_s = next(wall_s(e) for e in log if e["logger"] == "danger" and e["event"] == "sensors_stale")
    assert all(e["samples"] > 0 for e in log if e["event"] == "fault_injected")
    measured("L2", 1e3 * (noticed_s - begun_s))


# -- the whole run ----------------------------------------------------------------------------------------------------


def flipped(path: Path) -> None:
    """Flip a bit in every hundred bytes."""
    data = bytearray(path.read_bytes())
    data[::100] = bytes(byte ^ 0x10 for byte in data[::100])
    path.write_bytes(data)


@pytest.mark.fault("P4", "P5", "P13", "P16", "P17")
def test_a_service_that_is_restarted_refuses_what_is_damaged_and_waits_for_an_operator(
    start: Start, measured: Measured
) -> None:
    run = start("--panels", "1")
    run.until(lambda status: status["done"] >= 2)
    orphans = psutil.Process(run.process.pid).children()
    loops = [orphan for orphan in orphans if MODULE not in orphan.cmdline()]
    assert len(loops) == len(orphans) - 1
    for orphan in loops:  # a next run waits for them
        held = {Path(file.path) for file in orphan.open_files()}
        assert {folder / CHILDREN_LOCK for folder in (run.run_dir, run.runtime_dir)} <= held
    run.process.kill()
    run.wait()
    _, alive = psutil.wait_procs(orphans, timeout=10.0)
    assert not alive
    done = run.measured
    assert 2 <= done == len(run.fixes) < 9
    checkpoint, database = run.run_dir / "checkpoint", run.run_dir / "mission.sqlite"
    for path, text in (
        (checkpoint, "damaged, so the robot's place is not known; set it at base, remove this file and resume"),
        (database, "damaged"),
    ):
        sound = path.with_name("sound")
        shutil.copyfile(path, sound)
        flipped(path)
        refused = start("--resume", "--panels", "1", run_dir=run.run_dir)
        assert refused.wait() == 2
        assert f"{path}: {text}" in refused.stderr
        assert "Traceback" not in refused.stderr
        assert (refused.summary["points"]["total"], refused.summary["points"]["measured"]) == (9, done)
        sound.replace(path)
    # A summary that cannot be written changes nothing of the outcome.
    (run.run_dir / "summary.json.new").mkdir()  # in its place nothing can be written
    unchanged = json.dumps(run.summary)
    again_s = time.monotonic()
    again = start("--resume", "--start-held", "--panels", "1", "--json", run_dir=run.run_dir)
    again.send("main")  # before its first frame: the next one is held as well
    status = again.until(lambda status: status["seq"] >= 0)
    measured("P4", time.monotonic() - again_s)
    assert (status["state"], status["done"]) == ("held", done)
    text = f"restarted: {done} points are measured and will be skipped, {9 - done} are to do; 'ccatp resume' continues"
    assert status["cause"].startswith(text)
    assert status["point"]
    time.sleep(0.3)
    assert again.ask("status")["status"]["done"] == done
    assert again.ask("resume")["ok"]
    again.until(lambda status: status["done"] >= done + 2)
    assert again.ask("stop")["ok"]
    assert again.wait() == 4, again.stderr
    assert "summary.json: cannot be written" in again.stderr
    assert "Traceback" not in again.stderr
    assert json.dumps(again.summary) == unchanged
    assert json.loads(again.stdout)["danger"]["falls"] == 0
    assert again.measured == len(again.fixes) == len(set(again.fixes)) >= done + 2
