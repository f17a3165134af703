"""Random kills and stops of every process over whole missions: `python -m tools.kill_campaign RESULTS`.

A mission is a number: with the seed of the campaign it fixes world, mirror, pace, and at random which signal is sent to
which process in which phase. Each mission that is over is a line of RESULTS. A campaign that was stopped goes on behind
them; what was under way begins again. The folder of a mission with a problem stays beside RESULTS.
"""

import argparse
import json
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from signal import SIGKILL, SIGSTOP
from statistics import median
from typing import Any

import psutil
import zmq

from ccatp.daemon.supervision.process import die_with_parent
from ccatp.links.bus import Subscriber
from ccatp.links.channels import format_request
from ccatp.links.rpc import RequestFailed, request
from ccatp.links.topics import MissionStatus, TruthMessage
from ccatp.records.store import read_survey
from ccatp.survey.planning.route import ORDERS
from tests.support.runs import MODULES, NO_CALIBRATION, RecordedRun, wall_s
from tests.support.scenario import mirror_of

WORLDS = ("thesis", "hard", "extreme", "thesis-x2")
MIRRORS = ("fyst-m1", "fyst-m2", "thesis-m1", "thesis-m2")
PORTS = [f"--set={key}=0" for key in ("sim.robot.port", "sim.etalon.port", "dashboard.port")]
# Three of one process within a minute end a run; here they come closer.
LIMIT = "--set=run.restart_limit=1000"
# A loose contact of an edge sensor: the robot backs off once in each session.
RETREAT = '[[fault]]\nsignal = "edge_front_left"\ntype = "stuck"\nvalue = 0.0\nat_s = {:.2f}\nfor_s = 0.3\n'
PROCESSES = ("supervisor", "dashboard", "dataloop", "etalon", "danger", "main")
VICTIMS = {"main": 10, "danger": 10, "etalon": 4, "dashboard": 2, "dataloop": 2, "supervisor": 2}
VICTIMS |= {"main danger": 4, "main etalon": 2, "main supervisor": 1, "danger dataloop": 1, " ".join(PROCESSES): 1}
STRIKES = 16, 25  # of a mission
STOPS = 0.25  # share of SIGSTOP; the rest are SIGKILL
# The phase that is waited for before a strike, for so long at most, and the mean time after that. What is rare is hit
# whenever it comes; soon after a strike a process is being restarted.
AIMS, RARE = {"any": 8, "leg": 8, "settling": 4, "measuring": 6, "held": 1}, ("retreat", "dock")
AIM_S, ANY_S, GAP_S = 15.0, 0.5, 0.1
PHASES = {"turning": "leg", "driving": "leg", "backing off": "retreat", "returning": "dock", "idle": "start"}
JOINED = ("leg", "settling", "measuring", "retreat", "dock", "held")
ENDED_S, MISSION_S = 30.0, 900.0
HELD_S = 1.0  # what is logged later is of something else
FAILURES = re.compile("Traceback|never retrieved|unhandled_exception")


class Mission:
    """One mission under fire, with as many sessions as it takes.

    Args:
        folder: for run directory and output.
        runtime_dir: for the sockets.
    """

    def __init__(self, seed: int, number: int, folder: Path, runtime_dir: Path, context: zmq.Context[Any]) -> None:
        self._rng = rng = random.Random(f"{seed}/{number}")
        self._folder, self._runtime_dir, self._run_dir = folder, runtime_dir, folder / "run"
        is_paced, self._mirror = bool(number // 4 % 2), MIRRORS[number // 8 % 4]
        self._panels = 1 if is_paced else 2
        self.row: dict[str, Any] = {"seed": seed, "mission": number, "world": WORLDS[number % 4]}
        self.row |= {"mirror": self._mirror, "mode": "real time" if is_paced else "lockstep"}
        self._left, self._aborts, self._is_aborting = rng.randint(*STRIKES), rng.random() < 0.4, False
        self._last_aims = [aim for aim in ("end", "report") if rng.random() < 0.5]
        self._env = os.environ | ({} if rng.random() < 0.3 else {"MPLBACKEND": "none"})  # without a report
        self._flags = [*PORTS, *(["--realtime"] if is_paced else [])]
        if rng.random() < 0.5:
            (folder / "plan.toml").write_text(RETREAT.format(rng.uniform(2.0, 12.0)))
            self._flags += ["--faults", str(folder / "plan.toml")]
        self._begin = ["--seed", str(seed + number), "--panels", str(self._panels), "--mirror", self._mirror]
        self._begin += ["--world", WORLDS[number % 4], LIMIT, *NO_CALIBRATION]
        endpoints = [f"ipc://{runtime_dir / name}" for name in ("main", "truth")]
        self._subscriber = Subscriber(context, endpoints, ("mission", "truth"), is_uncounted=True)
        self._status: MissionStatus | None = None
        self._before = "start"  # what the phase is until main publishes its status
        self._acknowledged = self._falls = 0
        self._stopped: list[tuple[float, psutil.Process]] = []
        self._deadline_s = time.monotonic() + MISSION_S
        self._strikes: list[tuple[str, str, str, float]] = []
        self._problems: list[str] = []

    def run(self) -> dict[str, Any]:
        """Its line of the results."""
        begun_s, statuses = time.time(), list[int]()
        while (not statuses or statuses[-1] != 0) and not self._problems:
            statuses.append(self._session())
            if self._rng.random() < 0.5:  # else the next one comes while processes of this one are still there
                self._await_end()
        self._await_end()
        self._subscriber.close()
        self.row |= {"took_s": round(time.time() - begun_s, 1), "statuses": statuses, "strikes": self._strikes}
        if not self._problems:
            self.row |= self._outcome()
        return self.row | {"problems": self._problems}

    def _session(self) -> int:
        """One `ccatp run`, new or resumed, to its end; its exit status."""
        store = self._run_dir / "mission.sqlite"
        if is_resumed := store.exists():
            stored = [point.status for point in read_survey(store, self._mirror).points].count("measured")
            if stored < self._acknowledged:
                self._problems.append(f"{self._acknowledged} measurements were acknowledged, {stored} are stored")
        self._status, self._before = None, "resume" if is_resumed else "start"
        command = [sys.executable, "-m", "ccatp", "run", "--sim", "--run-dir", str(self._run_dir), "--runtime-dir"]
        command += [str(self._runtime_dir), *self._flags, *(["--resume"] if is_resumed else self._begin)]
        first = len(self._strikes)
        with (self._folder / "stdout").open("ab") as out, (self._folder / "stderr").open("ab") as err:
            self._supervisor = psutil.Popen(
                command, stdin=subprocess.DEVNULL, stdout=out, stderr=err, env=self._env, preexec_fn=die_with_parent
            )
        if self._left > 0 and self._rng.random() < 0.4:
            self._wait(self._rng.uniform(0.0, 2.0))
            self._strike()
        while self._is_running:
            if self._aborts and self._acknowledged > 2:
                self._aborts, self._is_aborting = False, True
                with suppress(RequestFailed):
                    request(f"ipc://{self._runtime_dir / 'control'}", format_request("abort"), timeout_s=2.0)
            elif self._left > 0:
                self._aim(self._rng.choices([*AIMS], [*AIMS.values()])[0], AIM_S)
            elif self._last_aims:
                self._aim(self._last_aims.pop(0), MISSION_S)
            else:
                self._wait(0.1)
        status = self._supervisor.wait()
        killed = {name for _, name, number, _ in self._strikes[first:] if number == "SIGKILL"}
        if "supervisor" not in killed:
            last = (self._folder / "stderr").read_text().splitlines()[-2:]
            if not (status == 0 or (status == 3 and self._is_aborting) or (status == 4 and "dataloop" in killed)):
                self._problems.append(f"status {status}: {last}")
            self._is_aborting = self._is_aborting and status != 3  # one that was cut off is gone on with
            log = (self._run_dir / "log.jsonl").read_text()
            logged = [json.loads(line)["status"] for line in log.splitlines() if '"run_finished"' in line]
            if logged[-1:] != [status]:
                self._problems.append(f"status {status}, the log says {logged}: {last}")
        return status

    @property
    def _is_running(self) -> bool:
        if time.monotonic() < self._deadline_s:
            return self._supervisor.poll() is None
        self._problems.append(f"not over within {MISSION_S:.0f} s: {self._status}")
        self._supervisor.kill()
        return False

    def _processes(self) -> dict[str, psutil.Process]:
        """The processes of this run directory by name; one of an earlier session has its number as name."""
        found: dict[str, psutil.Process] = {}
        for process in psutil.process_iter(["cmdline", "ppid"]):
            command = process.info["cmdline"] or ()
            if str(self._run_dir) not in command:
                continue
            names = [name for name in PROCESSES if MODULES.get(name) in command]
            is_ours = names and process.info["ppid"] == self._supervisor.pid
            is_supervisor = process.pid == self._supervisor.pid
            found["supervisor" if is_supervisor else names[0] if is_ours else str(process.pid)] = process
        return found

    def _await_end(self) -> None:
        """The supervisor is gone: so are its children soon, those that were stopped once they go on."""
        end_s = time.monotonic() + ENDED_S
        while (left := self._processes()) and (time.monotonic() < end_s or self._stopped):
            self._wait(0.02)
        for process in left.values():
            self._problems.append(f"left over: {process.info['cmdline']}")
            process.kill()

    # -- strikes --------------------------------------------------------------------------------------------------

    @property
    def _phase(self) -> str:
        if self._status is None:
            return self._before
        if self._status.exit_status < 0:
            return PHASES.get(self._status.state, self._status.state)
        return "report" if [*self._processes()] == ["supervisor"] else "end"

    def _wait(self, for_s: float) -> None:
        """Receive for so long, and let processes go on that were stopped for a time."""
        end_s = time.monotonic() + for_s
        while received := self._subscriber.receive(max(end_s - time.monotonic(), 0.0)):
            message = received[2]
            if isinstance(message, MissionStatus):
                self._status, self._acknowledged = message, max(self._acknowledged, message.done)
            elif isinstance(message, TruthMessage):
                self._falls += any(row[9] for row in message.rows)
        for due in [one for one in self._stopped if time.monotonic() >= one[0]]:
            self._stopped.remove(due)
            with suppress(psutil.NoSuchProcess):
                due[1].resume()

    def _aim(self, phase: str, timeout_s: float) -> None:
        """Strike in a phase, or in another one after some time."""
        end_s = time.monotonic() + (self._rng.expovariate(1.0 / ANY_S) if phase == "any" else timeout_s)
        while self._is_running and time.monotonic() < end_s and self._phase not in (phase, *RARE):
            self._wait(0.01)
        self._wait(self._rng.expovariate(1.0 / GAP_S))
        self._strike()

    def _strike(self) -> None:
        rng, phase, processes = self._rng, self._phase, self._processes()
        names = "supervisor" if phase == "report" else rng.choices([*VICTIMS], [*VICTIMS.values()])[0]
        number = SIGSTOP if rng.random() < STOPS else SIGKILL
        for_s = rng.expovariate(2.0) if rng.random() < 0.7 else rng.uniform(2.0, 4.0)
        at_s = round(time.time(), 4)
        for name in names.split():
            if name in processes:
                with suppress(psutil.NoSuchProcess):
                    processes[name].send_signal(number)
                    self._strikes.append((phase, name, number.name, at_s))
                    self._left -= 1
                if number is SIGSTOP:
                    self._stopped.append((time.monotonic() + for_s, processes[name]))
                elif name == "main":
                    self._wait(0.01)
                    self._status, self._before = None, "restart"

    # -- what became of it ----------------------------------------------------------------------------------------

    def _outcome(self) -> dict[str, Any]:
        run, planned = RecordedRun(self._folder), ORDERS["thesis"](mirror_of(self._mirror), self._panels)
        fixes, points = run.fixes, run.summary["points"]
        counts = {"lost": max(self._acknowledged, len(planned)) - len({*fixes}), "twice": len(fixes) - len({*fixes})}
        counts["falls"] = self._falls + run.summary["danger"]["falls"]
        statistics = [entry["fan_changes"] for entry in run.log if entry["event"] == "robot_statistics"]
        counts["fan_changes"] = sum(max(changes - 1, 0) for changes in statistics)
        if any(counts.values()) or {*fixes} != {(*point,) for point in planned}:
            self._problems.append(f"{counts}; fixes in the store: {fixes}")
        if (points["total"], points["measured"], points["skipped"], run.measured) != (
            *[len(planned)] * 2,
            0,
            len(fixes),
        ):
            self._problems.append(f"{points} in the summary, {run.measured} of {len(planned)} in the store")
        for text in (run.stderr, (self._run_dir / "log.jsonl").read_text()):
            self._problems += [line[:400] for line in text.splitlines() if FAILURES.search(line)]
        # From kills of main to the robot holding its wheels, and to a successor having joined.
        lost_s = [wall_s(e) for e in run.log if e.get("text", "").startswith("controller lost")]
        joined_s = [wall_s(e) for e in run.log if e.get("text", "").startswith("joined the robot")]
        held_ms, ready_s = list[float](), list[float]()
        for phase, name, number, at_s in self._strikes:
            if name == "main" and number == "SIGKILL" and phase in JOINED:
                next_s = min((s for *_, s in self._strikes if s > at_s), default=float("inf"))
                held_ms += [round(1e3 * (s - at_s), 1) for s in lost_s if 0.0 <= s - at_s < HELD_S][:1]
                ready_s += [round(s - at_s, 2) for s in joined_s if at_s < s < next_s][:1]
        return {"points": len(planned), **counts, "held_ms": held_ms, "ready_s": ready_s}


def run_mission(seed: int, keep: Path, number: int) -> dict[str, Any]:
    """The line of one mission; its folder stays where there was a problem."""
    folder = keep / f"{seed}-{number}"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    with tempfile.TemporaryDirectory(prefix="ccatp-", ignore_cleanup_errors=True) as sockets, zmq.Context() as context:
        row = Mission(seed, number, folder, Path(sockets), context).run()
    if not row["problems"]:
        shutil.rmtree(folder)
    return row


def read_results(path: Path) -> list[dict[str, Any]]:
    """The missions that are over; a line that was cut off is of none."""
    rows = []
    for line in path.read_text().splitlines() if path.exists() else ():
        with suppress(ValueError):
            rows.append(json.loads(line))
    return rows


def report(rows: list[dict[str, Any]]) -> Iterator[str]:
    """The figures of a campaign, line by line."""
    strikes = [strike for row in rows for strike in row["strikes"]]
    sent = Counter(number for _, _, number, _ in strikes)
    yield f"{len(rows)} missions in {sum(row['took_s'] for row in rows):.0f} s, {len(strikes)} signals: {dict(sent)}"
    for key in ("mode", "world", "mirror"):
        yield f"{key}: {dict(Counter(row[key] for row in rows for _ in row['strikes']))}"
    phases = sorted({phase for phase, *_ in strikes})
    yield " ".join(f"{text:>10}" for text in ("", *phases))
    for name in PROCESSES:
        counts = Counter(phase for phase, its, *_ in strikes if its == name)
        yield " ".join(f"{text:>10}" for text in (name, *(counts[phase] for phase in phases)))
    statuses = Counter(status for row in rows for status in row["statuses"])
    yield f"sessions by exit status: {dict(statuses)}; {statuses.total() - len(rows)} resumed"
    keys = ("points", "lost", "twice", "falls", "fan_changes")
    yield ", ".join(f"{sum(row.get(key, 0) for row in rows)} {key}" for key in keys)
    for key in ("held_ms", "ready_s"):
        values = [value for row in rows for value in row.get(key, ())] or [0.0]
        yield f"{key}: {len(values)} values, median {median(values):.2f}, max {max(values):.2f}"
    for row in rows:
        yield from (f"mission {row['seed']}-{row['mission']}: {problem}" for problem in row["problems"])


def main(arguments: list[str]) -> int:
    """0 if no mission had a problem, 1 if one had."""
    parser = argparse.ArgumentParser(prog="kill_campaign", description=__doc__)
    parser.add_argument("results", type=Path, metavar="RESULTS", help="file with a line for each mission")
    parser.add_argument("--signals", type=int, default=2000, metavar="N", help="in all; 0: report what is there")
    parser.add_argument("--seed", type=int, default=20, metavar="N")
    parser.add_argument("--workers", type=int, default=2, metavar="N", help="missions at a time")
    args = parser.parse_args(arguments)
    rows = read_results(args.results)
    over = {row["mission"] for row in rows if row["seed"] == args.seed}
    todo = [number for number in range(args.signals) if number not in over]
    work = partial(run_mission, args.seed, args.results.absolute().with_suffix(".missions"))
    sent = sum(len(row["strikes"]) for row in rows)
    # Workers and the missions in them end with this process, whatever ends it.
    with get_context("spawn").Pool(args.workers, die_with_parent) as pool, args.results.open("a") as file:
        file.write("\n")  # the line before may have been cut off
        for row in pool.imap_unordered(work, todo) if sent < args.signals else ():
            file.write(json.dumps(row) + "\n")
            file.flush()
            rows.append(row)
            sent += len(row["strikes"])
            line = " ".join(str(row[key]) for key in ("mission", "world", "mirror", "mode", "statuses", "took_s"))
            print(f"{sent} signals: {line}", *row["problems"], sep="\n  ", flush=True)
            if sent >= args.signals:
                break
    print(*report(rows), sep="\n")
    return 1 if any(row["problems"] for row in rows) else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
