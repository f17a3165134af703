"""Receives a run's messages from start to end: recording, progress, mission status, summary."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Protocol, Self

import msgspec
import zmq

import ccatp
from ccatp.config.beacon_models import RadioConfig
from ccatp.config.load import dump_config
from ccatp.core import danger_text
from ccatp.daemon.process import Endpoints
from ccatp.errors import ExitStatus
from ccatp.links.bus import Subscriber
from ccatp.links.topics import (
    RECORD_FORMAT,
    TOPICS,
    BeaconArrival,
    BeaconMapMessage,
    BeaconPlaces,
    BeaconTrack,
    BeaconTruth,
    DangerEvent,
    Heartbeat,
    LogMessage,
    Message,
    MissionStatus,
    Timing,
    TrackMessage,
    TruthMessage,
)
from ccatp.records.beacon_summary import BeaconSummary, Reached, beacon_facts
from ccatp.records.recorder import Recorder
from ccatp.report.foxglove import recorded_schemas

RECEIVED = tuple(topic.name for topic in TOPICS if topic.recorded or topic.message in (Timing, Heartbeat))
FINISH_TIMEOUT_S = 5.0
ASK_TIMEOUT_S = 1.0


class DerivedView(Protocol):
    """Where progress is shown."""

    def show_message(self, level: str, text: str) -> None:
        """One line for the operator."""

    def pose(self, track: TrackMessage) -> None:
        """A batch of estimates."""

    def status(self, status: MissionStatus) -> None:
        """Where the mission stands."""


class RunAccess(NamedTuple):
    """How a run is reached by who listens to it."""

    context: zmq.Context[zmq.Socket[bytes]]
    endpoints: Endpoints
    run_dir: Path
    is_sim: bool
    on_heartbeat: Callable[[Heartbeat], None]


class Collector(ABC):
    """Listens to a run; what the summary is made of is the business of a class of its own for each kind of mission."""

    def __init__(self, access: RunAccess, metadata: Mapping[str, str]) -> None:
        """Subscribe before anybody publishes."""
        self._context, self._endpoints, self._is_sim = access.context, access.endpoints, access.is_sim
        self._on_heartbeat = access.on_heartbeat
        names = ("main", "danger", "dashboard", *(("truth",) if access.is_sim else ()))
        self._subscriber = Subscriber(access.context, [access.endpoints.of(name) for name in names], RECEIVED)
        self._recorder = Recorder(
            access.run_dir / "telemetry.mcap",
            recorded_schemas(),
            is_simulation=access.is_sim,
            metadata={"format": str(RECORD_FORMAT), "ccatp": ccatp.__version__, **metadata},
            on_failure=self._on_recorder_failure,
        )
        self._view: DerivedView | None = None
        self._status: MissionStatus | None = None
        self._truth_rows = 0
        self._records_views = True
        self.remarks: list[str] = []

    # -- of each kind of mission ----------------------------------------------------------------------------------

    @abstractmethod
    def take(self, message: Message) -> None:
        """A message for the summary."""

    def views_of(self, message: Message) -> Iterable[tuple[str, float, bytes]]:
        """What viewers are shown of a message beside it: topics, their times and texts."""
        del message
        return ()

    def finish(self) -> None:
        """Ask the simulated truth for its last rows, and wait for what is on its way."""
        if self._is_sim:
            self._collect_until_truth(int(self._ask(b"flush").get("rows", 0)))
        self.collect(1, None)

    @abstractmethod
    def summary(self, wall_s: float) -> dict[str, Any]:
        """``summary.json`` of what was collected; call it when main has closed the mission's database."""

    # -- of all of them -------------------------------------------------------------------------------------------

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._recorder.close()
        self._subscriber.close()

    @property
    def status(self) -> MissionStatus | None:
        """Where the mission stands, once main has said so."""
        return self._status

    @property
    def is_over(self) -> bool:
        """Main has said how the mission ended."""
        return self._status is not None and self._status.exit_status >= 0

    @property
    def exit_status(self) -> ExitStatus:
        """What main said the run ends with."""
        return ExitStatus(self._status.exit_status) if self._status is not None else ExitStatus.HELD

    def wait(self, timeout_ms: int, fds: Sequence[int] = ()) -> None:
        """Wait until something came in, or a file descriptor is readable, at most ``timeout_ms``."""
        poller = zmq.Poller()
        for waited_for in (self._subscriber.socket, *fds):
            poller.register(waited_for, zmq.POLLIN)
        poller.poll(timeout_ms)

    def collect(self, timeout_ms: int, view: DerivedView | None) -> None:
        """Take what came in, waiting at most ``timeout_ms`` for the first."""
        self._view = view
        received = self._subscriber.receive_raw(timeout_ms / 1000.0)
        while received is not None:
            name, body, message = received
            if isinstance(message, Message):
                self._take(name, body, message, view)
            received = self._subscriber.receive_raw()
        self._recorder.flush_if_due()

    def _take(self, name: str, body: bytes, message: Message, view: DerivedView | None) -> None:
        if isinstance(message, Heartbeat):
            self._on_heartbeat(message)
            return
        if name != "timing":
            self._recorder.write(name, max(message.t_s, 0.0), body)
            self._record_views(message)
        if isinstance(message, TruthMessage | BeaconTruth):
            self._truth_rows += len(message.rows)
        if view is not None:
            _show(message, view)
        if isinstance(message, MissionStatus):
            self._status = message
        self.take(message)

    def _record_views(self, message: Message) -> None:
        """What viewers get beside the topics; nothing that goes wrong there may end the run."""
        if not self._records_views:
            return
        try:
            for shown in self.views_of(message):
                self._recorder.write(*shown)
        except Exception as error:  # the raw topics hold all of it
            self._records_views = False
            self._on_recorder_failure(f"views for Foxglove and PlotJuggler: {type(error).__name__}: {error}")

    def _on_recorder_failure(self, reason: str) -> None:
        if self._view is not None:
            self._view.show_message("error", f"{reason}; the survey goes on")

    def _collect_until_truth(self, rows: int) -> None:
        for _ in range(int(FINISH_TIMEOUT_S * 100)):
            if self._truth_rows >= rows:
                return
            self.collect(10, None)

    def _ask(self, request: bytes) -> dict[str, Any]:
        with self._context.socket(zmq.REQ) as peer:
            peer.setsockopt(zmq.LINGER, 0)
            peer.connect(self._endpoints.of("puck"))
            peer.send(request)
            if not peer.poll(int(ASK_TIMEOUT_S * 1000)):
                return {}  # it is gone: what it published is all there is
            reply: dict[str, Any] = msgspec.json.decode(peer.recv())
            return reply


def _show(message: Message, view: DerivedView) -> None:
    if isinstance(message, TrackMessage):
        view.pose(message)
    elif isinstance(message, MissionStatus):
        view.status(message)
    elif isinstance(message, LogMessage):
        view.show_message(message.level, message.text)
    elif isinstance(message, DangerEvent) and message.code:
        text = danger_text(message.cause, message.signal, message.value, message.limit)
        view.show_message("warning", f"danger: code {message.code}, {text}, at {message.t_s:.2f} s")


class BeaconCollector(Collector):
    """Listens to a mission among beacons from its start to its end."""

    def __init__(self, access: RunAccess, cfg: RadioConfig) -> None:
        """Subscribe before anybody publishes."""
        metadata = {"system": cfg.system, "seed": str(cfg.run.seed), "config": dump_config(cfg)}
        super().__init__(access, metadata)
        self._summary = BeaconSummary(beacon_facts(cfg, is_sim=access.is_sim))
        self._signal = ""

    def take(self, message: Message) -> None:
        """A message for the summary."""
        summary = self._summary
        if isinstance(message, BeaconTrack):
            summary.add_track(message.rows)
        elif isinstance(message, BeaconTruth):
            summary.add_truth(message.rows)
        elif isinstance(message, BeaconPlaces):
            summary.set_places(message.places)
        elif isinstance(message, BeaconMapMessage):
            score = message.nis_sum, message.nis_size, message.refused
            summary.set_map(message.beacons, score, message.notes)
        elif isinstance(message, BeaconArrival):
            summary.add_reached(Reached(message.seq, message.estimate))
        elif isinstance(message, Timing):
            summary.add_ticks(message.tick_us)
        elif isinstance(message, DangerEvent):
            if message.signal and message.signal != self._signal:
                summary.add_danger(message.signal)
            self._signal = message.signal
        elif isinstance(message, MissionStatus):
            summary.set_mission(message.elapsed_s, message.outcome, message.cause)

    def summary(self, wall_s: float) -> dict[str, Any]:
        """``summary.json`` of what was collected."""
        return self._summary.build(wall_s)
