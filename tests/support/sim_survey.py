"""Surveys in process, frame by frame: with faults, with a scripted laser system, with main loops that are killed."""

import asyncio
from collections.abc import AsyncIterator, Callable
from concurrent.futures import Future, wait
from contextlib import asynccontextmanager, suppress
from copy import deepcopy
from dataclasses import dataclass
from itertools import pairwise
from math import floor, hypot
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple, TypeVar, cast

import msgspec
import numpy as np

from ccatp.conditions import text_of
from ccatp.config.models import Config
from ccatp.control.wheel_motion import SentDrives
from ccatp.core import NO_CAUSE, DeckPose, Fix, PointId, Severity, Vector3, Verdict
from ccatp.daemon.loops.fix_service import FixRequest, FixService
from ccatp.estimation.fixes import FixRefused, deck_foot
from ccatp.etalon_client import BadSolution, EtalonClient, EtalonError
from ccatp.links.bus import Telemetry
from ccatp.links.robot_messages import Sensors
from ccatp.links.topics import FixMessage
from ccatp.mirror.multilateration import MultilaterationError
from ccatp.records.store import MissionStore, StoredPoint
from ccatp.sim.fault_injector import Injector
from ccatp.sim.fault_plan import FaultPlan, parse_plan
from ccatp.studies.sil_run import SilRun
from ccatp.survey.composition import Checkpoint, SurveyParts, take_over
from ccatp.survey.events import Fault, FixFailed, FixStored, Mode, SurveyInput, TakenOver
from ccatp.survey.fix_gate import nis_of
from ccatp.survey.fix_review import FixReview
from tests.support.virtual_time import VirtualLoop

T = TypeVar("T")
FULL = (1.0, 1.0)
NO_FAULTS = FaultPlan()


def plan_of(*faults: str) -> FaultPlan:
    """A plan; each fault as in `encoder_right stuck at_s=7.5 value=0.0`."""
    rows = []
    for fault in faults:
        signal, kind, *keys = fault.split()
        rows.append("\n".join(["[[fault]]", f'signal = "{signal}"', f'type = "{kind}"', *keys]))
    return parse_plan("\n".join(rows), "plan")


# -- watched frame by frame -------------------------------------------------------------------------------------------


def executed(drive: tuple[float, float], verdict: Verdict) -> tuple[float, float]:
    """The set points that both keys together leave: the permit on a frame counts for the drive that answers it."""
    right, left = drive
    is_denied = not verdict.forward if right + left > 0.0 else not verdict.reverse and right + left < 0.0
    return (0.0, 0.0) if is_denied or (right != left and not verdict.turn) else drive


class Seen(NamedTuple):
    """One frame of a watched mission: what the robot was told after it, and where it really was."""

    t_s: float
    verdict: Verdict
    state: Mode
    drive: tuple[float, float]
    pose: DeckPose
    estimate: tuple[float, float]

    @property
    def is_zero(self) -> bool:
        return self.drive == (0.0, 0.0)


class Enough(Exception):
    """Seen what was to be seen."""


class Watched(SilRun):
    """Keeps what happened frame by frame; ends as soon as somebody has seen enough."""

    def __init__(self, cfg: Config, plan: FaultPlan, is_enough: Callable[[Seen], bool]) -> None:
        super().__init__(cfg, plan)
        self.seen: list[Seen] = []
        self._is_enough = is_enough
        self._last_s = 0.0

    def go_on(self, plan: FaultPlan, is_enough: Callable[[Seen], bool]) -> None:
        """From where it has seen enough, with the robot's faults of a plan, all of which are later."""
        rng = np.random.default_rng(self.cfg.run.seed).spawn(3)[2]  # that of the robot's injector
        self.robot.injector = injector = Injector(plan, self.mirror, rng)
        assert not injector.drifts
        assert all(fault.signal != "laser" for fault in plan.faults)
        self._is_enough = is_enough
        self.robot.advance()
        self._run_from(self._receive(), 0.0, self._last_s)

    def _serve(self, frame: Sensors, dt_s: float) -> None:
        super()._serve(frame, dt_s)
        self._last_s = frame.t + self._time.offset_s
        deck, robot = self.localizer.deck_pose, self.robot
        place = robot.world.plant.pose
        verdict, estimate = self.monitor.verdict, (deck.x_m, deck.y_m)
        drive = executed(self.pipeline.sent.rates, verdict)
        now = Seen(robot.t_s, verdict, self.mission.state.mode, drive, place, estimate)
        self.seen.append(now)
        if self._is_enough(now):
            raise Enough

    def since(self, t_s: float) -> list[Seen]:
        return [one for one in self.seen if one.t_s >= t_s - 1e-9]

    def first(self, t_s: float, is_it: Callable[[Seen], bool]) -> Seen:
        """The first frame from ``t_s`` on of which something is true."""
        return next(one for one in self.since(t_s) if is_it(one))

    def time_to_zero_s(self, t_s: float) -> float:
        """From ``t_s`` to the first zero drive of the hold that follows."""
        held = self.first(t_s, lambda one: one.verdict.severity >= Severity.PAUSE or one.verdict.code != 0)
        return self.first(held.t_s, lambda one: one.is_zero).t_s - t_s

    def way_m(self, t_s: float, until_s: float) -> float:
        """True travel of the robot's centre."""
        poses = [one.pose for one in self.since(t_s) if one.t_s <= until_s]
        return sum(hypot(b.x_m - a.x_m, b.y_m - a.y_m) for a, b in pairwise(poses))


_BEGUN: dict[tuple[int, float], Watched] = {}


def begun(cfg: Config, t_s: float) -> Watched:
    """A mission without a fault, so far; one for all that go on from there."""
    key = id(cfg), t_s  # the mission keeps its configuration, so no other object has this id
    if key not in _BEGUN:
        _BEGUN[key] = run = Watched(cfg, NO_FAULTS, lambda one: one.t_s >= t_s)
        with suppress(Enough):
            run.run()
    return _BEGUN[key]


def watched(cfg: Config, is_enough: Callable[[Seen], bool], *faults: str) -> Watched:
    """A watched mission with faults as of ``plan_of``; each of them really acted.

    Missions of one configuration are equal until the first fault: until the half second before it, of which the fault
    may know the readings, they are computed once and copied.
    """
    plan = plan_of(*faults)
    common_s = 0.5 * floor(2.0 * min((fault.at_s for fault in plan.faults), default=0.0)) - 0.5
    with suppress(Enough):
        if common_s > 1.0:
            shared = begun(cfg, common_s)
            run = deepcopy(shared, {id(one): one for one in (shared.cfg, shared.mirror)})
            run.go_on(plan, is_enough)
        else:
            run = Watched(cfg, plan, is_enough)
            run.run()
    assert all(record.samples and record.changed for record in run.injected), "a fault changed nothing"
    return run


# -- measured as the main loop measures -------------------------------------------------------------------------------


def patient(store: MissionStore) -> MissionStore:
    """A store whose caller waits for the commit: virtual time must not pass while a disk turns."""

    def waiting(record: Callable[..., "Future[T]"]) -> Callable[..., "Future[T]"]:
        def recorded(*args: Any) -> "Future[T]":
            commit = record(*args)
            wait([commit])
            return commit

        return recorded

    return cast(
        MissionStore,
        SimpleNamespace(record_fix=waiting(store.record_fix), record_skipped=waiting(store.record_skipped)),
    )


def fix_service(
    cfg: Config,
    measure: Callable[..., Any],
    store: MissionStore,
    mission: Any,
    *,
    localizer: Any = None,
    review: Any = None,
    on_finished: Callable[[], None] = lambda: None,
    publish: Callable[[str, Any], None] = lambda *_: None,
    notify: Callable[[str, str], None] = lambda *_: None,
    measuring_time_s: float = 0.0,
    not_ready: int = 0,
) -> FixService:
    """The main loop's fix service; what is not given is there only to be asked.

    ``not_ready``: so many times the lasers are not warm yet.
    """
    ready = iter((False,) * not_ready)
    passed = SimpleNamespace(doubt="", refusal=NO_CAUSE)
    gate: Any = SimpleNamespace(begin=lambda: None, review=lambda *_, **__: passed, refusal_of=lambda *_: NO_CAUSE)
    follow: Any = SimpleNamespace(begin=lambda: None, doubt=lambda _: "", is_certain=False)

    async def is_laser_ready() -> bool:
        return next(ready, True)

    etalon = cfg.etalon.model_copy(update={"measuring_time_s": measuring_time_s})
    parts = SimpleNamespace(
        cfg=cfg.model_copy(update={"etalon": etalon}),
        localizer=localizer or sightless(),
        mission=mission,
        heading_sigma_rad=float,
        fix_review=review or FixReview(gate, follow),
    )
    return FixService(
        cast(EtalonClient, SimpleNamespace(measure=measure, is_laser_ready=is_laser_ready)),
        cast(SurveyParts, parts),
        store,
        cast(Telemetry, SimpleNamespace(send=publish, notify_operator=notify, seq=0)),
        SimpleNamespace(release_time=on_finished, is_lockstep=False),
    )


def sightless(**parts: Any) -> Any:
    """A localizer that takes every fix and learns nothing of it."""
    kept: dict[str, Any] = {"notices": [], "pose": None, "pose_covariance": np.eye(3), "position_sigma_m": 5e-6}
    return SimpleNamespace(**{"fuse_fix": lambda _fix: 0.0, **kept, **parts})


@asynccontextmanager
async def serving(service: FixService) -> AsyncIterator[None]:
    """The service at work; what ends it is raised."""
    async with asyncio.TaskGroup() as tasks:
        task = tasks.create_task(service.run())
        yield
        task.cancel()


class Desk:
    """The fix service before a mission that asks for one point after the other.

    Attributes:
        done, failed: what the mission was told.
        faults: for which it is held.
        said: lines for the operator.
    """

    def __init__(
        self, cfg: Config, measure: Callable[..., Any], store: MissionStore, measuring_time_s: float = 0.0
    ) -> None:
        self.done, self.failed, self.faults, self.said = list[Any](), list[str](), list[str](), list[str]()
        self.over, self.faulted = asyncio.Event(), asyncio.Event()
        mission = SimpleNamespace(
            state=SimpleNamespace(is_awaiting_fix=True, is_lost=True, request=1, stop=None),
            survey=SimpleNamespace(follower=SimpleNamespace(distance_m=lambda _stop, _pose: 0.0)),
            handle=self._handle,
        )
        self.service = fix_service(
            cfg, measure, store, mission, on_finished=self.over.set, notify=lambda _, text: self.said.append(text),
            measuring_time_s=measuring_time_s,
        )  # fmt: skip

    def _handle(self, event: SurveyInput) -> None:
        if isinstance(event, FixStored):
            self.done.append(event.point)
        elif isinstance(event, FixFailed):
            self.failed.append(event.cause)
        elif isinstance(event, Fault):
            self.faults.append(text_of(event.cause))
            self.faulted.set()

    def begin(self, point: PointId, expected_m: Vector3 = (0.0, 0.0, 0.0)) -> None:
        """Ask for a point; ``over`` tells the end."""
        self.over.clear()
        self.service.begin(FixRequest(1, 1.0, point, expected_m, DeckPose(0.1, 0.2, 0.3)))


@dataclass(slots=True)
class LaserRequest:
    """One request to the laser system: what the robot knew, what it was told, what was wrong with that."""

    t_s: float
    point: PointId | None
    offset_m: float = 0.0
    nis: float = float("nan")
    is_fused: bool = False


# Called with a request and the true fix; returns the fix that is given, or raises.
Laser = Callable[[LaserRequest, Fix], Fix]


def moved(fix: Fix, offset_m: Vector3) -> Fix:
    x, y, z = (a + b for a, b in zip(fix.position_m, offset_m, strict=True))
    return Fix(fix.t_s, (x, y, z), fix.covariance_m2, fix.dop, fix.channels, fix.residual_rms_m)


class MeasuredSurvey(SilRun):
    """A survey that measures as the main loop does: fix service, fix gate, store.

    Attributes:
        asked: every request to the laser system.
        said: lines for the operator.
        fans: duties that were commanded, with their time.
    """

    def __init__(
        self, cfg: Config, folder: Path, laser: Laser = lambda _measured, fix: fix, plan: FaultPlan = NO_FAULTS
    ) -> None:
        super().__init__(cfg, plan)
        self.asked: list[LaserRequest] = []
        self.said: list[str] = []
        self.fans: list[tuple[float, tuple[float, float]]] = []
        self._scripted, self._folder = laser, folder

    def run(self) -> Any:
        points = [StoredPoint(point, 0.0, 0.0) for point in self.parts.points]
        path = self._folder / "mission.sqlite"
        with (
            asyncio.Runner(loop_factory=VirtualLoop) as runner,
            MissionStore.create(path, mirror=self.mirror.name, seed=1, config_toml="", points=points) as store,
        ):
            self._runner, self._over = runner, asyncio.Event()
            self.service = fix_service(
                self.cfg,
                self._ask,
                patient(store),
                self.mission,
                localizer=self.localizer,
                review=self.parts.fix_review,
                on_finished=self._over.set,
                publish=self._note_fix,
                notify=lambda level, text: self.said.append(f"{level}: {text}"),
                measuring_time_s=0.5,
            )
            result = super().run()
            self.stored = [(row.point, row.status) for row in store.points()]
            self.all_fixes = store.fixes()
            return result

    def _serve(self, frame: Sensors, dt_s: float) -> None:
        self.look(frame)
        super()._serve(frame, dt_s)
        if self.mission.state.full_fans and not self.fans:
            self.fans.append((frame.t, FULL))
            self.robot.command_fans(2, *FULL)

    def look(self, frame: Sensors) -> None:
        """Before each frame; for tests to interfere."""

    def _measure(self, frame: Sensors) -> None:
        mission, pose = self.mission, self.localizer.deck_pose
        expected = self.mirror.puck_world(pose, self.cfg.robot.puck_height_m)
        request = FixRequest(mission.state.request, frame.t, mission.state.measuring_point, expected, pose)
        self._request = request
        self._runner.run(self._one(request))

    async def _one(self, request: FixRequest) -> None:
        self._over.clear()
        async with serving(self.service):
            self.service.begin(request)
            await self._over.wait()

    async def _ask(self, t_s: float, expected_m: Vector3) -> Fix:
        measured = LaserRequest(t_s, self._request.point)
        self.asked.append(measured)
        try:
            true = self.laser.fix(t_s, self.localizer.deck_pose)
        except MultilaterationError as error:
            raise BadSolution(str(error), {}) from error
        fix = self._scripted(measured, true)
        measured.offset_m = float(np.linalg.norm(np.subtract(fix.position_m, true.position_m)))
        distance_m = float(np.linalg.norm(np.subtract(fix.position_m, expected_m)))
        if distance_m > self.cfg.etalon.max_distance_m:
            raise BadSolution(f"{distance_m:.3f} m from the expected position", {})
        try:
            foot = deck_foot(self.mirror, fix, self.cfg.robot.puck_height_m)
            measured.nis = nis_of(foot, self.localizer.deck_pose, self.localizer.pose_covariance)
        except FixRefused:
            measured.nis = float("inf")
        return fix

    def _note_fix(self, _topic: str, message: FixMessage) -> None:
        self.asked[-1].is_fused = message.is_fused


def failing(_measured: LaserRequest, _fix: Fix) -> Fix:
    raise EtalonError("no reply")


# -- main loops that are killed ----------------------------------------------------------------------------------------

RECORD_FRAMES, SILENT_FRAMES = 10, 150


class RestartedSurvey(SilRun):
    """A survey in which the main loop is killed at given frames, and another one knows what the first one kept.

    Args:
        cfg: the configuration.
        kills: numbers of the frames after which main is gone; each time there is no controller for 1.5 s.
    """

    def __init__(self, cfg: Config, kills: set[int]) -> None:
        super().__init__(cfg)
        self._kills = kills
        self._checkpoint = b""
        self.states: list[Mode] = []
        self.first_moves_m: list[float] = []

    def _serve(self, frame: Sensors, dt_s: float) -> None:
        super()._serve(frame, dt_s)
        if frame.seq % RECORD_FRAMES == 0:
            record = Checkpoint.of(self.localizer, self.mission.state, frame.seq, frame.t, frame.t)
            self._checkpoint = msgspec.msgpack.encode(record)
        if frame.seq in self._kills:
            self._die()

    def _die(self) -> None:
        robot = self.robot
        self.states.append(self.mission.state.mode)
        robot.lose("controller")
        for _ in range(SILENT_FRAMES):
            robot.advance()
            self._note_truth()
        robot.join("controller")
        self._take_over()

    def _take_over(self) -> None:
        cfg, before = self.cfg, self.mission.state
        checkpoint = msgspec.msgpack.decode(self._checkpoint, type=Checkpoint)
        parts = take_over(cfg, checkpoint, TakenOver(before.points.done, before.points.skipped, checkpoint.elapsed_s))
        truth, pose = self.robot.world.plant, checkpoint.pose
        self.first_moves_m.append(hypot(truth.x_m - pose.x_m, truth.y_m - pose.y_m) / checkpoint.sigmas(cfg.limits)[0])
        self.pipeline.localizer = parts.localizer
        self.pipeline.mission = parts.mission
        self.pipeline.gate = parts.gate
        self.pipeline.sent = SentDrives(cfg.robot, self.robot.frame_s)
