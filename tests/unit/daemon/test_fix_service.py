"""The fix service and a localizer that refuses."""

import asyncio
from concurrent.futures import Future
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from ccatp.config.models import Config
from ccatp.core import DeckPose, Fix, PointId
from ccatp.daemon.fix_service import FixRequest, FixService
from ccatp.daemon.telemetry import SurveyTelemetry
from ccatp.estimation.fixes import FixGated, FixRefused
from ccatp.etalon_client import EtalonClient
from ccatp.localizer import Localizer
from ccatp.records.store import AlreadyMeasuredError, MissionStore
from ccatp.survey.fix_gate import FixFinding, FixGate
from ccatp.survey.mission import Mission

FIX = Fix(1.0, (0.0, 0.0, 0.0), (0.0,) * 9, 1.0, (1,), 0.0)


class Refusing:
    """A localizer that says the given things in turn and then takes the fix."""

    def __init__(self, *refusals: Exception) -> None:
        self.refusals = list(refusals)
        self.notices: list[str] = []
        self.pose_covariance = np.eye(3)
        self.position_sigma_m = 5e-6

    def fuse_fix(self, fix: Fix) -> float:
        if self.refusals:
            raise self.refusals.pop(0)
        return 0.0


async def measured_once(
    config: Config, localizer: Refusing, mission: object, store: object, telemetry: object, point: PointId | None
) -> None:
    """One request to a service whose laser system always answers, until it is over."""

    async def measure(t_s: float, expected_m: Any) -> Fix:
        return FIX

    over = asyncio.Event()
    service = FixService(
        config.mission,
        cast(EtalonClient, SimpleNamespace(measure=measure)),
        cast(FixGate, SimpleNamespace(begin=lambda: None, review=lambda *_, **__: FixFinding())),
        cast(Localizer, localizer),
        cast(Mission, mission),
        cast(MissionStore, store),
        cast(SurveyTelemetry, telemetry),
        over.set,
        lambda: 0.0,
    )
    serving = asyncio.get_running_loop().create_task(service.run())
    service.begin(FixRequest(1, 1.0, point, (0.0, 0.0, 0.0), DeckPose(0.0, 0.0, 0.0)))
    async with asyncio.timeout(10.0):
        await over.wait()
    serving.cancel()


async def published_fixes(config: Config, *refusals: Exception) -> list[tuple[bool, bool]]:
    told: list[tuple[bool, bool]] = []

    def fix(point: Any, fix: Fix, jump_m: float, *, is_fused: bool, is_set_aside: bool) -> None:
        told.append((is_fused, is_set_aside))

    mission = SimpleNamespace(
        is_awaiting_fix=True, request=1, is_lost=True, fixed=lambda point: None, not_fixed=lambda point, cause: None
    )
    telemetry = SimpleNamespace(publish_fix=fix, notify_operator=lambda level, text: None)
    await measured_once(config, Refusing(*refusals), mission, SimpleNamespace(), telemetry, None)
    return told


@pytest.mark.parametrize(
    ("refusals", "told"),
    [([], [True]), ([FixGated("far")], [False, True]), ([FixRefused("too old")] * 4, [False] * 3)],
)
async def test_every_fix_that_the_localizer_saw_is_told(
    refusals: list[Exception], told: list[bool], config: Config
) -> None:
    assert await published_fixes(config, *refusals) == [(is_fused, False) for is_fused in told]


async def test_a_point_that_is_measured_already_is_done_and_needs_no_operator(config: Config) -> None:
    point, done, said = PointId(1, 2, 4), list[PointId](), list[str]()
    mission = SimpleNamespace(
        is_awaiting_fix=True, request=1, is_lost=False, fixed=done.append, fault=said.append,
        survey=SimpleNamespace(distance_m=lambda pose: 0.0),
    )  # fmt: skip
    refused: Future[None] = Future()
    refused.set_exception(AlreadyMeasuredError("point 1/2/4 has been measured; its fix is not replaced"))
    localizer = Refusing()
    localizer.pose = None  # type: ignore[attr-defined]
    telemetry = SimpleNamespace(
        publish_fix=lambda *_, **__: None, notify_operator=lambda level, text: said.append(level)
    )
    await measured_once(config, localizer, mission, SimpleNamespace(record_fix=lambda *_: refused), telemetry, point)
    assert (done, said) == ([point], ["warning"])
