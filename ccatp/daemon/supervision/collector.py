"""Receives a run's messages from start to end: recording, progress, mission status, summary."""

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Self

import msgspec
import zmq

import ccatp
from ccatp.config.load import dump_config
from ccatp.daemon.operator.terminal import RunView
from ccatp.daemon.supervision.process import RunContext
from ccatp.daemon.supervision.run_text import RunText
from ccatp.errors import ExitStatus
from ccatp.links.bus import Subscriber
from ccatp.links.topics import Heartbeat, Message, MissionStatus, Timing, TruthBatch, topics_of
from ccatp.missions import kind_of
from ccatp.records.recorder import (
    RECORD_FORMAT,
    TELEMETRY,
    Recorder,
    RobotClock,
)
from ccatp.records.run_record import RunRecord
from ccatp.report.foxglove import recorded_schemas

_UNRECORDED = (Timing, Heartbeat)  # received, too
FINISH_TIMEOUT_S = 5.0
REQUEST_TIMEOUT_S = 1.0


class Collector:
    """Receives a run's messages: records and shows them, and collects the summary.

    ``status``: progress of the mission, ``None`` before main has published it.
    """

    def __init__(
        self,
        context: zmq.Context[zmq.Socket[bytes]],
        run: RunContext,
        on_heartbeat: Callable[[Heartbeat], None],
    ) -> None:
        """Subscribe before the first message is published."""
        self._context = context
        self._run = run
        self._on_heartbeat = on_heartbeat
        cfg, run_dir, is_sim, endpoints = run.config, run.run_dir, run.is_sim, run.endpoints
        names = ("main", "danger", "dashboard", *(("truth",) if is_sim else ()))
        received = [topic.name for topic in topics_of(kind_of(cfg)) if topic.recorded or topic.message in _UNRECORDED]
        self._subscriber = Subscriber(context, [endpoints.of(name) for name in names], received)
        clock = RobotClock(is_simulation=is_sim)
        kind = kind_of(cfg)
        make: Callable[[Any, Path, RobotClock, bool], RunRecord] = kind.record.get()
        self._record = make(cfg, run_dir, clock, is_sim)
        self._has_views = True
        self._view: RunView | None = None
        text: RunText = kind.text.get()(cfg)
        what = {kind.subject: text.subject, "seed": str(cfg.run.seed), **text.details}
        software = {"format": str(RECORD_FORMAT), "ccatp": ccatp.__version__}
        config = dump_config(cfg)  # a later session in the same directory may have another
        self._recorder = Recorder(
            run_dir / TELEMETRY,
            recorded_schemas(kind),
            is_simulation=is_sim,
            metadata={**software, **what, "config": config},
            on_failure=self._on_recorder_failure,
            clock=clock,
        )
        self._truth_rows = 0
        self.status: MissionStatus | None = None

    @property
    def remarks(self) -> Sequence[str]:
        """Warnings for the operator at the end."""
        return self._record.remarks

    def prepare(self) -> None:
        """Import what only the summary needs."""
        self._record.prepare()

    def finish(self) -> None:
        """Request the last rows of the simulated truth, and wait for the messages that are still on their way."""
        if self._run.is_sim:
            rows = int(self._request(b"flush").get("rows", 0))
            self._record.ask_truth(self._request)
            for _ in range(int(FINISH_TIMEOUT_S * 100)):
                if self._truth_rows >= rows:
                    break
                self.collect(10)
        self.collect(1)

    def summary(self, wall_s: float) -> dict[str, Any]:
        """Content of ``summary.json``; call it after main has closed the mission's database."""
        return self._record.build(wall_s)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._recorder.close()
        self._subscriber.close()

    @property
    def is_over(self) -> bool:
        """Main has published the end of the mission."""
        return self.status is not None and self.status.exit_status >= 0

    @property
    def exit_status(self) -> ExitStatus:
        """Exit status of the run from main."""
        return ExitStatus(self.status.exit_status) if self.status is not None else ExitStatus.HELD

    def collect(self, timeout_ms: int, view: RunView | None = None, limit: int = sys.maxsize) -> None:
        """Take the messages that have arrived, at most ``limit``, waiting at most ``timeout_ms`` for the first."""
        self._view = view
        received = self._subscriber.receive(timeout_ms / 1000.0)
        while received is not None:
            name, body, message = received
            if isinstance(message, Heartbeat):
                self._on_heartbeat(message)
            elif isinstance(message, Message):
                self._take(name, body, message)
            limit -= 1
            received = self._subscriber.receive() if limit else None
        self._recorder.flush_if_due()

    def _take(self, name: str, body: bytes, message: Message) -> None:
        if name != "timing":
            self._recorder.write(name, max(message.t_s, 0.0), body)
            self._record_views(message)
        if isinstance(message, TruthBatch):
            self._truth_rows += len(message.rows)
        if self._view is not None:
            self._view.show(message)
        if isinstance(message, MissionStatus):
            self.status = message
        self._record.take(message)

    def _record_views(self, message: Message) -> None:
        """A failure in the views must not end the run."""
        if not self._has_views:
            return
        try:
            for shown in self._record.views_of(message):
                self._recorder.write(*shown)
        except Exception as error:  # the raw topics have all the data
            self._has_views = False
            self._on_recorder_failure(f"views for Foxglove and PlotJuggler: {type(error).__name__}: {error}")

    def _on_recorder_failure(self, reason: str) -> None:
        if self._view is not None:
            self._view.show_message("error", f"{reason}; the survey continues")

    def _request(self, request: bytes) -> dict[str, Any]:
        """Reply of the simulated truth; empty if it has ended, when all its messages have arrived."""
        with self._context.socket(zmq.REQ) as peer:
            peer.setsockopt(zmq.LINGER, 0)
            peer.connect(self._run.endpoints.of("puck"))
            peer.send(request)
            if not peer.poll(int(REQUEST_TIMEOUT_S * 1000)):
                return {}
            reply: dict[str, Any] = msgspec.json.decode(peer.recv())
            return reply
