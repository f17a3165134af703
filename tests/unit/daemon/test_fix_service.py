"""The fix service: a localizer that refuses, a point that is measured already."""

import asyncio
from collections.abc import Callable
from concurrent.futures import Future
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ccatp.conditions import LASER_NOT_READY
from ccatp.config.models import Config
from ccatp.core import DeckPose, Fix, PointId
from ccatp.daemon.fix_service import FixRequest
from ccatp.estimation.fixes import FixGated, FixRefused
from ccatp.links.topics import FixMessage
from ccatp.records.store import AlreadyMeasuredError
from ccatp.survey.events import FixStored, SurveyInput
from tests.support.sim_survey import fix_service

POINT = PointId(1, 2, 4)


async def measured_once(
    config: Config,
    refusals: list[Exception],
    store: Any,
    point: PointId | None,
    handle: Callable[[SurveyInput], object],
    not_ready: int = 0,
) -> tuple[list[FixMessage], list[str]]:
    """One request, with a laser system that always answers: the fixes, and texts of warnings or levels of messages."""
    told, levels, over = list[FixMessage](), list[str](), asyncio.Event()

    async def measure(_t_s: float, _expected_m: Any) -> Fix:
        return Fix(1.0, (0.0, 0.0, 0.0), (0.0,) * 9, 1.0, (1,), 0.0)

    def fuse_fix(_fix: Fix) -> float:
        if refusals:
            raise refusals.pop(0)
        return 0.0

    service = fix_service(
        config,
        measure,
        store,
        SimpleNamespace(
            state=SimpleNamespace(is_awaiting_fix=True, request=1, is_lost=point is None, stop=None),
            survey=SimpleNamespace(follower=SimpleNamespace(distance_m=lambda _stop, _pose: 0.0)),
            handle=handle,
        ),
        localizer=SimpleNamespace(
            fuse_fix=fuse_fix, notices=[], pose=None, pose_covariance=np.eye(3), position_sigma_m=5e-6
        ),
        on_finished=over.set,
        publish=lambda _topic, message: told.append(message),
        notify=lambda level, text: levels.append(level if level != "warning" else text),
        not_ready=not_ready,
    )
    serving = asyncio.get_running_loop().create_task(service.run())
    service.begin(FixRequest(1, 1.0, point, (0.0, 0.0, 0.0), DeckPose(0.0, 0.0, 0.0)))
    async with asyncio.timeout(10.0):
        await over.wait()
    serving.cancel()
    return told, levels


@pytest.mark.parametrize(
    ("refusals", "are_fused"),
    [([], [True]), ([FixGated("far")], [False, True]), ([FixRefused("too old")] * 4, [False] * 3)],
)
async def test_every_fix_that_the_localizer_saw_is_told(
    refusals: list[Exception], are_fused: list[bool], config: Config
) -> None:
    told, _ = await measured_once(config, refusals.copy(), None, None, lambda _event: None)
    assert [(fix.point, fix.is_fused, fix.is_set_aside) for fix in told] == [(None, one, False) for one in are_fused]


async def test_a_point_that_is_measured_already_is_done_and_needs_no_operator(config: Config) -> None:
    events = list[SurveyInput]()
    refused: Future[None] = Future()
    refused.set_exception(AlreadyMeasuredError("point 1/2/4 has been measured; its fix is not replaced"))
    store = SimpleNamespace(record_fix=lambda *_: refused)
    told, levels = await measured_once(config, [], store, POINT, events.append)
    assert (events, levels, [fix.point for fix in told]) == (
        [FixStored(POINT, 0.0)],
        ["point 1/2/4 has been measured; its fix is not replaced"],
        [(1, 2, 4)],
    )


async def test_a_laser_that_is_not_ready_is_waited_for_and_reported_once(
    config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ccatp.daemon.fix_service.LASER_PERIOD_S", 0.0)
    told, levels = await measured_once(config, [], None, None, lambda _event: None, not_ready=3)
    assert [fix.is_fused for fix in told] == [True]
    assert levels == [f"measurement of the robot's place waits: {LASER_NOT_READY.message}"]
