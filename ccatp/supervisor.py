"""Glue. THE process table: what runs, in which order it starts and stops; and one run from its start to its summary."""

import json
import os
import signal
import socket
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from types import FrameType
from typing import Any

import zmq

from ccatp.config.loader import dump_config, load_config
from ccatp.config.models import Config
from ccatp.config.radio_loader import dump_radio_config, is_radio_file, load_radio_config
from ccatp.dashboard.token_file import read_token
from ccatp.errors import ConfigError, ExitStatus
from ccatp.processes.children import Children, ProcessSpec
from ccatp.processes.collecting import Collector
from ccatp.processes.common import FAULTS_FILE, RUN_DIR_FILE, Endpoints, open_log
from ccatp.processes.observing import check_observatory
from ccatp.processes.page_socket import PageSocket, open_page_socket
from ccatp.processes.run_kinds import BeaconRun, RunKind, SurveyRun
from ccatp.processes.run_report import write_run_report
from ccatp.processes.run_view import RunView
from ccatp.processes.service import Service
from ccatp.restarts import Decision, Fate
from ccatp.robot_link import read_key
from ccatp.run_options import RunOptions, default_run_dir
from ccatp.runtime_dir import LOCK_FILE, TRUTH_LOCK_FILE, locked, make_runtime_dir, remove_sockets
from ccatp.service_notify import take_from
from ccatp.unfinished import find_unfinished, finished_summary, forget_finished, note_unfinished
from ccatp.wire.topics import Presence

POLL_MS = 20
# In lockstep the three that answer each other keep both cores of a small machine busy: recording takes what they leave.
LOCKSTEP_NICENESS = 10


# In the runtime directory. Those of the truth may be of a simulated robot that runs alone, beside a run without one.
SOCKETS = ("main", "danger", "control", "emergency", "dashboard")
TRUTH_SOCKETS = ("truth", "puck")

# First, so that it is there for the end of the others. It gets what time they leave, so it has a minute to speak.
_DASHBOARD = ProcessSpec(
    "dashboard",
    "ccatp.processes.dashboard",
    listens="dashboard",
    is_loop=True,
    is_needed=False,
    niceness=15,
    patience_s=60.0,
)


# In the order of starting; stopping is in the reverse order, so that main holds the wheels first.
PROCESSES: tuple[ProcessSpec, ...] = (
    _DASHBOARD,
    ProcessSpec("dataloop", "ccatp.processes.dataloop", is_stand_in=True, listens="sim.robot", is_replaceable=False),
    ProcessSpec("etalon", "ccatp.processes.etalon", is_stand_in=True, listens="sim.etalon"),
    ProcessSpec("danger", "ccatp.processes.danger_loop", is_loop=True),
    ProcessSpec("main", "ccatp.processes.main_loop", is_loop=True),
)


# No laser system: what is measured is measured by radio. A main loop that dies takes the map with it: held, and over.
BEACON_PROCESSES: tuple[ProcessSpec, ...] = (
    _DASHBOARD,
    ProcessSpec("dataloop", "ccatp.processes.dataloop", is_stand_in=True, listens="sim.robot", is_replaceable=False),
    ProcessSpec("danger", "ccatp.processes.danger_loop", is_loop=True),
    ProcessSpec("main", "ccatp.processes.main_loop", is_loop=True, is_replaceable=False),
)


def run(options: RunOptions) -> int:
    """Run what the configuration is of: a survey, or a mission among beacons; arguments as of ``run_survey``."""
    if options.config_file is not None and is_radio_file(options.config_file):
        return run_beacons(options)
    return run_survey(options)


def run_beacons(options: RunOptions) -> int:
    """Run one mission among beacons to its end; arguments, status and errors as of ``run_survey``."""
    if options.resume or options.recover:
        flag = "--resume" if options.resume else "--recover"
        raise ConfigError(f"{flag}: a mission among beacons has nothing to go on with, its map is not kept; begin anew")
    if options.faults_file is not None:
        raise ConfigError("--faults: plans are for surveys; sim.incidents of the configuration holds those of beacons")
    cfg = load_radio_config(options.config_file, dict(options.overrides))
    check_observatory(cfg.observatory)
    read_key(cfg.robot.key_file, must_be_private=not options.sim)
    read_token(cfg.dashboard)
    started = time.monotonic()
    with ExitStack() as stack:
        runtime_dir = make_runtime_dir(str(options.runtime_dir or cfg.processes.runtime_dir), os.environ)
        _take(stack, runtime_dir, is_sim=options.sim)
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
        run_dir = _new_run_dir(options, cfg.system, cfg.run.seed)
        stack.enter_context(_lock(run_dir / ".lock", "--run-dir"))
        (run_dir / "config.toml").write_text(dump_radio_config(cfg), encoding="utf-8")
        (runtime_dir / RUN_DIR_FILE).write_text(f"{run_dir}\n", encoding="utf-8")
        kind = BeaconRun(cfg, BEACON_PROCESSES, is_sim=options.sim)
        return _Run(options, kind, run_dir, Endpoints(runtime_dir), sockets, page, started).go()


def run_survey(options: RunOptions) -> int:
    """Run one survey to its end.

    Args:
        options: what the command line asked for.

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
        _take(stack, runtime_dir, is_sim=options.sim)
        stand_ins = [p for p in PROCESSES if p.is_stand_in and p.listens and options.sim]
        places = places_of(cfg)
        sockets = {p.name: stack.enter_context(listen(p.listens, *places[p.listens])) for p in stand_ins}
        cfg = with_addresses(cfg, sockets) if options.sim else cfg
        page = open_page_socket(cfg.dashboard)
        if page.socket is not None:
            sockets["dashboard"] = stack.enter_context(page.socket)
            cfg = cfg.model_copy(update={"dashboard": page.config})
        run_dir = _make_run_dir(options, cfg)
        stack.enter_context(_lock(run_dir / ".lock", "--run-dir"))
        if options.resume and (done := finished_summary(run_dir)) is not None:
            return _tell_finished(done, run_dir, as_json=options.json_output)
        (run_dir / "config.toml").write_text(dump_config(cfg), encoding="utf-8")
        (runtime_dir / RUN_DIR_FILE).write_text(f"{run_dir}\n", encoding="utf-8")
        if options.faults_file is not None:
            (run_dir / FAULTS_FILE).write_bytes(options.faults_file.read_bytes())
        kind = SurveyRun(cfg, PROCESSES, is_sim=options.sim)
        return _Run(options, kind, run_dir, Endpoints(runtime_dir), sockets, page, started).go()


def _recover(options: RunOptions) -> int:
    """Go on, held, with the run that did not finish; else begin a new one that may be recovered."""
    options = replace(options, recover=False)
    found = find_unfinished()
    if found is not None:
        options = replace(options, run_dir=found, resume=True, held=True)
    else:
        cfg = load_config(options.config_file, dict(options.overrides))
        run_dir = default_run_dir(cfg.run.mirror, cfg.run.seed, datetime.now(UTC)).absolute()
        options = replace(options, run_dir=run_dir)
        note_unfinished(run_dir)
    status = run_survey(options)
    forget_finished(status)
    return status


@contextmanager
def _lock(path: Path, option: str) -> Iterator[None]:
    refusal = f"another ccatp runs in {path.parent}; end it with 'ccatp stop', or give this one its own {option}"
    with locked(path, refusal):
        yield


def _take(stack: ExitStack, runtime_dir: Path, *, is_sim: bool) -> None:
    """Have a runtime directory for ourselves until the end, when our sockets go, too."""
    stack.enter_context(_lock(runtime_dir / LOCK_FILE, "--runtime-dir"))
    if is_sim:
        alone = f"a simulated robot runs alone in {runtime_dir}; end it, or give this one its own --runtime-dir"
        stack.enter_context(locked(runtime_dir / TRUTH_LOCK_FILE, alone))
    stack.callback(remove_sockets, runtime_dir, (*SOCKETS, *(TRUTH_SOCKETS if is_sim else ())))


@contextmanager
def listen(section: str, host: str, port: int) -> Iterator[socket.socket]:
    """A listening socket for a process that inherits it.

    Args:
        section: of the configuration that names the address.
        host, port: the address; port 0 takes any that is free.

    Raises:
        ConfigError: the port is taken.
    """
    with socket.socket() as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind((host, port))
        except OSError as error:
            raise ConfigError(
                f"{section}.port: cannot listen on {host}:{port}: {error.strerror}; "
                f"stop who uses it, or choose another with --set {section}.port=0 (0 = any free port)"
            ) from error
        listener.listen(16)
        yield listener


def places_of(cfg: Config) -> dict[str, tuple[str, int]]:
    """Where the stand-ins shall listen, (host, port) by the section of the configuration."""
    robot, etalon = cfg.sim.robot, cfg.sim.etalon
    return {"sim.robot": (robot.host, robot.port), "sim.etalon": (etalon.host, etalon.port)}


def with_addresses(cfg: Config, sockets: dict[str, socket.socket]) -> Config:
    """The configuration with the addresses at which the stand-ins really listen."""

    def at(process: str) -> dict[str, object]:
        host, port = sockets[process].getsockname()
        return {"host": host, "port": port}

    robot, etalon = at("dataloop"), at("etalon")
    sim = {
        "robot": cfg.sim.robot.model_copy(update=robot),
        "etalon": cfg.sim.etalon.model_copy(update=etalon),
    }
    return cfg.model_copy(
        update={
            "robot": cfg.robot.model_copy(update=robot),
            "etalon": cfg.etalon.model_copy(update=etalon),
            "sim": cfg.sim.model_copy(update=sim),
        }
    )


def _new_run_dir(options: RunOptions, name: str, seed: int) -> Path:
    """The folder of a run that begins anew."""
    run_dir = options.run_dir or default_run_dir(name, seed, datetime.now(UTC))
    if (run_dir / "mission.sqlite").exists():
        raise ConfigError(f"--run-dir: {run_dir} holds a mission already; name another folder")
    return _made(run_dir)


def _made(run_dir: Path) -> Path:
    try:
        run_dir.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"--run-dir: cannot make {run_dir}: {error.strerror}") from error
    return run_dir.absolute()


def _make_run_dir(options: RunOptions, cfg: Config) -> Path:
    run_dir = options.run_dir or default_run_dir(cfg.run.mirror, cfg.run.seed, datetime.now(UTC))
    has_mission = (run_dir / "mission.sqlite").exists()
    if has_mission and not options.resume:
        raise ConfigError(
            f"--run-dir: {run_dir} holds a mission already; give --resume to go on with it, or another folder"
        )
    if options.resume and not has_mission:
        raise ConfigError(f"--resume: no mission in {run_dir}; name the folder of the run with --run-dir")
    if options.resume:
        _check_resumed(run_dir, cfg)
    return _made(run_dir)


def _tell_finished(summary: dict[str, Any], run_dir: Path, *, as_json: bool) -> int:
    """Nothing is left of a mission: what is known of it stays as it is."""
    if as_json:
        print(json.dumps(summary))
    count = summary["points"]["total"]
    print(f"nothing left to do: all {count} points of {run_dir} are measured", file=sys.stderr)
    return ExitStatus.COMPLETE


def _check_resumed(run_dir: Path, cfg: Config) -> None:
    """A mission goes on with the points it was planned with."""
    path = run_dir / "config.toml"
    if not path.exists():
        return
    before = load_config(path)
    for name, was, wanted in (
        ("run.mirror", before.mirror.name, cfg.mirror.name),
        ("run.order", before.run.order, cfg.run.order),
        ("run.panels", before.run.panels, cfg.run.panels),
    ):
        if was != wanted:
            raise ConfigError(f"--resume: {name} was {was} in {run_dir} and is {wanted} now; resume with what it was")


class _Run:
    """The children of one run and what is collected from them."""

    def __init__(
        self,
        options: RunOptions,
        kind: RunKind,
        run_dir: Path,
        endpoints: Endpoints,
        sockets: dict[str, socket.socket],
        page: PageSocket | None,
        started_s: float,
    ) -> None:
        self._options, self._kind, self._run_dir, self._endpoints = options, kind, run_dir, endpoints
        self._sockets, self._page, self._started_s = sockets, page, started_s
        self._view: RunView | None = None
        self._children = Children(kind.processes, self._command_of, self._say)
        self._is_interrupted = False
        self._service = Service(*take_from(os.environ))
        self._log = open_log(run_dir / "log.jsonl", "supervisor")

    def go(self) -> int:
        """Start, watch, collect, stop; returns the exit status."""
        self._log.info("run", **self._kind.facts)
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        # A flag and no exception: a signal must not be lost in somebody's handler of exceptions, nor end the ending.
        previous = {n: signal.signal(n, self._interrupt) for n in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
        collector = self._kind.collector(context, self._endpoints, self._run_dir, self._heard)
        self._view = view = self._kind.view(self._run_dir)
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
        (self._run_dir / "summary.json").write_text(json.dumps(summary, indent=1) + "\n", encoding="utf-8")
        self._log.info("end", status=int(status))
        if self._options.shows_summary:
            view.show_summary(summary, as_json=self._options.json_output)
            view.show_report(write_run_report(self._run_dir, status, self._log))
        return int(status)

    def _interrupt(self, _number: int, _frame: FrameType | None) -> None:
        self._is_interrupted = True

    def _watch(self, collector: Collector, view: RunView) -> ExitStatus:
        if self._page is not None and self._page.text:
            self._say(self._page.level, self._page.text)
        for process in self._kind.rows:
            # Who listens has a socket, if it is to run at all.
            if process.name in self._sockets or not process.listens:
                self._children.start(process)
        if not self._options.is_paced:
            os.nice(LOCKSTEP_NICENESS)
        while not self._is_interrupted:
            collector.wait(POLL_MS, self._children.fds)
            collector.collect(0, view)
            now_s = time.monotonic()
            self._service.beat(now_s, collector.status, is_recovering=self._children.is_recovering(now_s))
            # A death comes first: what the others say of it is its consequence.
            if (end := self._children.look(now_s)) is not None:
                return self._died(*end)
            if collector.is_over:
                return collector.exit_status
        view.say("warning", "interrupted: holding the wheels and saving")
        return ExitStatus.INTERRUPTED

    def _heard(self, presence: Presence) -> None:
        self._children.heard(presence)
        self._service.heard(presence)

    def _say(self, level: str, text: str) -> None:
        self._log.log({"info": 20, "warning": 30, "error": 40}[level], text)
        if self._view is not None:
            self._view.say(level, text)

    def _command_of(self, process: ProcessSpec, is_restarted: bool) -> tuple[list[str], tuple[int, ...]]:
        options = self._options
        arguments = ["--run-dir", str(self._run_dir), "--runtime-dir", str(self._endpoints.runtime_dir)]
        flags = {
            "--realtime": options.is_paced,
            "--resume": options.resume,
            "--restarted": is_restarted,
            "--held": options.held and not is_restarted,
            "--sim": options.sim,
            "--faults": process.is_stand_in and options.faults_file is not None,
        }
        arguments += [flag for flag, is_given in flags.items() if is_given]
        if process.name not in self._sockets:
            return arguments, ()
        fd = self._sockets[process.name].fileno()
        return [*arguments, "--listen-fd", str(fd)], (fd,)

    def _died(self, name: str, code: int, decision: Decision) -> ExitStatus:
        self._log.error("process died", name=name, code=code)
        if decision.fate is Fate.END:
            return ExitStatus(code)  # it has said why
        self._say("error", f"{decision.text}; see {self._run_dir / 'log.jsonl'}")
        return ExitStatus.HELD
