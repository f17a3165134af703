"""Glue. One measurement at a time: laser system, localizer, store, mission."""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass

from ccatp.etalon_client import EtalonClient, EtalonError
from ccatp.localization.fixes import FixRefused
from ccatp.localizer import Localizer
from ccatp.mission import Mission
from ccatp.processes.telling import Teller
from ccatp.samples import DeckPose, Fix, PointId, Vector3
from ccatp.store import MissionStore, StoreError

# A fix that moves the estimate by more than this is worth a line to the operator: an arrival must be within 10 mm.
NOTABLE_JUMP_M = 0.010


@dataclass(frozen=True, slots=True)
class Request:
    """One measurement wanted: of a point, or (``None``) to find the robot again."""

    t_s: float
    point: PointId | None
    expected_m: Vector3
    estimate: DeckPose


class MeasuringDesk:
    """Takes the measurements that the mission orders.

    Args:
        client: the laser system's client.
        localizer: takes the fix.
        mission: is told the result.
        store: keeps it; a point counts only when it is committed.
        teller: tells the others.
        on_over: called after each measurement, good or bad.
    """

    def __init__(
        self,
        client: EtalonClient,
        localizer: Localizer,
        mission: Mission,
        store: MissionStore,
        teller: Teller,
        on_over: Callable[[], None],
    ) -> None:
        """Nothing is wanted yet."""
        self._client, self._localizer, self._mission = client, localizer, mission
        self._store, self._teller, self._on_over = store, teller, on_over
        self._requests: asyncio.Queue[Request] = asyncio.Queue(maxsize=1)
        self.is_busy = False
        self.arrival_error_m = 0.0  # distance of the last fix from its point

    def begin(self, request: Request) -> None:
        """Take a measurement; ``is_busy`` until it is over."""
        self.is_busy = True
        self._requests.put_nowait(request)

    async def run(self) -> None:
        """Serve requests for ever."""
        while True:
            request = await self._requests.get()
            try:
                await self._serve(request)
            finally:
                self.is_busy = False
            self._on_over()

    async def _serve(self, request: Request) -> None:
        try:
            fix = await self._client.measure(request.t_s, request.expected_m)
        except EtalonError as error:
            self._teller.say("warning", f"measurement of {_name(request.point)} failed: {error}")
            if self._mission.is_awaiting_fix:
                await self._skip(request, str(error))
            return
        # A pause or an edge in between means that the robot may have moved: the lengths are worth nothing then.
        if not self._mission.is_awaiting_fix or self._mission.measuring_point != request.point:
            self._teller.say("info", f"measurement of {_name(request.point)} discarded: the robot was interrupted")
            return
        await self._accept(request, fix)

    async def _skip(self, request: Request, cause: str) -> None:
        if request.point is not None:
            try:
                await asyncio.wrap_future(self._store.record_skipped(request.point, request.t_s))
            except StoreError as error:
                self._mission.fault(f"that {_name(request.point)} is skipped cannot be stored: {error}")
                return
        self._mission.not_fixed(request.point, cause)

    async def _accept(self, request: Request, fix: Fix) -> None:
        if request.point is not None:
            try:
                await asyncio.wrap_future(self._store.record_fix(request.point, fix, request.estimate))
            except StoreError as error:
                self._mission.fault(f"the fix of {_name(request.point)} cannot be stored: {error}")
                return
        try:
            jump_m = self._localizer.fuse_fix(fix)
        except FixRefused as refusal:
            self._teller.say("warning", f"the fix at {_name(request.point)} is stored but not used: {refusal}")
            jump_m = 0.0
        if jump_m > NOTABLE_JUMP_M:
            self._teller.say(
                "warning", f"the fix at {_name(request.point)} moved the estimate by {1e3 * jump_m:.1f} mm"
            )
        if request.point is not None:
            self.arrival_error_m = self._mission.survey.distance_m(self._localizer.pose)
            self._teller.fix(request.point, fix, jump_m)
        self._mission.fixed(request.point)


def _name(point: PointId | None) -> str:
    return "the retreat" if point is None else f"point {point.row}-{point.col}-{point.point}"
