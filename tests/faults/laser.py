"""Missions in process with the daemon's own measuring desk, its store, and a laser system that does as a test says."""

import asyncio
from collections.abc import Callable
from concurrent.futures import Future, wait
from pathlib import Path
from types import SimpleNamespace
from typing import Any, TypeVar, cast

import numpy as np

from ccatp.config.models import Config
from ccatp.core import Fix, PointId, Vector3
from ccatp.daemon.fix_service import FixRequest, FixService
from ccatp.daemon.telemetry import SurveyTelemetry
from ccatp.estimation.fixes import FixRefused, deck_foot
from ccatp.etalon_client import BadSolution, EtalonClient, EtalonError
from ccatp.links.robot_messages import Sensors
from ccatp.mirror.multilateration import MultilaterationError
from ccatp.records.store import MissionStore
from ccatp.records.store_rows import PlannedPoint
from ccatp.sim.fault_plan import FaultPlan, parse_plan
from ccatp.studies.faults_study import FaultySilRun
from ccatp.survey.fix_gate import FixGate, nis_of
from tests.support.virtual_time import VirtualLoop

T = TypeVar("T")
FULL = (1.0, 1.0)


class PatientStore:
    """A store whose caller waits for the commit: virtual time must not pass while a disk turns."""

    def __init__(self, store: MissionStore) -> None:
        self._store = store

    def record_fix(self, *args: Any) -> "Future[int]":
        return self._waited(self._store.record_fix(*args))

    def record_skipped(self, *args: Any) -> "Future[None]":
        return self._waited(self._store.record_skipped(*args))

    @staticmethod
    def _waited(commit: "Future[T]") -> "Future[T]":
        wait([commit])
        return commit


def patient(store: MissionStore) -> MissionStore:
    return cast(MissionStore, PatientStore(store))


class Measured:
    """One request to the laser system: what the robot knew, what it was told, what was wrong with that."""

    def __init__(self, number: int, t_s: float, point: PointId | None) -> None:
        self.number, self.t_s, self.point = number, t_s, point
        self.offset_m = 0.0
        self.nis = float("nan")
        self.is_fused = False


# Called with a request and the true fix; returns the fix that is given, or raises.
Laser = Callable[[Measured, Fix], Fix]


def honest(_measured: Measured, fix: Fix) -> Fix:
    return fix


def moved(fix: Fix, offset_m: Vector3) -> Fix:
    x, y, z = (a + b for a, b in zip(fix.position_m, offset_m, strict=True))
    return Fix(fix.t_s, (x, y, z), fix.covariance_m2, fix.dop, fix.channels, fix.residual_rms_m)


class DeskRehearsal(FaultySilRun):
    """A rehearsal that measures as the main loop does: desk, scrutiny, store.

    Attributes:
        asked: every request to the laser system.
        said: lines for the operator.
        fans: duties that were commanded, with their time.
    """

    def __init__(self, cfg: Config, folder: Path, laser: Laser = honest, plan: FaultPlan | None = None) -> None:
        super().__init__(cfg, plan or parse_plan("", "no faults"))
        self.asked: list[Measured] = []
        self.said: list[str] = []
        self.fans: list[tuple[float, tuple[float, float]]] = []
        self._scripted, self._folder = laser, folder

    def run(self) -> Any:
        points = [PlannedPoint(point, 0.0, 0.0) for point in self.parts.points]
        path = self._folder / "mission.sqlite"
        name = self.mirror.name
        with (
            asyncio.Runner(loop_factory=VirtualLoop) as runner,
            MissionStore.create(path, mirror=name, seed=1, config_toml="", points=points) as store,
        ):
            self._runner, self.store = runner, store
            self._over = asyncio.Event()
            teller = SimpleNamespace(
                publish_fix=self._note_fix, notify_operator=lambda level, text: self.said.append(f"{level}: {text}")
            )
            self.desk = FixService(
                self.cfg.mission,
                cast(EtalonClient, SimpleNamespace(measure=self._ask)),
                FixGate(self.mirror, self.cfg),
                self.localizer,
                self.mission,
                patient(store),
                cast(SurveyTelemetry, teller),
                self._over.set,
                lambda: 0.5,
            )
            result = super().run()
            self.stored = [(row.point, row.status) for row in store.points()]
            self.all_fixes = store.fixes(history=True)
            return result

    def _serve(self, frame: Sensors, dt_s: float) -> None:
        self.look(frame)
        super()._serve(frame, dt_s)
        if self.mission.wants_full_fans and not self.fans:
            self.fans.append((frame.t, FULL))
            self.robot.command_fans(2, *FULL)

    def look(self, frame: Sensors) -> None:
        """Before each frame; for tests to interfere."""

    def _measure(self, frame: Sensors) -> None:
        mission, pose = self.mission, self.localizer.deck_pose
        expected = self.mirror.puck_world(pose, self.cfg.robot.puck_height_m)
        request = FixRequest(mission.request, frame.t, mission.measuring_point, expected, pose)
        self._request = request
        self._runner.run(self._one(request))

    async def _one(self, request: FixRequest) -> None:
        self._over.clear()
        serving = asyncio.get_running_loop().create_task(self.desk.run())
        self.desk.begin(request)
        over = asyncio.get_running_loop().create_task(self._over.wait())
        await asyncio.wait([serving, over], return_when=asyncio.FIRST_COMPLETED)
        if serving.done():
            over.cancel()
            serving.result()  # raises what ended it
        serving.cancel()
        await asyncio.wait([serving, over])

    async def _ask(self, t_s: float, expected_m: Vector3) -> Fix:
        measured = Measured(len(self.asked), t_s, self._request.point)
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

    def _note_fix(
        self, _point: PointId | None, _fix: Fix, _jump_m: float, *, is_fused: bool, is_set_aside: bool
    ) -> None:
        del is_set_aside
        self.asked[-1].is_fused = is_fused


def failing(_measured: Measured, _fix: Fix) -> Fix:
    raise EtalonError("no reply")
