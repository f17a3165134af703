"""Glue. One measurement at a time: laser system, localizer, store, mission."""

import asyncio
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

from ccatp.config.models import MissionConfig
from ccatp.etalon_client import EtalonClient, EtalonError
from ccatp.localization.fixes import FixGated, FixRefused
from ccatp.localizer import Localizer
from ccatp.mission import Mission
from ccatp.processes.telling import Teller
from ccatp.samples import DeckPose, Fix, PointId, Vector3
from ccatp.store import MissionStore, StoreError
from ccatp.surveying.approaches import Approaches

# A commit takes milliseconds, on a busy disk a second. One that takes longer is told, and much longer holds the robot.
SLOW_DISK_S = 2.0
STALLED_DISK_S = 30.0


@dataclass(frozen=True, slots=True)
class Request:
    """One measurement wanted: of a point, or (``None``) to find the robot again; ``number`` is the mission's."""

    number: int
    t_s: float
    point: PointId | None
    expected_m: Vector3
    estimate: DeckPose


class MeasuringDesk:
    """Takes the measurements that the mission orders.

    Args:
        cfg: how near the robot has to come, and how often it may try.
        client: the laser system's client.
        localizer: takes the fix.
        mission: is told the result.
        store: keeps it; a point counts only when it is committed.
        teller: tells the others.
        on_over: called after each measurement, good or bad.
    """

    def __init__(
        self,
        cfg: MissionConfig,
        client: EtalonClient,
        localizer: Localizer,
        mission: Mission,
        store: MissionStore,
        teller: Teller,
        on_over: Callable[[], None],
    ) -> None:
        """Nothing is wanted yet."""
        self._tolerance_m = cfg.arrival_tolerance_m
        self._approaches = Approaches(cfg.correction_tolerance_m, cfg.max_approaches)
        self._client, self._localizer, self._mission = client, localizer, mission
        self._store, self._teller, self._on_over = store, teller, on_over
        self._timeout_s = cfg.measure_timeout_s
        self._wanted: Request | None = None
        self._wakes = asyncio.Event()
        self.is_busy = False
        self.arrival_error_m = 0.0  # distance of the last fix from its point

    def begin(self, request: Request) -> None:
        """Take a measurement; ``is_busy`` until it is over. One that is under way is finished first, for nothing."""
        self.is_busy = True
        self._wanted = request
        self._wakes.set()

    async def run(self) -> None:
        """Serve requests for ever."""
        while True:
            await self._wakes.wait()
            self._wakes.clear()
            request, self._wanted = self._wanted, None
            if request is not None:
                await self._serve(request)
            if self._wanted is None:
                self.is_busy = False
                self._on_over()

    def _is_wanted(self, request: Request) -> bool:
        """A pause or an edge in between means that the robot may have moved: the lengths are worth nothing then."""
        return self._mission.is_awaiting_fix and self._mission.request == request.number

    async def _serve(self, request: Request) -> None:
        try:
            async with asyncio.timeout(self._timeout_s):
                fix = await self._client.measure(request.t_s, request.expected_m)
        except (EtalonError, TimeoutError) as error:
            why = str(error) or f"no fix within {self._timeout_s:g} s"
            self._teller.say("warning", f"measurement of {_name(request.point)} failed: {why}")
            if self._is_wanted(request):
                await self._skip(request, why)
            return
        if self._is_wanted(request):
            await self._accept(request, fix)
        else:
            self._teller.say("info", f"measurement of {_name(request.point)} discarded: the robot was interrupted")

    async def _skip(self, request: Request, cause: str) -> None:
        if request.point is not None:
            try:
                await self._stored(self._store.record_skipped(request.point, request.t_s), request.point)
            except StoreError as error:
                self._mission.fault(f"that {_name(request.point)} is skipped cannot be stored: {error}")
                return
        self._mission.not_fixed(request.point, cause)

    async def _accept(self, request: Request, fix: Fix) -> None:
        try:
            jump_m = self._localizer.fuse_fix(fix)
        except FixGated as refusal:
            # Measured again: a wrong fix will not repeat itself, and a wrong estimate gives way to three that agree.
            self._teller.fix(request.point, fix, 0.0, is_fused=False)
            self._teller.say("warning", f"the fix at {_name(request.point)} is doubted: {refusal}; measuring again")
            self._wanted = request
            self._wakes.set()
            return
        except FixRefused as refusal:
            self._teller.fix(request.point, fix, 0.0, is_fused=False)
            self._teller.say("warning", f"the fix at {_name(request.point)} is refused: {refusal}")
            await self._skip(request, str(refusal))
            return
        self._teller.fix(request.point, fix, jump_m, is_fused=True)
        for notice in self._localizer.notices:
            self._teller.say("warning", notice)
        self._localizer.notices.clear()
        if jump_m > self._tolerance_m:
            self._teller.say(
                "warning", f"the fix at {_name(request.point)} moved the estimate by {1e3 * jump_m:.1f} mm"
            )
        if request.point is not None:
            self.arrival_error_m = self._mission.survey.distance_m(self._localizer.pose)
            if self._is_too_far(request.point):
                self._mission.again()
                return
            try:
                await self._stored(self._store.record_fix(request.point, fix, request.estimate), request.point)
            except StoreError as error:
                self._mission.fault(f"the fix of {_name(request.point)} cannot be stored: {error}")
                return
        self._mission.fixed(request.point)

    async def _stored(self, commit: "Future[Any]", point: PointId) -> None:
        """Wait for a commit. On a disk that stalls the robot stands here, and after a while is held for an operator.

        Raises:
            StoreError: it will not be committed.
        """
        waiting = asyncio.wrap_future(commit)
        try:
            await asyncio.wait([waiting], timeout=SLOW_DISK_S)
            if not waiting.done():
                self._teller.say("warning", f"the disk is slow: {_name(point)} waits for its commit")
                await asyncio.wait([waiting], timeout=STALLED_DISK_S - SLOW_DISK_S)
            if not waiting.done():
                self._mission.fault(f"the disk stalls: {_name(point)} is not stored after {STALLED_DISK_S:g} s")
                self._on_over()
            await waiting
        finally:
            waiting.cancel()

    def _is_too_far(self, point: PointId) -> bool:
        """Whether the point has to be approached again: what was measured there is not its alignment."""
        is_too_far = self._approaches.is_too_far(point, self.arrival_error_m)
        what = f"{1e3 * self.arrival_error_m:.1f} mm from {_name(point)}"
        if is_too_far:
            self._teller.say("info", f"{what}: approaching it again")
        elif self.arrival_error_m > self._tolerance_m:
            self._teller.say(
                "warning", f"{what} after {self._approaches.count} approaches: measured there all the same"
            )
        return is_too_far


def _name(point: PointId | None) -> str:
    return "the robot's place" if point is None else f"point {point.row}-{point.col}-{point.point}"
