"""Receives a run's messages from start to end: recording, progress, mission status, summary."""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import msgspec
import numpy as np
import zmq

import ccatp
from ccatp.beacons.config.models import RadioConfig
from ccatp.config.load import dump_config
from ccatp.config.models import Config
from ccatp.core import FloatArray, PanelId, PointId, unreliable_points
from ccatp.daemon.process import Endpoints
from ccatp.daemon.terminal import RunView
from ccatp.errors import ExitStatus
from ccatp.links.bus import Subscriber
from ccatp.links.topics import (
    TOPICS,
    ArrivalMessage,
    BeaconTruth,
    DangerEvent,
    FixMessage,
    Heartbeat,
    Message,
    MissionStatus,
    SessionMessage,
    Timing,
    TrackMessage,
    TruthMessage,
)
from ccatp.mirror.mirror import Mirror, build_mirror, deck_rows
from ccatp.records.recorder import (
    RECORD_FORMAT,
    TELEMETRY,
    Recorder,
    RobotClock,
    decode_recorded,
    recordings,
)
from ccatp.records.store import StoredSurvey, StoreError, read_survey
from ccatp.records.summary import PanelFits, SummaryBuilder
from ccatp.records.timeline import iter_places, read_timeline
from ccatp.report.foxglove import Views, recorded_schemas

if TYPE_CHECKING:
    from ccatp.beacons.records.summary import BeaconSummary

RECEIVED = tuple(topic.name for topic in TOPICS if topic.recorded or topic.message in (Timing, Heartbeat))
FINISH_TIMEOUT_S = 5.0
REQUEST_TIMEOUT_S = 1.0
# Topics of a survey's summary; a recording holds twenty times as much.
SUMMARISED = {"mission", "track", "truth", "arrival", "fix", "danger_event"}


class Collector:
    """Receives a run's messages: records and shows them, and collects the summary.

    ``status``: progress of the mission, ``None`` before main has published it.
    """

    def __init__(
        self,
        context: zmq.Context[zmq.Socket[bytes]],
        endpoints: Endpoints,
        run_dir: Path,
        cfg: Config | RadioConfig,
        on_heartbeat: Callable[[Heartbeat], None],
        *,
        is_sim: bool,
    ) -> None:
        """Subscribe before the first message is published."""
        self._context, self._endpoints, self._on_heartbeat, self._is_sim = context, endpoints, on_heartbeat, is_sim
        names = ("main", "danger", "dashboard", *(("truth",) if is_sim else ()))
        self._subscriber = Subscriber(context, [endpoints.of(name) for name in names], RECEIVED)
        self._record: BeaconSummary | SurveyRecord
        self._views: Views | None = None
        clock = RobotClock(is_simulation=is_sim)
        self._view: RunView | None = None
        if isinstance(cfg, RadioConfig):
            # Imported late: a survey does not need it, and its libraries are large.
            from ccatp.beacons.records import summary as beacon_summary  # noqa: PLC0415

            what = {"system": cfg.system, "seed": str(cfg.run.seed)}
            self._record = beacon_summary.BeaconSummary(cfg, is_sim)
        else:
            what = {"mirror": cfg.mirror.name, "seed": str(cfg.run.seed), "world": cfg.world.name}
            self._record = SurveyRecord(cfg, run_dir, is_sim=is_sim)
            self._views = Views(self._record.mirror, cfg.robot.puck_height_m, clock)
        software = {"format": str(RECORD_FORMAT), "ccatp": ccatp.__version__}
        config = dump_config(cfg)  # a later session in the same directory may have another
        self._recorder = Recorder(
            run_dir / TELEMETRY,
            recorded_schemas(),
            is_simulation=is_sim,
            metadata={**software, **what, "config": config},
            on_failure=self._on_recorder_failure,
            clock=clock,
        )
        self._truth_rows = 0
        self.status: MissionStatus | None = None

    @property
    def remarks(self) -> list[str]:
        """Warnings for the operator at the end."""
        return self._record.remarks if isinstance(self._record, SurveyRecord) else []

    def finish(self) -> None:
        """Request the last rows of the simulated truth, and wait for the messages that are still on their way."""
        if self._is_sim:
            rows = int(self._request(b"flush").get("rows", 0))
            if isinstance(self._record, SurveyRecord):
                self._record.set_injected(self._request(b"misalignment").get("panels", []))
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
        if isinstance(message, TruthMessage | BeaconTruth):
            self._truth_rows += len(message.rows)
        if self._view is not None:
            self._view.show(message)
        if isinstance(message, MissionStatus):
            self.status = message
        self._record.take(message)

    def _record_views(self, message: Message) -> None:
        """A failure in the views must not end the run."""
        if self._views is None:
            return
        try:
            for shown in self._views.of(message):
                self._recorder.write(*shown)
        except Exception as error:  # the raw topics have all the data
            self._views = None
            self._on_recorder_failure(f"views for Foxglove and PlotJuggler: {type(error).__name__}: {error}")

    def _on_recorder_failure(self, reason: str) -> None:
        if self._view is not None:
            self._view.show_message("error", f"{reason}; the survey continues")

    def _request(self, request: bytes) -> dict[str, Any]:
        """Reply of the simulated truth; empty if it has ended, when all its messages have arrived."""
        with self._context.socket(zmq.REQ) as peer:
            peer.setsockopt(zmq.LINGER, 0)
            peer.connect(self._endpoints.of("puck"))
            peer.send(request)
            if not peer.poll(int(REQUEST_TIMEOUT_S * 1000)):
                return {}
            reply: dict[str, Any] = msgspec.json.decode(peer.recv())
            return reply


class _SurveySession:
    """Messages of one session of a survey."""

    def __init__(self, cfg: Config, mirror: Mirror, *, is_sim: bool) -> None:
        self._mirror, self._code, self.has_status = mirror, 0, False
        self._frames_before = 0  # of the robot's present boot; danger names frames by the robot's own numbers
        self.builder = SummaryBuilder(cfg, mirror, is_sim=is_sim)

    def take(self, message: Message) -> None:
        builder = self.builder
        if isinstance(message, TruthMessage):
            builder.add_truth(message.rows)
        elif isinstance(message, TrackMessage):
            builder.add_track(self._on_deck(message))
        elif isinstance(message, ArrivalMessage):
            builder.add_arrival(PointId(*message.point), message.seq)
        elif isinstance(message, FixMessage):
            if message.point is not None and not message.is_set_aside:
                builder.add_fix(PointId(*message.point), message.position_m)
        elif isinstance(message, Timing):
            builder.add_ticks(message.tick_us)
        elif isinstance(message, DangerEvent):
            if message.code != self._code:
                builder.add_verdict_event(message.seq + self._frames_before, message.code)
            self._code = message.code
        elif isinstance(message, SessionMessage):
            self._frames_before = message.frames_before
        elif isinstance(message, MissionStatus):
            if not self.has_status:  # only the first: a main loop that takes over plans only the rest
                self.has_status = True
                builder.set_plan(message.total, message.lower_bound_s)
            builder.set_mission(message.done, message.skipped, message.elapsed_s, message.left_out)
            builder.add_grip(message.friction, message.grip)

    def _on_deck(self, track: TrackMessage) -> FloatArray:
        """Rows of seq, t_s, x, y, heading (deck), X, Y, Z of the surface point, in the format of the truth."""
        rows = np.array(track.rows)
        deck = deck_rows(self._mirror, [row[2:4] for row in track.rows], rows[:, 4:7])
        return np.column_stack([rows[:, :2], deck[:, :3], deck[:, :2], deck[:, 3]])


class SurveyRecord:
    """Messages of a survey, for its summary."""

    def __init__(self, cfg: Config, run_dir: Path, *, is_sim: bool) -> None:
        self._cfg, self._run_dir, self._is_sim = cfg, run_dir, is_sim
        self.mirror = build_mirror(cfg.mirror)
        self._session = _SurveySession(cfg, self.mirror, is_sim=is_sim)
        self.take = self._session.take
        self._injected: PanelFits | None = None
        self.remarks: list[str] = []

    def set_injected(self, rows: list[list[float]]) -> None:
        """Set the true misalignment of the simulated panels: rows of row, column, piston, tip, tilt."""
        self._injected = {PanelId(int(row), int(col)): (piston, tip, tilt) for row, col, piston, tip, tilt in rows}

    def build(self, wall_s: float) -> dict[str, Any]:
        """The summary, after main has closed the mission's database."""
        survey = self._stored()
        standings = [] if survey is None else [point.status for point in survey.points]
        if not self._session.has_status:
            if survey is None and (before := _read(self._run_dir / "summary.json")):
                return before  # keep the earlier summary, because nothing is known of this session
            self.take(MissionStatus(seq=-1, t_s=0.0, state="", total=len(standings)))
        builder = self._session.builder
        if survey is not None:  # the last status of a main that was terminated may be lost
            builder.set_counts(standings.count("measured"), standings.count("skipped"))
            builder.set_unreliable(unreliable_points(survey.fixes))
        builder.set_panels({} if survey is None else self._fits(survey), self._injected)
        for path in reversed(recordings(self._run_dir / TELEMETRY)[:-1]):
            earlier = _SurveySession(self._cfg, self.mirror, is_sim=self._is_sim)
            timeline = read_timeline(path, is_simulation=self._is_sim)
            for place, topic, _, payload in iter_places(path):
                if topic in SUMMARISED and isinstance(message := decode_recorded(topic, payload), Message):
                    earlier.take(timeline.on_axis(place, message))
            if earlier.has_status:
                builder.precede(earlier.builder)
        return builder.build(wall_s)

    def _stored(self) -> StoredSurvey | None:
        path = self._run_dir / "mission.sqlite"
        if not path.exists():  # main ended before it created one
            return None
        try:
            return read_survey(path, self.mirror.name)  # works on a full disk, too
        except StoreError as error:
            self.remarks.append(f"the summary is without panels: {error}")
            return None

    def _fits(self, survey: StoredSurvey) -> PanelFits:
        # SciPy would delay the start of each run by a fifth of a second, and is used at its end only.
        from ccatp.mirror.panel_alignment import fit_panels  # noqa: PLC0415

        return fit_panels(self.mirror, survey.fixes, self._cfg.robot.puck_height_m)


def _read(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}
