"""Takes one measurement at a time: laser system, fix gate, localizer, store, mission."""

import asyncio
from concurrent.futures import Future
from dataclasses import asdict, dataclass
from math import inf
from typing import Any, Protocol

from ccatp.conditions import text_of
from ccatp.conditions.mission import (
    DISK_STALLS,
    FIX_NOT_STORED,
    LASER_NOT_READY,
    METROLOGY_UNRELIABLE,
    SKIP_NOT_STORED,
)
from ccatp.core import NO_CAUSE, UNRELIABLE, Cause, DeckPose, Fix, PointId, Vector3
from ccatp.etalon_client import BadSolution, EtalonClient, EtalonError
from ccatp.links.bus import Telemetry
from ccatp.links.topics import FixMessage
from ccatp.records.store import AlreadyMeasuredError, MissionStore, StoreError
from ccatp.survey.composition import SurveyParts
from ccatp.survey.events import Fault, FixFailed, FixStored, PointMissed
from ccatp.survey.fix_gate import ApproachCounter
from ccatp.survey.fix_review import REPEATS

# A commit takes milliseconds, or a second on a busy disk. After these times it is reported, then holds the robot.
SLOW_DISK_S = 2.0
STALLED_DISK_S = 30.0
# Periods of the requests whether the lasers are warm, and of the reports that they are not.
LASER_PERIOD_S, LASER_REPORT_S = 1.0, 60.0


class LaserUnusable(EtalonError):
    """The laser system measures in another frame or unit, or its fixes stay at one place while the robot moves."""

    def __init__(self, cause: Cause) -> None:
        super().__init__(text_of(cause))
        self.cause = cause


@dataclass(frozen=True, slots=True)
class FixRequest:
    """One measurement: of a point, or (``None``) to localize the robot; ``number``: of the mission's request."""

    number: int
    t_s: float
    point: PointId | None
    expected_m: Vector3
    estimate: DeckPose


class FixHost(Protocol):
    """What the service needs of the main loop."""

    @property
    def is_lockstep(self) -> bool:
        """Simulated time stands still during a measurement."""

    def release_time(self) -> None:
        """A measurement is over, successful or not."""


class FixService:
    """Takes the measurements that the mission requests; a point counts only when its fix is committed."""

    def __init__(
        self,
        client: EtalonClient,
        parts: SurveyParts,
        store: MissionStore,
        telemetry: Telemetry,
        host: FixHost,
    ) -> None:
        mission, etalon = parts.cfg.mission, parts.cfg.etalon
        self._client = client
        self._review = parts.fix_review
        self._localizer = parts.localizer
        self._mission = parts.mission
        self._heading_sigma_of = parts.heading_sigma_rad
        self._store = store
        self._telemetry = telemetry
        self._notify = telemetry.notify_operator
        self._host = host
        self._tolerance_m = mission.arrival_tolerance_m
        self._approaches = ApproachCounter(mission.correction_tolerance_m, mission.max_approaches)
        self._timeout_s = mission.measure_timeout_s
        self._measuring_time_s = etalon.measuring_time_s
        self._alarm_points = etalon.alarm_points
        self._unreliable = 0
        self._wanted: FixRequest | None = None
        self._wakes = asyncio.Event()
        self.is_busy = False  # from ``begin`` to the end of the measurement
        self.arrival_error_m = 0.0  # distance of the last fix from its point
        self.metrology_cause = NO_CAUSE  # why the last points are no measurements
        self.wait_cause = NO_CAUSE  # what the measurement waits for

    def begin(self, request: FixRequest) -> None:
        """Take a measurement; one in progress is finished first, and its result is dropped."""
        self.is_busy = True
        self._wanted = request
        self._wakes.set()

    async def run(self) -> None:
        """Serve requests until cancelled."""
        while True:
            await self._wakes.wait()
            self._wakes.clear()
            request, self._wanted = self._wanted, None
            if request is not None:
                await self._serve(request)
            if self._wanted is None:
                self.is_busy = False
                self._host.release_time()

    def _is_wanted(self, request: FixRequest) -> bool:
        """Whether the mission still waits for it; not after a pause or an edge, because the robot may have moved."""
        state = self._mission.state
        return state.is_awaiting_fix and state.request == request.number

    async def _serve(self, request: FixRequest) -> None:
        """Measure, and repeat a doubtful fix, within the time limit of a point."""
        self._review.begin()
        try:
            await self._await_laser(request)
            async with asyncio.timeout(self._timeout_s):
                fix, doubt = await self._measure(request)
                for _ in range(REPEATS):
                    if doubt and self._is_wanted(request):
                        # New lengths take a measuring time; in lockstep simulated time stands still meanwhile.
                        await asyncio.sleep(0.0 if self._host.is_lockstep else self._measuring_time_s)
                        fix, doubt = await self._measure(request)
        except (EtalonError, TimeoutError) as error:
            await self._fail(request, str(error) or f"no fix within {self._timeout_s:g} s", error)
            return
        if not self._is_wanted(request):
            self._notify("info", f"measurement of {_name(request.point)} discarded: the robot was interrupted")
        elif doubt:
            await self._fail(request, doubt, None)
        else:
            await self._store_fix(request, fix)

    async def _await_laser(self, request: FixRequest) -> None:
        """Wait until the lasers are warm or the fix is not wanted any more; report this at once and each minute."""
        clock, reported_s = asyncio.get_running_loop().time, -inf
        try:
            while self._is_wanted(request) and not await self._client.is_laser_ready():
                self.wait_cause = LASER_NOT_READY.cause()
                if clock() - reported_s >= LASER_REPORT_S:
                    reported_s = clock()
                    self._notify("warning", f"measurement of {_name(request.point)} waits: {LASER_NOT_READY.message}")
                await asyncio.sleep(LASER_PERIOD_S)
        finally:
            self.wait_cause = NO_CAUSE

    async def _measure(self, request: FixRequest) -> tuple[Fix, str]:
        """Measure a fix, and fuse it if it is still wanted; returns it, and why it is doubted or an empty text."""
        fix = await self._client.measure(request.t_s, request.expected_m)
        for warning in fix.warnings:
            self._notify("warning", f"{_name(request.point)}: {warning}")
        return fix, self._fuse(request, fix) if self._is_wanted(request) else ""

    def _fuse(self, request: FixRequest, fix: Fix) -> str:
        """Fuse a fix unless it is doubted; returns the reason, or an empty text."""
        localizer, is_lost = self._localizer, self._mission.state.is_lost
        found = self._review.take(localizer, fix, request.expected_m, request.estimate, is_lost=is_lost)
        doubt, jump_m = found.doubt, found.jump_m
        message = FixMessage(
            seq=self._telemetry.seq,
            point=None if request.point is None else (*request.point,),
            is_fused=not doubt,
            jump_mm=1e3 * jump_m,
            is_set_aside=found.is_set_aside,
            **asdict(fix),
        )
        self._telemetry.send("fix", message)
        if found.refusal:
            raise LaserUnusable(found.refusal)
        if doubt:
            self._notify("info", f"the fix at {_name(request.point)} is not used: {doubt}")
            return doubt
        for notice in localizer.notices:
            self._notify("warning", notice)
        localizer.notices.clear()
        if jump_m > self._tolerance_m:
            self._notify("warning", f"the fix at {_name(request.point)} moved the estimate by {1e3 * jump_m:.1f} mm")
        return ""

    async def _fail(self, request: FixRequest, why: str, error: Exception | None) -> None:
        if isinstance(error, BadSolution):
            refusal = self._review.refusal_of(error.lengths_m, request.expected_m)
            error = LaserUnusable(refusal) if refusal else error
        if isinstance(error, LaserUnusable):
            self._notify("error", str(error))
            if self._is_wanted(request):
                self._mission.handle(Fault(error.cause))
            return
        self._notify("warning", f"measurement of {_name(request.point)} failed: {why}")
        if self._is_wanted(request):
            await self._skip(request, why)

    async def _skip(self, request: FixRequest, cause: str) -> None:
        if request.point is not None:
            try:
                await self._await_commit(self._store.record_skipped(request.point, request.t_s), request.point)
            except StoreError as error:
                self._mission.handle(Fault(SKIP_NOT_STORED.cause(point=_name(request.point), why=error)))
                return
        self._mission.handle(FixFailed(request.point, cause, self._heading_sigma_of()))

    async def _store_fix(self, request: FixRequest, fix: Fix) -> None:
        """Store a fused fix if the robot is near enough to the point."""
        if request.point is not None:
            mission = self._mission
            self.arrival_error_m = mission.survey.follower.distance_m(mission.state.stop, self._localizer.pose)
            if self._is_too_far(request.point):
                mission.handle(PointMissed())
                return
            try:
                await self._await_commit(self._store.record_fix(request.point, fix, request.estimate), request.point)
            except AlreadyMeasuredError as error:
                self._notify("warning", str(error))  # the point is stored already
            except StoreError as error:
                mission.handle(Fault(FIX_NOT_STORED.cause(point=_name(request.point), why=error)))
                return
            self._note_metrology(fix)
        self._mission.handle(FixStored(request.point, self._heading_sigma_of()))

    def _note_metrology(self, fix: Fix) -> None:
        """Count the points in a row that are no measurements; enough of them are an alarm, and never hold the robot."""
        self._unreliable = self._unreliable + 1 if fix.metrology == UNRELIABLE else 0
        self.metrology_cause = NO_CAUSE
        if self._unreliable >= self._alarm_points:
            who = " ".join(map(str, fix.suspects))
            self.metrology_cause = METROLOGY_UNRELIABLE.cause(count=self._unreliable, channels=who)
        if self._unreliable == self._alarm_points:
            self._notify("warning", text_of(self.metrology_cause))

    async def _await_commit(self, commit: "Future[Any]", point: PointId) -> None:
        """Wait for a commit while the robot stands; after ``STALLED_DISK_S`` it is a fault. StoreError: it failed."""
        waiting = asyncio.wrap_future(commit)
        try:
            await asyncio.wait([waiting], timeout=SLOW_DISK_S)
            if not waiting.done():
                self._notify("warning", f"the disk is slow: {_name(point)} waits for its commit")
                await asyncio.wait([waiting], timeout=STALLED_DISK_S - SLOW_DISK_S)
            if not waiting.done():
                self._mission.handle(Fault(DISK_STALLS.cause(point=_name(point), time_s=STALLED_DISK_S)))
                self._host.release_time()
            await waiting
        finally:
            waiting.cancel()

    def _is_too_far(self, point: PointId) -> bool:
        """Whether the point has to be approached again, because the robot stands too far from it."""
        is_too_far = self._approaches.is_too_far(point, self.arrival_error_m, self._localizer.position_sigma_m)
        what = f"{1e3 * self.arrival_error_m:.2f} mm from {_name(point)}"
        if is_too_far:
            self._notify("info", f"{what}: approaching it again")
        elif self.arrival_error_m > self._tolerance_m:
            self._notify("warning", f"{what} after {self._approaches.count} approaches: measured there all the same")
        return is_too_far


def _name(point: PointId | None) -> str:
    return "the robot's place" if point is None else f"point {point.row}-{point.col}-{point.point}"
