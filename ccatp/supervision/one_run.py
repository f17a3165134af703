"""Glue. One run from the start of its children to its summary."""

import json
import os
import signal
import socket
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from types import FrameType
from typing import Any

import zmq

from ccatp.errors import ExitStatus
from ccatp.processes.common import Endpoints, open_log
from ccatp.processes.page_socket import PageSocket
from ccatp.run_options import RunOptions
from ccatp.supervision.children import Children, ProcessSpec
from ccatp.supervision.collecting import Collector, RunAccess
from ccatp.supervision.restarts import Decision, Fate
from ccatp.supervision.run_kinds import RunKind
from ccatp.supervision.run_report import write_run_report
from ccatp.supervision.run_view import RunView
from ccatp.supervision.service import Service
from ccatp.supervision.service_notify import take_from
from ccatp.wire.topics import Presence

POLL_MS = 20
# In lockstep the three that answer each other keep both cores of a small machine busy: recording takes what they leave.
LOCKSTEP_NICENESS = 10


class Run:
    """The children of one run and what is collected from them.

    Args:
        options: what the command line asked for.
        kind: which mission it is of.
        run_dir: its folder, which holds its configuration.
        endpoints: where the processes publish.
        sockets: at which stand-ins and dashboard listen, by the name of the process.
        page: where the dashboard listens.
        started_s: when it began, monotonic clock.
    """

    def __init__(
        self,
        options: RunOptions,
        kind: RunKind,
        run_dir: Path,
        endpoints: Endpoints,
        sockets: Mapping[str, socket.socket],
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
        access = RunAccess(context, self._endpoints, self._run_dir, self._options.sim, self._heard)
        collector = self._kind.collector(access)
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
        for remark in collector.remarks:
            self._say("warning", remark)
        self._write(summary)
        self._log.info("end", status=int(status))
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
            self._say("error", f"{path}: cannot be written: {reason}; what was measured is in mission.sqlite")

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
