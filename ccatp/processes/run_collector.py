"""Glue. Collects a run from the bus: recording, progress, and what the summary needs."""

from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol

import msgspec
import numpy as np
import zmq

import ccatp
from ccatp.bus import Subscriber
from ccatp.config.loader import dump_config
from ccatp.config.models import Config
from ccatp.errors import ExitStatus
from ccatp.mirror.alignment import PanelFit, fit_panel
from ccatp.mirror.batches import FloatArray, deck_poses
from ccatp.mirror.errors import PanelFitError
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.planning.traversal import ORDERS
from ccatp.processes.common import Endpoints
from ccatp.recorder import Recorder
from ccatp.samples import PanelId, PanelPose, PointId
from ccatp.store import MissionStore
from ccatp.summary import RunFacts, SummaryBuilder, puck_targets
from ccatp.viewing.views import Views, recorded_schemas
from ccatp.wire.topics import (
    RECORD_FORMAT,
    TOPICS,
    Arrival,
    DangerEvent,
    Log,
    Message,
    MissionStatus,
    Presence,
    Timing,
    Track,
    Truth,
)

RECEIVED = tuple(topic.name for topic in TOPICS if topic.recorded or topic.message in (Timing, Presence))
FINISH_TIMEOUT_S = 5.0
ASK_TIMEOUT_S = 1.0
# A panel's plane has three parameters; the fit says so too, this saves the attempt.
MIN_FIXES = 3


NO_STATUS = MissionStatus(
    seq=-1,
    t_s=0.0,
    state="",
    cause="",
    done=0,
    skipped=0,
    total=0,
    point="",
    elapsed_s=0.0,
    eta_s=0.0,
    error_mm=0.0,
    code=0,
    outcome="",
    lower_bound_s=0.0,
    exit_status=-1,
)


class View(Protocol):
    """Where progress is shown."""

    def say(self, level: str, text: str) -> None:
        """One line for the operator."""

    def pose(self, track: Track) -> None:
        """A batch of estimates."""

    def status(self, status: MissionStatus) -> None:
        """Where the mission stands."""


class RunCollector:
    """Listens to a run from its start to its end.

    Args:
        context: ZeroMQ context of the process.
        endpoints: where the processes publish.
        cfg: the run's configuration.
        run_dir: the recording and the mission's database are there.
        is_sim: the simulated truth can be asked for.
        on_presence: told that a process is there.
    """

    def __init__(
        self,
        context: zmq.Context[zmq.Socket[bytes]],
        endpoints: Endpoints,
        cfg: Config,
        run_dir: Path,
        *,
        is_sim: bool,
        on_presence: Callable[[Presence], None],
    ) -> None:
        """Subscribe before anybody publishes."""
        self._context, self._endpoints, self._cfg, self._run_dir, self._is_sim = (
            context,
            endpoints,
            cfg,
            run_dir,
            is_sim,
        )
        self._on_presence = on_presence
        self._mirror: Mirror = build_mirror(cfg.mirror)
        names = ("main", "danger", "dashboard", "truth") if is_sim else ("main", "danger", "dashboard")
        self._subscriber = Subscriber(context, [endpoints.of(name) for name in names], RECEIVED)
        self._recorder = Recorder(
            run_dir / "telemetry.mcap",
            recorded_schemas(),
            is_simulation=is_sim,
            metadata={
                "format": str(RECORD_FORMAT),
                "ccatp": ccatp.__version__,
                "mirror": cfg.mirror.name,
                "seed": str(cfg.run.seed),
                "world": cfg.world.name,
                "config": dump_config(cfg),  # a later session in the same directory may have another
            },
            on_failure=self._on_recorder_failure,
        )
        self._views: Views | None = Views(self._mirror, cfg.robot.puck_height_m)
        self._view: View | None = None
        self._builder: SummaryBuilder | None = None
        self._early: list[Message] = []
        self._status: MissionStatus | None = None
        self._truth_rows = self._track_seq = 0
        self._code = 0
        self._injected: dict[PanelId, tuple[float, float, float]] | None = None

    def __enter__(self) -> "RunCollector":
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

    def collect(self, timeout_ms: int, view: View | None) -> None:
        """Take what came in, waiting at most ``timeout_ms`` for the first."""
        self._view = view
        received = self._subscriber.receive_raw(timeout_ms / 1000.0)
        while received is not None:
            name, body, message = received
            if isinstance(message, Message):
                self._take(name, body, message, view)
            received = self._subscriber.receive_raw()
        self._recorder.tend()

    def _take(self, name: str, body: bytes, message: Message, view: View | None) -> None:
        if isinstance(message, Presence):
            self._on_presence(message)
            return
        if name != "timing":
            self._recorder.write(name, max(message.t_s, 0.0), body)
            self._record_views(message)
        if isinstance(message, Truth):
            self._truth_rows += len(message.rows)
        elif isinstance(message, Track):
            self._track_seq = message.seq
        if view is not None:
            _show(message, view)
        if isinstance(message, MissionStatus):
            self._status = message
            if self._builder is None:
                self._begin(message)
        if self._builder is None:
            self._early.append(message)
        else:
            self._add(self._builder, message)

    def _record_views(self, message: Message) -> None:
        """What viewers get beside the topics; nothing that goes wrong there may end the run."""
        if self._views is None:
            return
        try:
            for shown in self._views.of(message):
                self._recorder.write(*shown)
        except Exception as error:  # the raw topics hold all of it
            self._views = None
            self._on_recorder_failure(f"views for Foxglove and PlotJuggler: {type(error).__name__}: {error}")

    def _on_recorder_failure(self, reason: str) -> None:
        if self._view is not None:
            self._view.say("error", f"recording ended, the survey goes on: {reason}")

    def _begin(self, status: MissionStatus) -> SummaryBuilder:
        cfg = self._cfg
        points = ORDERS[cfg.run.order](self._mirror, cfg.run.panels)
        facts = RunFacts(
            mirror=cfg.mirror.name,
            world=cfg.world.name if self._is_sim else None,
            filter=cfg.run.filter,
            seed=cfg.run.seed,
            total_points=status.total,
            lower_bound_s=status.lower_bound_s,
            budget_s=cfg.run.budget_s,
            puck_height_m=cfg.robot.puck_height_m,
            has_truth=self._is_sim,
        )
        targets = puck_targets(self._mirror, points, cfg.robot.puck_height_m)
        self._builder = builder = SummaryBuilder(facts, targets, self._mirror.surface.normal)
        for message in self._early:
            self._add(builder, message)
        self._early.clear()
        return builder

    def _add(self, builder: SummaryBuilder, message: Message) -> None:
        if isinstance(message, Truth):
            builder.add_truth(message.rows)
        elif isinstance(message, Track):
            builder.add_track(self._on_deck(message))
        elif isinstance(message, Arrival):
            builder.add_arrival(PointId(*message.point), message.seq)
        elif isinstance(message, Timing):
            builder.add_ticks(message.tick_us)
        elif isinstance(message, DangerEvent):
            if message.code != self._code:
                builder.add_verdict_event(message.seq, message.code)
            self._code = message.code
        elif isinstance(message, MissionStatus):
            builder.set_mission(message.done, message.skipped, message.elapsed_s, message.left_out)

    def _on_deck(self, track: Track) -> FloatArray:
        """Rows of seq, t_s, x, y, heading (deck), X, Y, Z of the surface point, as the truth has them."""
        poses = [PanelPose(PanelId(row, col), x, y, heading) for _, _, row, col, x, y, heading, _ in track.rows]
        x, y, heading, z = deck_poses(self._mirror, poses).T
        seq, t_s = np.array([row[:2] for row in track.rows]).T
        return np.column_stack([seq, t_s, x, y, heading, x, y, z])

    def finish(self) -> None:
        """Ask the simulated truth for its last rows and the injected misalignment, and wait for what is on its way."""
        if self._is_sim:
            rows = int(self._ask(b"flush").get("rows", 0))
            self._injected = {
                PanelId(int(row), int(col)): (piston, tip, tilt)
                for row, col, piston, tip, tilt in self._ask(b"misalignment").get("panels", [])
            }
            self._collect_until_truth(rows)
        self.collect(1, None)

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

    def summary(self, wall_s: float) -> dict[str, Any]:
        """``summary.json`` of what was collected; call it when main has closed the mission's database."""
        builder = self._builder or self._begin(NO_STATUS)  # where main never said where it stood
        builder.set_panels(
            {panel: (fit.piston_m, fit.tip_rad, fit.tilt_rad) for panel, fit in self._fits().items()}, self._injected
        )
        builder.set_wall(wall_s)
        return builder.build()

    def _fits(self) -> dict[PanelId, PanelFit]:
        path = self._run_dir / "mission.sqlite"
        if not path.exists():  # main ended before it made one
            return {}
        with MissionStore.open(path, mirror=self._mirror.name) as store:
            fixes = store.fixes()
        fits = {}
        for panel in sorted({PanelId(stored.point.row, stored.point.col) for stored in fixes}):
            own = [stored.fix for stored in fixes if stored.point.panel == panel]
            if len(own) < MIN_FIXES:
                continue
            points = np.array([fix.position_m for fix in own])
            covariances = np.array([fix.covariance_m2 for fix in own]).reshape(-1, 3, 3)
            try:
                fits[panel] = fit_panel(self._mirror, panel, points, covariances, self._cfg.robot.puck_height_m)
            except PanelFitError:
                continue  # fixes on one line: a survey that ended early
        return fits


def _show(message: Message, view: View) -> None:
    if isinstance(message, Track):
        view.pose(message)
    elif isinstance(message, MissionStatus):
        view.status(message)
    elif isinstance(message, Log):
        view.say(message.level, message.text)
    elif isinstance(message, DangerEvent) and message.code:
        text = f"code {message.code} {message.cause} {message.signal} {message.value:.4g} (limit {message.limit:.4g})"
        view.say("warning", f"danger: {text} at {message.t_s:.2f} s")
