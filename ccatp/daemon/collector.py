"""Receives a run's messages from start to end: recording, progress, mission status, summary."""

import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol, Self

import msgspec
import numpy as np
import zmq

import ccatp
from ccatp.config.beacon_models import RadioConfig
from ccatp.config.load import dump_config
from ccatp.config.models import Config
from ccatp.core import FloatArray, PanelId, PanelPose, PointId, danger_text
from ccatp.daemon.process import Endpoints
from ccatp.errors import ExitStatus
from ccatp.links.bus import Subscriber
from ccatp.links.topics import (
    RECORD_FORMAT,
    TOPICS,
    ArrivalMessage,
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
    decode_recorded,
)
from ccatp.mirror.mirror import build_mirror, deck_poses
from ccatp.mirror.misalignment import fit_panel
from ccatp.mirror.surface import PanelFitError
from ccatp.records.beacon_summary import BeaconSummary, Reached, beacon_facts
from ccatp.records.recorder import TELEMETRY, Recorder, iter_messages, recordings
from ccatp.records.store import StoredSurvey, StoreError, read_survey
from ccatp.records.summary import PanelFits, RunFacts, SummaryBuilder, puck_targets
from ccatp.report.foxglove import Views, recorded_schemas
from ccatp.survey.planning.route import ORDERS

RECEIVED = tuple(topic.name for topic in TOPICS if topic.recorded or topic.message in (Timing, Heartbeat))
FINISH_TIMEOUT_S = 5.0
REQUEST_TIMEOUT_S = 1.0
# A panel's plane has three parameters; the fit refuses fewer, too.
MIN_FIXES = 3
# Topics of a survey's summary; a recording holds twenty times as much.
SUMMARISED = {"mission", "track", "truth", "arrival", "danger_event"}


class ProgressView(Protocol):
    """Display of the progress."""

    def show_message(self, level: str, text: str) -> None:
        """One line for the operator."""

    def pose(self, track: TrackMessage) -> None:
        """A batch of estimates."""

    def status(self, status: MissionStatus) -> None:
        """Progress of the mission."""


class RunAccess(NamedTuple):
    """Access to a run for its collector."""

    context: zmq.Context[zmq.Socket[bytes]]
    endpoints: Endpoints
    run_dir: Path
    is_sim: bool
    on_heartbeat: Callable[[Heartbeat], None]


class Collector(ABC):
    """Receives a run's messages; a subclass for each kind of mission builds the summary.

    Attributes:
        status: progress of the mission, once main has published it.
        remarks: warnings for the operator at the end.
    """

    def __init__(self, access: RunAccess, metadata: Mapping[str, str]) -> None:
        """Subscribe before the first message is published."""
        self._access = access
        names = ("main", "danger", "dashboard", *(("truth",) if access.is_sim else ()))
        self._subscriber = Subscriber(access.context, [access.endpoints.of(name) for name in names], RECEIVED)
        self._recorder = Recorder(
            access.run_dir / TELEMETRY,
            recorded_schemas(),
            is_simulation=access.is_sim,
            metadata={"format": str(RECORD_FORMAT), "ccatp": ccatp.__version__, **metadata},
            on_failure=self._on_recorder_failure,
        )
        self._view: ProgressView | None = None
        self._truth_rows = 0
        self._records_views = True
        self.status: MissionStatus | None = None
        self.remarks: list[str] = []

    @abstractmethod
    def take(self, message: Message) -> None:
        """A message for the summary."""

    def views_of(self, message: Message) -> Iterable[tuple[str, float, bytes]]:
        """Topic, time and JSON of messages for viewers, recorded beside this one."""
        del message
        return ()

    def finish(self) -> None:
        """Request the last rows of the simulated truth, and wait for messages on their way."""
        if self._access.is_sim:
            self._collect_until_truth(int(self._request(b"flush").get("rows", 0)))
        self.collect(1, None)

    @abstractmethod
    def summary(self, wall_s: float) -> dict[str, Any]:
        """``summary.json``; call it when main has closed the mission's database."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._recorder.close()
        self._subscriber.close()

    @property
    def is_over(self) -> bool:
        """Main has published how the mission ended."""
        return self.status is not None and self.status.exit_status >= 0

    @property
    def exit_status(self) -> ExitStatus:
        """Exit status of the run by main."""
        return ExitStatus(self.status.exit_status) if self.status is not None else ExitStatus.HELD

    def wait(self, timeout_ms: int, fds: Sequence[int] = ()) -> None:
        """Wait for a message or for a readable file descriptor, at most ``timeout_ms``."""
        poller = zmq.Poller()
        for waited_for in (self._subscriber.socket, *fds):
            poller.register(waited_for, zmq.POLLIN)
        poller.poll(timeout_ms)

    def collect(self, timeout_ms: int, view: ProgressView | None) -> None:
        """Take all messages that have arrived, waiting at most ``timeout_ms`` for the first."""
        self._view = view
        received = self._subscriber.receive_raw(timeout_ms / 1000.0)
        while received is not None:
            name, body, message = received
            if isinstance(message, Heartbeat):
                self._access.on_heartbeat(message)
            elif isinstance(message, Message):
                self._take(name, body, message, view)
            received = self._subscriber.receive_raw()
        self._recorder.flush_if_due()

    def _take(self, name: str, body: bytes, message: Message, view: ProgressView | None) -> None:
        if name != "timing":
            self._recorder.write(name, max(message.t_s, 0.0), body)
            self._record_views(message)
        if isinstance(message, TruthMessage | BeaconTruth):
            self._truth_rows += len(message.rows)
        if view is not None:
            _show(message, view)
        if isinstance(message, MissionStatus):
            self.status = message
        self.take(message)

    def _record_views(self, message: Message) -> None:
        """A failure in the views must not end the run."""
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

    def _request(self, request: bytes) -> dict[str, Any]:
        """Reply of the simulated truth; empty where it is gone, so that everything that it published has arrived."""
        with self._access.context.socket(zmq.REQ) as peer:
            peer.setsockopt(zmq.LINGER, 0)
            peer.connect(self._access.endpoints.of("puck"))
            peer.send(request)
            if not peer.poll(int(REQUEST_TIMEOUT_S * 1000)):
                return {}
            reply: dict[str, Any] = msgspec.json.decode(peer.recv())
            return reply


def _show(message: Message, view: ProgressView) -> None:
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
    """Collector of a mission among beacons."""

    def __init__(self, access: RunAccess, cfg: RadioConfig) -> None:
        metadata = {"system": cfg.system, "seed": str(cfg.run.seed), "config": dump_config(cfg)}
        super().__init__(access, metadata)
        self._summary = BeaconSummary(beacon_facts(cfg, is_sim=access.is_sim))
        self._signal = ""

    def take(self, message: Message) -> None:
        """See ``Collector``."""
        summary = self._summary
        if isinstance(message, BeaconTrack):
            summary.track += message.rows
        elif isinstance(message, BeaconTruth):
            summary.truth += message.rows
        elif isinstance(message, BeaconPlaces):
            summary.places = message.places
        elif isinstance(message, BeaconMapMessage):
            summary.beacons, summary.notes = message.beacons, message.notes
            summary.score = message.nis_sum, message.nis_size, message.refused
        elif isinstance(message, BeaconArrival):
            summary.reached.append(Reached(message.seq, message.estimate))
        elif isinstance(message, Timing):
            summary.ticks_us += message.tick_us
        elif isinstance(message, DangerEvent):
            if message.signal and message.signal != self._signal:
                summary.events[message.signal] += 1
            self._signal = message.signal
        elif isinstance(message, MissionStatus):
            summary.mission_time_s, summary.outcome = message.elapsed_s, message.outcome
            summary.cause = message.cause

    def summary(self, wall_s: float) -> dict[str, Any]:
        """See ``Collector``."""
        return self._summary.build(wall_s)


class _SurveySession:
    """Messages of one session of a survey; its summary can be built after the first status of the mission."""

    def __init__(
        self, builder_for: Callable[[MissionStatus], SummaryBuilder], on_deck: Callable[[TrackMessage], FloatArray]
    ) -> None:
        self._builder_for, self._on_deck = builder_for, on_deck
        self._early: list[Message] = []
        self._code = 0
        self.builder: SummaryBuilder | None = None

    def take(self, message: Message) -> None:
        if self.builder is None:
            self._early.append(message)
            if isinstance(message, MissionStatus):
                self.builder = self._builder_for(message)
                for early in self._early:
                    self._add(self.builder, early)
                self._early.clear()
        else:
            self._add(self.builder, message)

    def _add(self, builder: SummaryBuilder, message: Message) -> None:
        if isinstance(message, TruthMessage):
            builder.add_truth(message.rows)
        elif isinstance(message, TrackMessage):
            builder.add_track(self._on_deck(message))
        elif isinstance(message, ArrivalMessage):
            builder.add_arrival(PointId(*message.point), message.seq)
        elif isinstance(message, Timing):
            builder.add_ticks(message.tick_us)
        elif isinstance(message, DangerEvent):
            if message.code != self._code:
                builder.add_verdict_event(message.seq, message.code)
            self._code = message.code
        elif isinstance(message, MissionStatus):
            builder.set_mission(message.done, message.skipped, message.elapsed_s, message.left_out)


class SurveyCollector(Collector):
    """Collector of a survey."""

    def __init__(self, access: RunAccess, cfg: Config) -> None:
        metadata = {
            "mirror": cfg.mirror.name,
            "seed": str(cfg.run.seed),
            "world": cfg.world.name,
            "config": dump_config(cfg),  # a later session in the same directory may have another
        }
        super().__init__(access, metadata)
        self._cfg, self._run_dir = cfg, access.run_dir
        self._mirror = build_mirror(cfg.mirror)
        self._views = Views(self._mirror, cfg.robot.puck_height_m)
        self._session = _SurveySession(self._builder_for, self._on_deck)
        self._injected: PanelFits | None = None

    def take(self, message: Message) -> None:
        """See ``Collector``."""
        self._session.take(message)

    def views_of(self, message: Message) -> Iterable[tuple[str, float, bytes]]:
        """See ``Collector``."""
        return self._views.of(message)

    def _builder_for(self, status: MissionStatus) -> SummaryBuilder:
        cfg, is_sim = self._cfg, self._access.is_sim
        points = ORDERS[cfg.run.order](self._mirror, cfg.run.panels)
        facts = RunFacts(
            mirror=cfg.mirror.name,
            world=cfg.world.name if is_sim else None,
            filter=cfg.run.filter,
            seed=cfg.run.seed,
            total_points=status.total,
            lower_bound_s=status.lower_bound_s,
            budget_s=cfg.run.budget_s,
            puck_height_m=cfg.robot.puck_height_m,
            has_truth=is_sim,
        )
        targets = puck_targets(self._mirror, points, cfg.robot.puck_height_m)
        return SummaryBuilder(facts, targets, self._mirror.surface.normal)

    def _on_deck(self, track: TrackMessage) -> FloatArray:
        """Rows of seq, t_s, x, y, heading (deck), X, Y, Z of the surface point, as the truth has them."""
        poses = [PanelPose(PanelId(row, col), x, y, heading) for _, _, row, col, x, y, heading, _ in track.rows]
        x, y, heading, z = deck_poses(self._mirror, poses).T
        seq, t_s = np.array([row[:2] for row in track.rows]).T
        return np.column_stack([seq, t_s, x, y, heading, x, y, z])

    def finish(self) -> None:
        """See ``Collector``; the simulated misalignment is requested, too."""
        if self._access.is_sim:
            rows = int(self._request(b"flush").get("rows", 0))
            self._injected = {
                PanelId(int(row), int(col)): (piston, tip, tilt)
                for row, col, piston, tip, tilt in self._request(b"misalignment").get("panels", [])
            }
            self._collect_until_truth(rows)
        self.collect(1, None)

    def summary(self, wall_s: float) -> dict[str, Any]:
        """See ``Collector``."""
        survey = self._stored()
        if self._session.builder is None:
            if survey is None and (before := _read(self._run_dir / "summary.json")):
                return before  # nothing is known, and that must not replace an earlier summary
            # Main ended before its first status: the mission's database holds the counts.
            standings = [] if survey is None else [point.status for point in survey.points]
            done, skipped = standings.count("measured"), standings.count("skipped")
            self.take(MissionStatus(seq=-1, t_s=0.0, state="", total=len(standings), done=done, skipped=skipped))
        builder = self._session.builder
        if builder is None:
            raise RuntimeError("a status begins the summary")
        builder.set_panels({} if survey is None else self._fits(survey), self._injected)
        for path in reversed(recordings(self._run_dir / TELEMETRY)[:-1]):
            earlier = _SurveySession(self._builder_for, self._on_deck)
            for topic, _, payload in iter_messages(path):
                if topic in SUMMARISED and isinstance(message := decode_recorded(topic, payload), Message):
                    earlier.take(message)
            if earlier.builder is not None:
                builder.precede(earlier.builder)
        return builder.build(wall_s)

    def _stored(self) -> StoredSurvey | None:
        path = self._run_dir / "mission.sqlite"
        if not path.exists():  # main ended before it made one
            return None
        try:
            return read_survey(path, self._mirror.name)  # it needs no room on the disk
        except StoreError as error:
            self.remarks.append(f"the summary is without panels: {error}")
            return None

    def _fits(self, survey: StoredSurvey) -> PanelFits:
        fits = {}
        for panel in sorted({stored.point.panel for stored in survey.fixes}):
            own = [stored.fix for stored in survey.fixes if stored.point.panel == panel]
            if len(own) < MIN_FIXES:
                continue
            points = np.array([fix.position_m for fix in own])
            covariances = np.array([fix.covariance_m2 for fix in own]).reshape(-1, 3, 3)
            try:
                fit = fit_panel(self._mirror, panel, points, covariances, self._cfg.robot.puck_height_m)
            except PanelFitError:
                continue  # fixes on one line: a survey that ended early
            fits[panel] = (fit.piston_m, fit.tip_rad, fit.tilt_rad)
        return fits


def _read(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}
