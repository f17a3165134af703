"""THE process table of a survey, and a run of the processes of any mission: start, supervision, summary."""

import json
import os
import signal
import socket
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from functools import cached_property, partial
from types import FrameType
from typing import TYPE_CHECKING, Any

import msgspec
import zmq

from ccatp.config.files import read_toml, write_durably
from ccatp.config.load import dump_config, load_config, load_mission
from ccatp.config.mission import CommonConfig
from ccatp.daemon.operator.alarms import AlarmList
from ccatp.daemon.operator.report_process import ReportProcess, by_hand
from ccatp.daemon.operator.webhook import AlarmWebhook
from ccatp.daemon.supervision.child_processes import (
    PageSocket,
    ProcessEnd,
    ProcessManager,
    ProcessSpec,
    listen,
    open_page_socket,
    process_table,
    simulated_servers,
    token_query,
    with_addresses,
)
from ccatp.daemon.supervision.fork_server import ChildProcess, ForkServer, start_module
from ccatp.daemon.supervision.named_files import check_named_files
from ccatp.daemon.supervision.open_files import permit_open_files
from ccatp.daemon.supervision.process import (
    ADDRESSES_FILE,
    FAULTS_FILE,
    RUN_DIR_FILE,
    STOP_SIGNALS,
    Endpoints,
    RunContext,
    open_log,
)
from ccatp.daemon.supervision.run_dir import (
    RunOptions,
    await_predecessors,
    check_takes_faults,
    finished_summary,
    keep_origin,
    make_run_dir,
    owned,
    recover,
    take_runtime_dir,
    with_origin,
)
from ccatp.daemon.supervision.run_text import RunText
from ccatp.errors import ConfigError, ExitStatus
from ccatp.links.liveness import STALE_AFTER_S, Liveness
from ccatp.links.runtime_dir import RUN_LOCK
from ccatp.links.service_manager import Notifier, is_journal, take_from
from ccatp.links.topics import LEVELS, OPERATOR_MESSAGE, Heartbeat, MissionStatus
from ccatp.missions import kind_of
from ccatp.report.dashboard.access import TOKEN_FILE, make_token

if TYPE_CHECKING:
    from ccatp.daemon.operator.terminal import RunView
    from ccatp.daemon.supervision.collector import Collector

# Period of the polls of messages and processes; waking up for each message would double the cost in lockstep.
POLL_S = 0.02
STDERR = 2  # file descriptor
# Time for alarm posts in progress at the end.
WEBHOOK_PATIENCE_S = 0.5
# Largest number of messages per poll, so that signals and dead processes are noticed in between.
MAX_MESSAGES = 1000
STATUS_PERIOD_S = 1.0  # least time between two status messages to the service manager
# Watchdog messages per watchdog period, and the part of it after which a silent loop stops them.
KEEPALIVES, STALE_SHARE = 4.0, 0.5

# In the order of starting. They stop in the reverse order, so that main holds the wheels first.
PROCESSES: tuple[ProcessSpec, ...] = (
    # First, so that it shows the end of the others. It has the lowest priority, so it may be silent for a minute.
    ProcessSpec(
        "dashboard",
        "ccatp.daemon.operator.dashboard",
        listens="dashboard",
        is_loop=True,
        is_needed=False,
        niceness=15,
        hang_timeout_s=60.0,
    ),
    ProcessSpec(
        "dataloop", "ccatp.daemon.loops.sim_robot", is_simulator=True, listens="sim.robot", is_replaceable=False
    ),
    ProcessSpec("etalon", "ccatp.daemon.loops.sim_etalon", is_simulator=True, listens="sim.etalon"),
    ProcessSpec("danger", "ccatp.daemon.loops.danger_loop", is_loop=True),
    ProcessSpec("main", "ccatp.daemon.loops.main_loop", is_loop=True),
)
# Of a mission without a laser system.
WITHOUT_LASER = tuple(spec for spec in PROCESSES if spec.name != "etalon")


class Service:
    """Reports the state of the run to the service manager; ``watchdog_s`` is None without a watchdog."""

    def __init__(self, notifier: Notifier, watchdog_s: float | None) -> None:
        self._notifier, self._watchdog_s = notifier, watchdog_s
        self._liveness = Liveness(min(STALE_AFTER_S, STALE_SHARE * (watchdog_s or STALE_AFTER_S / STALE_SHARE)))
        self._is_ready = self._is_troubled = False
        self._kept_alive_s = self._sent_s = float("-inf")
        self._text = ""

    def on_heartbeat(self, heartbeat: Heartbeat) -> None:
        """Take a heartbeat."""
        self._liveness.update(heartbeat)

    def update(self, now_s: float, status: MissionStatus | None, *, is_recovering: bool = False) -> None:
        """Send due messages; while ``is_recovering`` from a restart, the watchdog is always served."""
        if not self._notifier.has_listener:
            return
        if not self._is_ready:
            if self._liveness.has_joined:
                self._is_ready = True
                self._notifier.send("READY=1")
            return
        trouble = self._liveness.trouble(now_s)
        is_alive = is_recovering or not trouble
        if self._watchdog_s is not None and is_alive and now_s - self._kept_alive_s >= self._watchdog_s / KEEPALIVES:
            self._kept_alive_s = now_s
            self._notifier.send("WATCHDOG=1")
        has_changed, self._is_troubled = bool(trouble) != self._is_troubled, bool(trouble)
        text = f"trouble: {trouble}" if trouble else _status_text(status)
        if text != self._text and (has_changed or now_s - self._sent_s >= STATUS_PERIOD_S):
            self._text, self._sent_s = text, now_s
            self._notifier.send(f"STATUS={text}")

    def stopping(self) -> None:
        """Report that the run ends."""
        self._notifier.send("STOPPING=1", "STATUS=holding the wheels and saving")


def _status_text(status: MissionStatus | None) -> str:
    if status is None:
        return "joined the robot"
    cause = f" ({status.cause})" if status.cause else ""
    return f"{status.state}{cause}, {status.done} of {status.total} points"


class SupervisedRun:
    """The children of one run and the messages collected from them.

    ``sockets``: listening sockets of simulators and dashboard, by process name. ``started_s``: start of the run by the
    monotonic clock. ``fork_server``: starts the children while it lives.
    """

    def __init__(
        self,
        options: RunOptions,
        run: RunContext,
        sockets: Mapping[str, socket.socket],
        page: PageSocket,
        fork_server: ForkServer,
        started_s: float,
    ) -> None:
        self._options = options
        self._context = run
        self._cfg = cfg = run.config
        self._run_dir = run_dir = run.run_dir
        self._sockets = sockets
        self._page = page
        self._started_s = started_s
        self._fork_server = fork_server
        self._children = ProcessManager(cfg.processes, self._command_of, self._notify_operator, self._start)
        self._is_interrupted = False
        self._failure = ""  # the death of a process that ended the run
        self._has_begun = False
        self._service = Service(*take_from(os.environ))
        self._report = ReportProcess(self._start, run_dir, run.locks)
        self._log = open_log(run_dir / "log.jsonl", "supervisor")
        self._webhook = AlarmWebhook(cfg.alarms, run_dir.name, self._log, AlarmList(run_dir, self._log).alarms)

    @cached_property
    def _view(self) -> "RunView":
        """The terminal; not before the processes are started."""
        from ccatp.daemon.operator.terminal import RunView  # noqa: PLC0415 - while they import what they need

        return RunView(self._context, self._options.verbosity)

    def run(self) -> int:
        """Start, watch, collect, stop, report; returns the exit status."""
        with self._report:
            return self._run()

    def _run(self) -> int:
        cfg, is_sim = self._cfg, self._context.is_sim
        kind = kind_of(cfg)
        text: RunText = kind.text.get()(cfg)
        self._log.info("run_started", **{kind.subject: text.subject}, seed=cfg.run.seed, sim=is_sim)
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        # A flag instead of an exception, so that no exception handler loses a signal, and no signal ends the shutdown.
        previous = {n: signal.signal(n, self._interrupt) for n in STOP_SIGNALS}
        try:
            self._start_processes()
            # While the processes import what they need. No message is lost: main joins when this is subscribed.
            from ccatp.daemon.supervision.collector import Collector  # noqa: PLC0415
            from ccatp.survey.ending import ending_of  # noqa: PLC0415

            view = self._view
            for line in () if kind.without_effect is None else kind.without_effect.get()(cfg, is_sim):
                self._notify_operator("warning", line)
            collector = Collector(context, self._context, self._on_heartbeat)
            with collector, view:
                status = self._watch(collector)
                self._webhook.update(collector.status)
                self._service.stopping()
                collector.finish()
                self._children.stop_all()
                collector.collect(1)
                summary = collector.summary(time.monotonic() - self._started_s)
        finally:
            for number, handler in previous.items():
                signal.signal(number, handler)
            self._children.kill_all()
            context.destroy(linger=0)
        self._webhook.close(WEBHOOK_PATIENCE_S)
        for remark in collector.remarks:
            self._notify_operator("warning", remark)
        ending = ending_of(collector.status, status, failure=self._failure)
        summary = {"ended": msgspec.to_builtins(ending), **summary}  # one of an earlier session keeps its own end
        self._write(summary)
        self._log.info("run_finished", status=int(status))
        if self._options.shows_summary:
            view.show_summary(summary, as_json=self._options.json_output)
            # An interrupted run gets no report, because the operator waits for the end.
            is_drawn = status is not ExitStatus.INTERRUPTED
            view.show_report(self._report.write(self._log) if is_drawn else by_hand(self._run_dir))
        return int(status)

    def _write(self, summary: dict[str, Any]) -> None:
        """Write the summary completely or not at all, so that a failure keeps that of an earlier session."""
        path = self._run_dir / "summary.json"
        try:
            write_durably(path, (json.dumps(summary, indent=1) + "\n").encode())
        except OSError as error:
            text = f"{path}: cannot be written: {error.strerror or error}"
            if (self._run_dir / "mission.sqlite").exists():
                text += "; what was measured is in mission.sqlite"
            self._notify_operator("error", text)

    def _interrupt(self, _number: int, _frame: FrameType | None) -> None:
        self._is_interrupted = True

    def _start_processes(self) -> None:
        for process in process_table(self._cfg):
            # A process that listens runs only if it has a socket.
            if process.name in self._sockets or not process.listens:
                self._children.start(process)
        if not self._options.is_paced and sys.platform == "linux":
            # Robot, main and danger keep both cores of a small machine busy, and recording must not interrupt them. Not
            # by niceness, because an ordinary user cannot reduce it again, and messages would pile up under load.
            os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))

    def _show_page(self) -> None:
        """Tell the operator where the page is, or why there is none."""
        if self._page.text:
            self._log.log(LEVELS[self._page.level], OPERATOR_MESSAGE, text=self._page.text)
            has_token = self._page.socket is not None and not is_journal(STDERR, os.environ)
            token = token_query(self._cfg.dashboard, self._context.endpoints.runtime_dir) if has_token else ""
            self._view.show_message(self._page.level, self._page.text + token)

    def _watch(self, collector: "Collector") -> ExitStatus:
        self._show_page()
        while not self._is_interrupted:
            time.sleep(POLL_S)
            collector.collect(0, self._view, MAX_MESSAGES)
            self._webhook.update(collector.status)
            # From main's first frame on, the checkpoint is of this session. A main loop restarted before begins again.
            if not self._has_begun and collector.status is not None and collector.status.seq >= 0:
                self._has_begun = True
                if not self._options.is_paced:  # in lockstep no frame can be late
                    self._prepare_end(collector)
            now_s = time.monotonic()
            self._service.update(now_s, collector.status, is_recovering=self._children.is_recovering(now_s))
            # A dead process is handled first, because the messages of the others are its consequence.
            if (death := self._children.poll(now_s)) is not None:
                self._log.error("process_died", name=death.name, code=death.code)
                self._failure = death.text
                if death.end is ProcessEnd.END:
                    # The process has reported why. After a restart the robot may be anywhere, so the status is held.
                    return ExitStatus.HELD if self._children.restarts else ExitStatus(death.code)
                self._notify_operator("error", f"{death.text}; see {self._run_dir / 'log.jsonl'}")
                return ExitStatus.HELD
            if collector.is_over:
                return collector.exit_status
        self._view.show_message("warning", "interrupted: holding the wheels and saving")
        return ExitStatus.INTERRUPTED

    def _prepare_end(self, collector: "Collector") -> None:
        """Let imports that only the end needs take place while the robot drives."""
        if self._options.shows_summary and kind_of(self._cfg).report is not None:
            with suppress(OSError):  # the end of the run tries again
                self._report.begin()
        collector.prepare()

    def _on_heartbeat(self, heartbeat: Heartbeat) -> None:
        self._children.on_heartbeat(heartbeat)
        self._service.on_heartbeat(heartbeat)

    def _notify_operator(self, level: str, text: str) -> None:
        self._log.log(LEVELS[level], OPERATOR_MESSAGE, text=text)
        self._view.show_message(level, text)

    def _start(self, module: str, arguments: Sequence[str], fds: Sequence[int]) -> ChildProcess:
        """Fork a process, or start it without the server if that has died."""
        child = self._fork_server.start(module, arguments, fds)
        if child is None:
            self._log.warning("fork_server_lost", module=module)
        return child or start_module(module, arguments, fds)

    def _command_of(self, process: ProcessSpec, is_restarted: bool) -> tuple[list[str], tuple[int, ...]]:
        options = self._options
        arguments = ["--run-dir", str(self._run_dir), "--runtime-dir", str(self._context.endpoints.runtime_dir)]
        flags = {
            "--realtime": options.is_paced,
            "--resume": options.resume,
            "--restarted": is_restarted and (self._has_begun or not options.resume),
            "--held": options.held and not self._has_begun,
            "--sim": self._context.is_sim,
            "--faults": process.is_simulator and options.faults_file is not None,
        }
        arguments += [flag for flag, is_given in flags.items() if is_given]
        if process.name not in self._sockets:
            return arguments, self._context.locks
        fd = self._sockets[process.name].fileno()
        return [*arguments, "--listen-fd", str(fd)], (fd, *self._context.locks)


def run(options: RunOptions, fork_server: ForkServer | None = None) -> int:
    """Run the configured mission to its end; returns the exit status (``docs/operator.md``).

    ``fork_server``: one that was started before. CcatpError: the run could not begin.
    """
    cfg = load_mission(options.config_file, dict(options.overrides), any_ports=options.sim)
    kind = kind_of(cfg)
    if kind.no_resume is not None and (options.resume or options.recover):
        flag = "--resume" if options.resume else "--resume-last"
        raise ConfigError(f"{flag}: a {kind.title} cannot be resumed, because {kind.no_resume}; start a new one")
    begin = partial(_run, fork_server=fork_server)
    return recover(options, cfg, begin) if options.recover else begin(options, cfg)


def run_survey(options: RunOptions) -> int:
    """Run one survey to its end; status and errors as ``run``."""
    return _run(options, load_config(options.config_file, dict(options.overrides), any_ports=options.sim))


def _run(options: RunOptions, cfg: CommonConfig, fork_server: ForkServer | None = None) -> int:
    options = with_origin(options)
    permit_open_files()
    kind = kind_of(cfg)
    check_takes_faults(kind, options.faults_file)
    if kind.check is not None:
        check: Callable[[RunOptions, Any], None] = kind.check.get()
        check(options, cfg)
    # The processes read these files again; checked here, an error is reported before anything has begun.
    check_named_files(cfg, is_sim=options.sim)
    started_s = time.monotonic()
    with ExitStack() as stack:
        configured = str(options.runtime_dir or cfg.processes.runtime_dir)
        runtime_dir = take_runtime_dir(stack, configured, is_sim=options.sim)
        make_token(runtime_dir)
        stack.callback((runtime_dir / TOKEN_FILE).unlink, missing_ok=True)
        sockets: dict[str, socket.socket] = {}
        if options.sim:
            for server in simulated_servers(cfg):
                listener = listen(server.section, server.at.host, server.at.port)
                sockets[server.process] = stack.enter_context(listener)
            cfg = with_addresses(cfg, sockets)
        has_page = kind.page is not None
        page = open_page_socket(cfg.dashboard if has_page else cfg.dashboard.model_copy(update={"enabled": False}))
        if page.socket is not None:
            sockets["dashboard"] = stack.enter_context(page.socket)
            cfg = cfg.model_copy(update={"dashboard": page.config})
        run_dir = make_run_dir(options, cfg)
        stack.enter_context(owned(run_dir / RUN_LOCK, "--run-dir"))
        locks = await_predecessors(stack, runtime_dir, run_dir)
        if options.resume and (done := finished_summary(run_dir)) is not None:
            # The mission is complete: its record stays as it is.
            if options.json_output:
                print(json.dumps(done))
            count = done["points"]["total"]
            print(f"nothing left to do: all {count} points of {run_dir} are measured", file=sys.stderr)
            return ExitStatus.COMPLETE
        keep_origin(run_dir, is_sim=options.sim, is_realtime=options.realtime, is_new=not options.resume)
        write_durably(run_dir / "config.toml", dump_config(cfg).encode())
        (runtime_dir / RUN_DIR_FILE).write_bytes(os.fsencode(run_dir) + b"\n")
        (runtime_dir / ADDRESSES_FILE).write_text(json.dumps(_addresses(cfg)) + "\n", encoding="utf-8")
        if options.faults_file is not None:
            (run_dir / FAULTS_FILE).write_text(read_toml(options.faults_file), encoding="utf-8")
        context = RunContext(cfg, run_dir, Endpoints(runtime_dir), is_sim=options.sim, locks=locks)
        forks = fork_server or stack.enter_context(ForkServer())
        return SupervisedRun(options, context, sockets, page, forks, started_s=started_s).run()


def _addresses(cfg: CommonConfig) -> dict[str, dict[str, object]]:
    """Host and port of each peer and of the page."""
    sections = {"robot": cfg.robot, "etalon": getattr(cfg, "etalon", None)}
    sections["dashboard"] = cfg.dashboard if cfg.dashboard.enabled else None
    return {name: {"host": at.host, "port": at.port} for name, at in sections.items() if at is not None}
