"""THE process table, and one run of it: start of the children, supervision, summary."""

import json
import os
import signal
import socket
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

import zmq

from ccatp.config.beacon_models import RadioConfig
from ccatp.config.load import dump_config, is_radio_file, load_config, load_radio_config
from ccatp.config.models import Config, ProcessesConfig
from ccatp.daemon.child_processes import (
    ProcessEnd,
    ProcessManager,
    ProcessSpec,
    RestartDecision,
    listen,
    simulator_addresses,
    with_addresses,
)
from ccatp.daemon.collector import Collector, RunAccess
from ccatp.daemon.command_handlers import check_observatory
from ccatp.daemon.dashboard import PageSocket, open_page_socket
from ccatp.daemon.process import FAULTS_FILE, LEVELS, OPERATOR_MESSAGE, RUN_DIR_FILE, Endpoints, open_log
from ccatp.daemon.run_dir import (
    RunOptions,
    clear_finished,
    default_run_dir,
    find_resumable,
    finished_summary,
    mark_resumable,
    new_run_dir,
    own_runtime_dir,
    owned,
    survey_run_dir,
    take_over_emergencies,
)
from ccatp.daemon.service import Service, take_from
from ccatp.daemon.survey_collector import RunCollector
from ccatp.daemon.terminal import BeaconRunView, RunView, survey_title, write_run_report
from ccatp.errors import ConfigError, ExitStatus
from ccatp.links.robot_link import read_key
from ccatp.links.runtime_dir import make_runtime_dir
from ccatp.links.topics import Heartbeat
from ccatp.records.recorder import RUN_LOCK
from ccatp.report.dashboard.access import read_token


class MissionType(NamedTuple):
    """What differs between the kinds of missions.

    Attributes:
        rows: of the process table.
        processes: time-outs and restart limits.
        facts: of the run, for the log.
        make_view: given the run directory.
    """

    rows: tuple[ProcessSpec, ...]
    processes: ProcessesConfig
    facts: dict[str, object]
    make_collector: Callable[[RunAccess], Collector]
    make_view: Callable[[Path], RunView]


def survey_type(cfg: Config, *, is_sim: bool) -> MissionType:
    """The survey of a mirror, simulated or real."""
    title = survey_title(cfg, is_sim=is_sim)
    return MissionType(
        PROCESSES,
        cfg.run,
        {"mirror": cfg.mirror.name, "seed": cfg.run.seed, "sim": is_sim},
        lambda access: RunCollector(access, cfg),
        lambda run_dir: RunView(title, is_sim=is_sim, run_dir=run_dir),
    )


def beacon_type(cfg: RadioConfig, *, is_sim: bool) -> MissionType:
    """A mission among beacons, simulated or real."""
    # A survey starts a fifth of a second sooner without the statistics that come along.
    from ccatp.daemon.collector import BeaconCollector  # noqa: PLC0415

    what, goals = ("follow a radio", "seconds") if cfg.follow.is_active else ("visit waypoints", "waypoints")
    seed = f", seed {cfg.run.seed}" if is_sim else ""
    title = f"ccatp {'SIMULATION' if is_sim else 'mission'} among beacons: {cfg.system}, {what}{seed}"
    return MissionType(
        BEACON_PROCESSES,
        cfg.processes,
        {"system": cfg.system, "seed": cfg.run.seed, "sim": is_sim},
        lambda access: BeaconCollector(access, cfg),
        lambda run_dir: BeaconRunView(title, is_sim=is_sim, run_dir=run_dir, goals=goals),
    )


POLL_MS = 20
# In lockstep the three that answer each other keep both cores of a small machine busy: recording takes what they leave.
LOCKSTEP_NICENESS = 10


class SupervisedRun:
    """The children of one run and what is collected from them.

    Args:
        sockets: at which stand-ins and dashboard listen, by the name of the process.
    """

    def __init__(
        self,
        options: RunOptions,
        mission_type: MissionType,
        run_dir: Path,
        endpoints: Endpoints,
        sockets: Mapping[str, socket.socket],
        page: PageSocket | None,
        started_s: float,
    ) -> None:
        self._options, self._mission_type, self._run_dir, self._endpoints = options, mission_type, run_dir, endpoints
        self._sockets, self._page, self._started_s = sockets, page, started_s
        self._view: RunView | None = None
        self._children = ProcessManager(mission_type.processes, self._command_of, self._notify_operator)
        self._is_interrupted = False
        self._service = Service(*take_from(os.environ))
        self._log = open_log(run_dir / "log.jsonl", "supervisor")

    def run(self) -> int:
        """Start, watch, collect, stop; returns the exit status."""
        self._log.info("run_started", **self._mission_type.facts)
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        # A flag and no exception: a signal must not be lost in somebody's handler of exceptions, nor end the ending.
        previous = {n: signal.signal(n, self._interrupt) for n in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
        access = RunAccess(context, self._endpoints, self._run_dir, self._options.sim, self._on_heartbeat)
        collector = self._mission_type.make_collector(access)
        self._view = view = self._mission_type.make_view(self._run_dir)
        try:
            with collector, view:
                status = self._watch(collector, view)
                self._service.stopping()
                collector.finish()
                self._children.stop_all()
                collector.collect(1, None)
                wall_s = time.monotonic() - self._started_s
                summary = collector.summary(wall_s)
        finally:
            for number, handler in previous.items():
                signal.signal(number, handler)
            self._children.kill_all()
            context.destroy(linger=0)
        for remark in collector.remarks:
            self._notify_operator("warning", remark)
        self._write(summary)
        self._log.info("run_finished", status=int(status))
        if self._options.shows_summary:
            view.show_summary(summary, as_json=self._options.json_output)
            view.show_report(write_run_report(self._run_dir, status, self._log))
        return int(status)

    def _write(self, summary: dict[str, Any]) -> None:
        """Complete or not at all: that of an earlier session is better than half of a new one."""
        path = self._run_dir / "summary.json"
        new = path.with_name(path.name + ".new")
        try:
            new.write_text(json.dumps(summary, indent=1) + "\n", encoding="utf-8")
            new.replace(path)
        except OSError as error:
            with suppress(OSError):
                new.unlink()
            reason = error.strerror or str(error)
            self._notify_operator(
                "error", f"{path}: cannot be written: {reason}; what was measured is in mission.sqlite"
            )

    def _interrupt(self, _number: int, _frame: FrameType | None) -> None:
        self._is_interrupted = True

    def _watch(self, collector: Collector, view: RunView) -> ExitStatus:
        if self._page is not None and self._page.text:
            self._notify_operator(self._page.level, self._page.text)
        for process in self._mission_type.rows:
            # Who listens has a socket, if it is to run at all.
            if process.name in self._sockets or not process.listens:
                self._children.start(process)
        if not self._options.is_paced:
            os.nice(LOCKSTEP_NICENESS)
        while not self._is_interrupted:
            collector.wait(POLL_MS, self._children.fds)
            collector.collect(0, view)
            now_s = time.monotonic()
            self._service.update(now_s, collector.status, is_recovering=self._children.is_recovering(now_s))
            # A death comes first: what the others say of it is its consequence.
            if (end := self._children.poll(now_s)) is not None:
                return self._died(*end)
            if collector.is_over:
                return collector.exit_status
        view.show_message("warning", "interrupted: holding the wheels and saving")
        return ExitStatus.INTERRUPTED

    def _on_heartbeat(self, heartbeat: Heartbeat) -> None:
        self._children.on_heartbeat(heartbeat)
        self._service.on_heartbeat(heartbeat)

    def _notify_operator(self, level: str, text: str) -> None:
        self._log.log(LEVELS[level], OPERATOR_MESSAGE, text=text)
        if self._view is not None:
            self._view.show_message(level, text)

    def _command_of(self, process: ProcessSpec, is_restarted: bool) -> tuple[list[str], tuple[int, ...]]:
        options = self._options
        arguments = ["--run-dir", str(self._run_dir), "--runtime-dir", str(self._endpoints.runtime_dir)]
        flags = {
            "--realtime": options.is_paced,
            "--resume": options.resume,
            "--restarted": is_restarted,
            "--held": options.held and not is_restarted,
            "--sim": options.sim,
            "--faults": process.is_simulator and options.faults_file is not None,
        }
        arguments += [flag for flag, is_given in flags.items() if is_given]
        if process.name not in self._sockets:
            return arguments, ()
        fd = self._sockets[process.name].fileno()
        return [*arguments, "--listen-fd", str(fd)], (fd,)

    def _died(self, name: str, code: int, decision: RestartDecision) -> ExitStatus:
        self._log.error("process_died", name=name, code=code)
        if decision.end is ProcessEnd.END:
            return ExitStatus(code)  # it has said why
        self._notify_operator("error", f"{decision.text}; see {self._run_dir / 'log.jsonl'}")
        return ExitStatus.HELD


# First, so that it is there for the end of the others. It gets what time they leave, so it has a minute to speak.
_DASHBOARD = ProcessSpec(
    "dashboard",
    "ccatp.daemon.dashboard",
    listens="dashboard",
    is_loop=True,
    is_needed=False,
    niceness=15,
    hang_timeout_s=60.0,
)


# In the order of starting; stopping is in the reverse order, so that main holds the wheels first.
PROCESSES: tuple[ProcessSpec, ...] = (
    _DASHBOARD,
    ProcessSpec("dataloop", "ccatp.daemon.sim_robot", is_simulator=True, listens="sim.robot", is_replaceable=False),
    ProcessSpec("etalon", "ccatp.daemon.sim_etalon", is_simulator=True, listens="sim.etalon"),
    ProcessSpec("danger", "ccatp.daemon.danger_loop", is_loop=True),
    ProcessSpec("main", "ccatp.daemon.main_loop", is_loop=True),
)


# No laser system: what is measured is measured by radio. A main loop that dies takes the map with it: held, and over.
BEACON_PROCESSES: tuple[ProcessSpec, ...] = (
    _DASHBOARD,
    ProcessSpec("dataloop", "ccatp.daemon.sim_robot", is_simulator=True, listens="sim.robot", is_replaceable=False),
    ProcessSpec("danger", "ccatp.daemon.danger_loop", is_loop=True),
    ProcessSpec("main", "ccatp.daemon.main_loop", is_loop=True, is_replaceable=False),
)


def run(options: RunOptions) -> int:
    """Run what the configuration is of: a survey, or a mission among beacons; arguments as of ``run_survey``."""
    if options.config_file is not None and is_radio_file(options.config_file):
        return run_beacons(options)
    return run_survey(options)


def run_beacons(options: RunOptions) -> int:
    """Run one mission among beacons to its end; arguments, status and errors as of ``run_survey``."""
    if options.resume or options.recover:
        flag = "--resume" if options.resume else "--resume-last"
        raise ConfigError(
            f"{flag}: a mission among beacons has nothing to go on with, its map is not kept; start a new one"
        )
    if options.faults_file is not None:
        raise ConfigError("--faults: plans are for surveys; sim.incidents of the configuration holds those of beacons")
    cfg = load_radio_config(options.config_file, dict(options.overrides))
    check_observatory(cfg.observatory)
    read_key(cfg.robot.key_file, must_be_private=not options.sim)
    read_token(cfg.dashboard)
    started = time.monotonic()
    with ExitStack() as stack:
        runtime_dir = make_runtime_dir(str(options.runtime_dir or cfg.processes.runtime_dir), os.environ)
        own_runtime_dir(stack, runtime_dir, is_sim=options.sim)
        sockets: dict[str, socket.socket] = {}
        if options.sim:
            at = cfg.sim.robot
            sockets["dataloop"] = listener = stack.enter_context(listen("sim.robot", at.host, at.port))
            host, port = listener.getsockname()
            cfg = cfg.model_copy(update={"robot": cfg.robot.model_copy(update={"host": host, "port": port})})
        page = open_page_socket(cfg.dashboard)
        if page.socket is not None:
            sockets["dashboard"] = stack.enter_context(page.socket)
            cfg = cfg.model_copy(update={"dashboard": page.config})
        run_dir = new_run_dir(options, cfg.system, cfg.run.seed)
        stack.enter_context(owned(run_dir / RUN_LOCK, "--run-dir"))
        (run_dir / "config.toml").write_text(dump_config(cfg), encoding="utf-8")
        (runtime_dir / RUN_DIR_FILE).write_text(f"{run_dir}\n", encoding="utf-8")
        mission_type = beacon_type(cfg, is_sim=options.sim)
        return SupervisedRun(options, mission_type, run_dir, Endpoints(runtime_dir), sockets, page, started).run()


def run_survey(options: RunOptions) -> int:
    """Run one survey to its end.

    Returns:
        The exit status of ``cli.md``.

    Raises:
        CcatpError: the run could not begin.
    """
    if options.recover:
        return _recover(options)
    overrides = dict(options.overrides)
    cfg = load_config(options.config_file, overrides)
    check_observatory(cfg.observatory)
    # The processes read it again; here it is refused before anything has begun.
    read_key(cfg.robot.key_file, must_be_private=not options.sim)
    read_token(cfg.dashboard)
    started = time.monotonic()
    with ExitStack() as stack:
        runtime_dir = make_runtime_dir(str(options.runtime_dir or cfg.run.runtime_dir), os.environ)
        own_runtime_dir(stack, runtime_dir, is_sim=options.sim)
        stand_ins = [p for p in PROCESSES if p.is_simulator and p.listens and options.sim]
        places = simulator_addresses(cfg)
        sockets = {p.name: stack.enter_context(listen(p.listens, *places[p.listens])) for p in stand_ins}
        cfg = with_addresses(cfg, sockets) if options.sim else cfg
        page = open_page_socket(cfg.dashboard)
        if page.socket is not None:
            sockets["dashboard"] = stack.enter_context(page.socket)
            cfg = cfg.model_copy(update={"dashboard": page.config})
        run_dir = survey_run_dir(options, cfg)
        stack.enter_context(owned(run_dir / RUN_LOCK, "--run-dir"))
        if options.resume and (done := finished_summary(run_dir)) is not None:
            return _report_finished(done, run_dir, as_json=options.json_output)
        (run_dir / "config.toml").write_text(dump_config(cfg), encoding="utf-8")
        (runtime_dir / RUN_DIR_FILE).write_text(f"{run_dir}\n", encoding="utf-8")
        if options.faults_file is not None:
            (run_dir / FAULTS_FILE).write_bytes(options.faults_file.read_bytes())
        mission_type = survey_type(cfg, is_sim=options.sim)
        return SupervisedRun(options, mission_type, run_dir, Endpoints(runtime_dir), sockets, page, started).run()


def _recover(options: RunOptions) -> int:
    """Go on, held, with the run that did not finish; else begin a new one that may be recovered."""
    options = replace(options, recover=False)
    found = find_resumable()
    if found is not None:
        options = replace(options, run_dir=found, resume=True, held=True)
    else:
        cfg = load_config(options.config_file, dict(options.overrides))
        run_dir = default_run_dir(cfg.run.mirror, cfg.run.seed, datetime.now(UTC)).absolute()
        # What was latched when the last run ended stays so: the robot waits at its base until it is cleared.
        options = replace(options, run_dir=run_dir, held=take_over_emergencies(run_dir))
        mark_resumable(run_dir)
        found = run_dir
    status = run_survey(options)
    clear_finished(status, found)
    return status


def _report_finished(summary: dict[str, Any], run_dir: Path, *, as_json: bool) -> int:
    """Nothing is left of a mission: what is known of it stays as it is."""
    if as_json:
        print(json.dumps(summary))
    count = summary["points"]["total"]
    print(f"nothing left to do: all {count} points of {run_dir} are measured", file=sys.stderr)
    return ExitStatus.COMPLETE
