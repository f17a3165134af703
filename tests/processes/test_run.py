"""``ccatp run --sim`` as a whole: processes, sockets, run directory, summary."""

import json
import os
import signal
import socket
import sqlite3
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil
import pytest

from ccatp.config.load import load_config
from ccatp.links.topics import TOPICS
from ccatp.records.recorder import iter_messages
from tests.processes.conftest import Run

Start = Callable[..., Run]


def measured_in_store(run: Run) -> int:
    with sqlite3.connect(run.run_dir / "mission.sqlite") as db:
        count: int = db.execute("SELECT count(*) FROM points WHERE status = 'measured'").fetchone()[0]
    db.close()
    return count


def without_wall(summary: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in summary.items() if key != "wall"}


@pytest.mark.parametrize("mirror", ["fyst-m1", pytest.param("thesis-m2", marks=pytest.mark.slow)])
def test_two_panels(start: Start, mirror: str) -> None:
    run = start("--mirror", mirror, "--panels", "2", "--json", calibrates=mirror == "fyst-m1")
    assert run.wait() == 0, run.stderr
    summary = json.loads(run.stdout)  # nothing else on standard output
    assert summary == run.summary
    points = {"total": 18, "measured": 18, "first_arrival_within_10mm": 18, "skipped": 0}
    assert summary["points"] == points
    assert summary["danger"] == {"true_edges": 0, "false_edges": 0, "falls": 0, "max_overrun_mm": 0.0}
    assert summary["arrival_error_mm"]["max"] < 10.0
    assert summary["lower_bound_s"] < summary["mission_time_s"] < 1.2 * summary["lower_bound_s"]
    assert summary["panels"]["count"] == 2
    # Nine fixes of some 5 um each: a piston to a few um, a tilt to some 10 urad.
    assert summary["panels"]["piston_rms_um"] < 15.0
    assert summary["panels"]["tilt_rms_urad"] < 60.0
    assert measured_in_store(run) == 18
    assert load_config(run.run_dir / "config.toml").run.panels == 2
    recorded = {message.topic for message in iter_messages(run.run_dir / "telemetry.mcap")}
    # Nothing went wrong, so there is nothing that the localizer had to be treated for.
    of_surveys = {t.name for t in TOPICS if t.recorded and not t.name.startswith("beacon_")}
    views = {topic for topic in recorded if topic.startswith("view/")}
    assert recorded - views - {"danger_event"} == of_surveys - {"danger_event", "treatment"}
    assert {"view/pose", "view/true_pose", "view/panels", "view/points", "view/log"} <= views
    log = [json.loads(line) for line in (run.run_dir / "log.jsonl").read_text().splitlines()]
    assert {"main", "danger", "supervisor", "dataloop"} <= {entry["logger"] for entry in log}
    assert "SIMULATION" in run.stderr
    # The run ends by naming its report, which is whole.
    assert run.stderr.rstrip().endswith(f"report  {run.run_dir / 'report.html'}")
    report = (run.run_dir / "report.html").read_text()
    assert "18 pass" in report
    assert "Not in this run" not in report


@pytest.mark.slow  # in process and through the sockets: test_rehearsal
def test_the_same_seed_gives_the_same_summary_and_another_does_not(start: Start) -> None:
    summaries = []
    for seed in (7, 7, 8):
        run = start("--panels", "1", "--seed", str(seed))
        assert run.wait() == 0, run.stderr
        summaries.append(without_wall(run.summary))
    assert summaries[0] == summaries[1]
    assert summaries[0] | {"seed": 8} != summaries[2]


def test_four_processes_beside_the_supervisor(start: Start) -> None:
    run = start("--panels", "1", "--realtime")
    run.until(lambda status: status["state"] == "driving")
    modules = {" ".join(child.cmdline()).split("ccatp.daemon.")[1].split()[0] for child in children(run)}
    assert modules == {"sim_robot", "sim_etalon", "danger_loop", "main_loop"}
    run.process.send_signal(signal.SIGINT)
    assert run.wait() == 130
    assert "Traceback" not in run.stderr
    assert f"report  none; make it with: ccatp report {run.run_dir}" in run.stderr
    assert not (run.run_dir / "report.html").exists()


def children(run: Run) -> list[psutil.Process]:
    return psutil.Process(run.process.pid).children()


def test_a_simulated_robot_that_dies_ends_the_run_with_a_line(start: Start) -> None:
    run = start("--panels", "1", "--realtime")
    run.until(lambda status: status["state"] == "driving")
    victim = next(child for child in children(run) if "ccatp.daemon.sim_robot" in child.cmdline())
    os.kill(victim.pid, signal.SIGKILL)
    assert run.wait() == 4
    assert "Traceback" not in run.stderr
    assert "process dataloop was killed by SIGKILL: run ended, wheels held" in run.stderr
    assert measured_in_store(run) == run.summary["points"]["measured"]


@pytest.mark.parametrize(
    "state", ["driving", *(pytest.param(name, marks=pytest.mark.slow) for name in ("turning", "measuring"))]
)
def test_emergency_brings_the_robot_to_base(start: Start, state: str) -> None:
    run = start("--panels", "1", "--realtime")
    run.until(lambda status: status["done"] >= 1 and status["state"] == state)
    identity = "8c0e5f9e-6a1f-4b8e-9a51-0d5b2f4f2f10"
    reply = run.ask("emergency", channel="emergency", kind="fire", id=identity)
    assert reply == {"ok": True, "id": identity, "latched": True, "code": 2}
    assert run.ask("emergency", channel="emergency", kind="fire", id=identity)["ok"]  # harmless
    assert run.wait() == 3, run.stderr
    assert measured_in_store(run) == run.summary["points"]["measured"] >= 1
    assert run.summary["danger"]["falls"] == 0


def test_pause_holds_resume_goes_on_stop_ends(start: Start) -> None:
    run = start("--panels", "1", "--realtime")
    run.until(lambda status: status["state"] == "driving")
    reply = run.ask("pause")
    assert reply["ok"]
    assert reply["status"]["state"] == "held"
    assert run.ask("status")["status"]["state"] == "held"
    assert not run.ask("pause", channel="control")["ok"] or run.ask("status")["status"]["state"] == "held"
    assert run.ask("resume")["ok"]
    assert (
        run.ask("resume") == {"ok": False, "error": "the mission is not held but turning"}
        or not run.ask("resume")["ok"]
    )
    run.until(lambda status: status["done"] >= 1)
    assert run.ask("stop")["ok"]
    assert run.wait() == 4
    assert measured_in_store(run) >= 1


@pytest.mark.slow
def test_pauses_at_the_points_do_no_harm(start: Start) -> None:
    # At a point beside the rim a turn that the route did not plan would sweep a sensor over it.
    run = start("--panels", "1", "--realtime")
    for done in range(4):
        run.until(lambda status, done=done: status["done"] == done and status["state"] == "measuring")  # type: ignore[misc]
        assert run.ask("pause")["ok"]
        assert run.ask("resume")["ok"]
    assert run.wait() == 0, run.stderr
    assert run.summary["points"]["measured"] == 9
    assert run.summary["danger"] == {"true_edges": 0, "false_edges": 0, "falls": 0, "max_overrun_mm": 0.0}


def test_two_interrupts_end_as_one(start: Start) -> None:
    run = start("--panels", "9")
    run.until(lambda status: status["done"] >= 2)
    run.process.send_signal(signal.SIGINT)
    run.process.send_signal(signal.SIGINT)
    assert run.wait() == 130
    assert "Traceback" not in run.stderr
    assert f"report  none; make it with: ccatp report {run.run_dir}" in run.stderr
    assert not (run.run_dir / "report.html").exists()
    assert measured_in_store(run) == run.summary["points"]["measured"] >= 2


def test_lockstep_pause_stops_simulated_time(start: Start) -> None:
    run = start("--panels", "1")
    run.until(lambda status: status["done"] >= 3)
    elapsed = run.ask("pause")["status"]["elapsed_s"]
    time.sleep(0.5)
    # Ten frames a second at most, where a run in progress makes some thousand.
    assert run.ask("status")["status"]["elapsed_s"] - elapsed < 0.2
    assert run.ask("resume")["ok"]
    assert run.wait() == 0, run.stderr
    assert run.summary["points"]["measured"] == 9


def test_an_emergency_is_heard_in_a_lockstep_pause(start: Start) -> None:
    run = start("--panels", "9")
    run.until(lambda status: status["done"] >= 2)
    assert run.ask("pause")["ok"]
    assert run.ask("emergency", channel="emergency", kind="fire", id="8c0e5f9e-6a1f-4b8e-9a51-0d5b2f4f2f10")["ok"]
    assert run.wait() == 3, run.stderr


def test_a_run_directory_belongs_to_one_run(start: Start, tmp_path: Path) -> None:
    first = start("--panels", "1", "--realtime")
    first.until(lambda status: status["state"] == "driving")
    elsewhere = tmp_path.parent / "rt"
    second = Run(first.run_dir, elsewhere, "--resume", "--panels", "1")
    assert second.wait() == 1
    assert "another ccatp runs in" in second.stderr


def test_operator_abort_ends_at_base(start: Start) -> None:
    run = start("--panels", "9")
    run.until(lambda status: status["done"] >= 3)
    assert run.ask("abort")["ok"]
    assert run.wait() == 3, run.stderr


def test_bad_peers_leave_the_survey_undisturbed(start: Start) -> None:
    run = start("--panels", "1")
    run.until(lambda status: status["state"] == "driving")
    garbage = [b"\x00\xff\n", b'{"type":"join","role":"king"}\n', b'{"type":"join","role":"controller","client":"x"}\n']
    for payload in (*garbage, b"x" * 1_000_000 + b"\n"):
        for port in (run.config_port, run.etalon_port):
            with socket.create_connection(("127.0.0.1", port), timeout=5.0) as peer:
                peer.settimeout(5.0)
                try:
                    peer.sendall(payload)
                    peer.recv(4096)
                except (ConnectionResetError, BrokenPipeError):
                    pass  # refused: as it should be
    assert run.wait() == 0, run.stderr
    assert run.summary["points"]["measured"] == 9
    assert run.summary["danger"]["false_edges"] == 0


@pytest.mark.fault("P22")
def test_a_second_daemon_in_the_same_place_refuses(start: Start) -> None:
    first = start("--panels", "1", "--realtime")
    first.until(lambda status: status["state"] == "driving")
    second = start("--panels", "1")
    assert second.wait() == 1
    assert second.stderr.count("\n") == 1
    assert "another ccatp runs" in second.stderr


def test_a_port_in_use_is_one_line_and_status_2(start: Start) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        run = start("--set", f"sim.robot.port={taken.getsockname()[1]}")
        assert run.wait() == 2
    assert run.stderr.count("\n") == 1
    assert "sim.robot.port" in run.stderr


@pytest.mark.slow
def test_a_robot_set_down_wrongly_meets_the_rim_finds_itself_and_measures_everything(start: Start) -> None:
    # Seed 8 sets the robot down 0.1 m beside base, with a sensor almost over the rim.
    run = start("--panels", "1", "--seed", "8", "--set", "world.start_position_sigma_m=0.08")
    assert run.wait() == 0, run.stderr
    assert "backing off" in run.stderr
    assert run.summary["points"]["measured"] == 9
    danger = run.summary["danger"]
    assert (danger["true_edges"], danger["false_edges"], danger["falls"]) == (1, 0, 0)
    assert 0.0 < danger["max_overrun_mm"] <= 20.0


def test_a_point_missed_by_more_than_the_tolerance_is_approached_again(start: Start) -> None:
    # Set down 10 mrad askew, the four-state filter misses the first points by some 4 mm.
    run = start("--panels", "1", "--filter", "kf", "--set", "mission.correction_tolerance_m=0.003")
    assert run.wait() == 0, run.stderr
    assert "approaching it again" in run.stderr
    assert run.summary["points"] == {"total": 9, "measured": 9, "first_arrival_within_10mm": 9, "skipped": 0}


def test_resume_goes_on_with_the_first_unmeasured_point(start: Start, tmp_path: Path) -> None:
    run = start("--panels", "1")
    run.until(lambda status: status["done"] >= 3)
    run.ask("stop")
    assert run.wait() == 4
    done = measured_in_store(run)
    again = Run(run.run_dir, run.runtime_dir, "--resume", "--panels", "1")
    try:
        assert again.wait() == 0, again.stderr
    finally:
        again.end()
    assert done < 9
    assert measured_in_store(again) == 9
    assert again.summary["points"]["measured"] == 9


def test_an_unreachable_robot_is_status_5(tmp_path: Path, runtime_dir: Path, free_port: int) -> None:
    import subprocess

    config = tmp_path / "telescope.toml"
    config.write_text(f"[robot]\nport = {free_port}\nconnect_timeout_s = 1.0\n[etalon]\nport = {free_port}\n")
    command = [sys.executable, "-m", "ccatp", "run", "--config", str(config), "--run-dir", str(tmp_path / "run")]
    ended = subprocess.run(
        [*command, "--runtime-dir", str(runtime_dir)], capture_output=True, text=True, timeout=30.0, check=False
    )
    assert ended.returncode == 5, ended.stderr
    assert "Traceback" not in ended.stderr
    assert str(free_port) in ended.stderr
