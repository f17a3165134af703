"""Sessions at the robot: resets, refusals, lateness of frames; fixes that are refused or measured already."""

import asyncio
from collections.abc import Callable, Coroutine
from concurrent.futures import Future
from math import sin
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from ccatp.conditions.mission import LASER_NOT_READY
from ccatp.config.load import load_config
from ccatp.config.models import Config
from ccatp.core import DeckPose, Fix, PointId
from ccatp.daemon.loops.fix_service import FixRequest
from ccatp.daemon.loops.frame_lateness import FrameAge, LatenessStatistics
from ccatp.daemon.loops.robot_session import FIRST_DELAY_S, LONGEST_DELAY_S, RobotSession, SessionHandler, delay_s
from ccatp.estimation.fixes import FixGated, FixRefused
from ccatp.links.robot_codec import RobotFrame, encode
from ccatp.links.robot_link import RobotTimeout
from ccatp.links.robot_messages import CommandEcho, Hello, Joined, Sensors
from ccatp.links.topics import FixMessage
from ccatp.records.store import AlreadyMeasuredError
from ccatp.survey.events import FixStored, SurveyInput
from tests.faults.linking import Measured
from tests.support.daemon import HELLO, Waiting
from tests.support.scenario import SurveyLoop
from tests.support.sim_survey import fix_service
from tests.support.sockets import scripted


def test_the_delay_grows_and_is_spread() -> None:
    assert [delay_s(n, 1.0) for n in (0, 1, 2)] == [0.05, 0.1, 0.2]
    assert delay_s(99, 1.0) == LONGEST_DELAY_S
    assert delay_s(99, 0.0) == 0.5 * LONGEST_DELAY_S
    assert delay_s(0, 0.0) == FIRST_DELAY_S


class Client(Waiting):
    """What a controller hears of its sessions."""

    def __init__(self, cfg: Config) -> None:
        handler = SessionHandler(self.on_sensors, self.on_joined, self.on_lost, on_restarted=self.on_restarted)
        self.session = RobotSession(cfg.robot, "controller", "test", handler)
        self.hellos: list[Hello] = []
        self.frames: list[int] = []
        self.losses: list[str] = []
        self.restarts: list[int] = []  # number of frames before each
        self.changed = asyncio.Event()

    def on_joined(self, hello: Hello) -> None:
        self.hellos.append(hello)

    def on_lost(self, reason: str) -> None:
        self.losses.append(reason)

    def on_restarted(self) -> None:
        self.restarts.append(len(self.frames))

    def on_sensors(self, sensors: Sensors, _line: bytes) -> None:
        self.frames.append(sensors.seq)
        self.changed.set()


async def with_robot(story: Callable[[Config, SurveyLoop], Coroutine[Any, Any, None]]) -> None:
    cfg = load_config(overrides={"robot.reconnect_timeout_s": 10.0})
    robot = SurveyLoop(cfg, lockstep=True)
    port = await robot.start()
    cfg = cfg.model_copy(update={"robot": cfg.robot.model_copy(update={"port": port})})
    try:
        await story(cfg, robot)
    finally:
        await robot.close()


@pytest.mark.fault("L1")
async def test_a_lost_session_is_followed_by_another_one_with_the_same_frame() -> None:
    async def story(cfg: Config, robot: SurveyLoop) -> None:
        client = Client(cfg)
        await client.session.join(is_patient=False)
        serving = asyncio.create_task(client.session.serve())
        await client.until(lambda: len(client.frames) == 1)
        for session in range(1, 4):
            robot._drop_all("reset")
            await client.until(lambda session=session: len(client.frames) == session + 1)  # type: ignore[misc]
        assert client.frames == [0, 0, 0, 0]  # nobody answered: time stood still
        assert len(client.losses) == 3
        assert len({hello.nonce for hello in client.hellos}) == 4
        client.session.drop("silent")
        await client.until(lambda: len(client.frames) == 5)
        assert client.losses[-1] == "silent"
        assert not client.restarts
        serving.cancel()
        client.session.leave()
        await asyncio.gather(serving, return_exceptions=True)

    await with_robot(story)


def line(seq: int, t_s: float) -> bytes:
    echo = CommandEcho(0, 0.0, 0.0, held=True)
    return encode(RobotFrame(seq, t_s, [], [], [], None, (0.5, 0.5), 1.0, echo, ()))


@pytest.mark.fault("L15")
@pytest.mark.parametrize(
    ("boot", "seq", "t_s", "restarts"),
    [
        (1, 500, 5.0, []),
        (1, 501, 5.01, []),
        (2, 501, 5.01, [2]),
        (1, 1, 0.01, [2]),
        (1, 499, 5.5, [2]),
        (1, 900, 4.0, [2]),
    ],
)
async def test_a_restart_shows_in_the_first_frame_of_a_session_also_with_the_same_boot_number(
    boot: int, seq: int, t_s: float, restarts: list[int], measured: Measured
) -> None:
    sessions = iter([(1, [line(499, 4.99), line(500, 5.0)]), (boot, [line(seq, t_s), line(seq + 1, t_s + 0.01)])])

    async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        number, frames = next(sessions)
        writer.write(encode(replace(HELLO, boot=number)))
        await reader.readline()
        writer.write(encode(Joined(role="controller", session=number)) + b"".join(frames))
        await writer.drain()
        if frames[0] == line(499, 4.99):
            return
        await reader.read()

    async with scripted(talk) as port:
        client = Client(load_config(overrides={"robot.port": port}))
        await client.session.join(is_patient=False)
        serving = asyncio.create_task(client.session.serve())
        await client.until(lambda: len(client.frames) == 4)
        serving.cancel()
        client.session.leave()
        await asyncio.gather(serving, return_exceptions=True)
    assert client.restarts == restarts
    measured("L15", max((count - 2 for count in client.restarts), default=0))


@pytest.mark.fault("L1")
async def test_a_robot_that_stays_away_ends_it() -> None:
    async def story(cfg: Config, robot: SurveyLoop) -> None:
        quick = cfg.model_copy(update={"robot": cfg.robot.model_copy(update={"reconnect_timeout_s": 0.3})})
        client = Client(quick)
        await client.session.join(is_patient=True)
        serving = asyncio.create_task(client.session.serve())
        await robot.close()
        with pytest.raises(RobotTimeout, match=r"did not come back within 0\.3 s: cannot reach the robot"):
            await serving

    await with_robot(story)


async def test_only_a_process_that_takes_over_tries_again_for_a_role_that_is_in_use() -> None:
    async def story(cfg: Config, robot: SurveyLoop) -> None:
        first, second = Client(cfg), Client(cfg)
        await first.session.join(is_patient=False)
        joining = asyncio.create_task(second.session.join(is_patient=True))
        async with asyncio.timeout(20.0):
            while not robot.counts["refused"]:  # noqa: ASYNC110 - the server has no event for it
                await asyncio.sleep(0.005)
        first.session.leave()
        await joining
        assert len(second.hellos) == 1
        second.session.leave()

    await with_robot(story)


@pytest.mark.fault("L1")
async def test_a_robot_that_lets_join_and_gives_no_frame_stays_away() -> None:
    """Each session ends at once: asked less and less often, and given up after as long as one that is not there."""
    joins = 0

    async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        nonlocal joins
        writer.write(encode(HELLO))
        await reader.readline()
        joins += 1
        writer.write(encode(Joined(role="controller", session=joins)))
        writer.close()

    async with await asyncio.start_server(talk, "127.0.0.1", 0) as server:
        port = server.sockets[0].getsockname()[1]
        client = Client(load_config(overrides={"robot.port": port, "robot.reconnect_timeout_s": 1.0}))
        await client.session.join(is_patient=False)
        with pytest.raises(
            RobotTimeout, match=r"did not come back within 1 s: it accepts the session and sends no valid frame"
        ):
            async with asyncio.timeout(20.0):
                await client.session.serve()
        client.session.leave()
    assert 2 <= joins <= 10
    assert not client.frames


def serve(lag: LatenessStatistics, late_s: dict[int, float], frames: int = 100, drift: float = 0.0) -> list[float]:
    """Frames of 100 Hz that come 3 ms after they were taken, some of them later."""
    return [lag.add(0.01 * k, 500.0 + (1.0 + drift) * 0.01 * k + 0.003 + late_s.get(k, 0.0)) for k in range(frames)]


@pytest.mark.parametrize(("late_s", "missed"), [({}, 0), ({20: 0.3, 21: 0.29, 22: 0.28, 40: 0.019, 60: 0.021}, 4)])
def test_lateness_is_measured_and_missed_deadlines_are_counted(late_s: dict[int, float], missed: int) -> None:
    lag = LatenessStatistics(0.02)
    # 0.1 ms a frame may be the drift of the clock, since the last one that was prompt.
    assert serve(lag, late_s) == pytest.approx([late_s.get(k, 0.0) for k in range(100)], abs=4e-4)
    assert lag.missed_deadlines == missed
    assert lag.worst_s == pytest.approx(max(late_s.values(), default=0.0), abs=2e-4)


def test_a_first_frame_that_was_late_is_soon_no_measure() -> None:
    lag = LatenessStatistics(0.02)
    serve(lag, {0: 1.0})
    assert lag.add(1.0, 501.003 + 0.03) == pytest.approx(0.03, abs=1e-3)


@pytest.mark.parametrize("drift", [-0.01, -0.002, 0.002, 0.01])
def test_clocks_may_drift_apart_by_a_hundredth(drift: float) -> None:
    assert max(serve(LatenessStatistics(0.02), {}, 50_000, drift)) == pytest.approx(0.0, abs=1e-6)
    # What the drift may have been since the frame before, 0.2 ms, is not known.
    assert serve(LatenessStatistics(0.02), {49_999: 0.1}, 50_000, drift)[-1] == pytest.approx(0.1, abs=3e-4)


def test_the_rate_of_a_clock_may_wander() -> None:
    lag, wall_s, worst_s = LatenessStatistics(0.02), 500.0, 0.0
    for k in range(60_000):
        wall_s += 0.01 * (1.0 + 0.01 * sin(2e-4 * k))
        worst_s = max(worst_s, lag.add(0.01 * k, wall_s))
    assert worst_s < 1e-6
    assert lag.add(600.0, wall_s + 0.01 + 0.06) == pytest.approx(0.06, abs=3e-4)


def test_the_age_of_frames_by_the_drives_that_they_echo() -> None:
    age = FrameAge()
    for k in range(
        3000
    ):  # each frame is 120 ms on its way, and echoes the drive that was sent 5 ms before it was taken
        age.add_drive(k, 10.0 + 0.01 * k)
        if k >= 12:
            assert age.largest_s(CommandEcho(k - 12, 0.005, 0.005, held=False), 10.005 + 0.01 * k) == pytest.approx(
                0.12
            )
    assert (
        age.largest_s(CommandEcho(2990, 0.3, 0.3, held=True), 40.1) == 0.0
    )  # ages say that it was received before it was sent
    # Of another process, of none, and of so long ago that its time is not known any more.
    assert [age.largest_s(CommandEcho(seq, 0.0, 0.0, held=True), 99.0) for seq in (9000, -1, 100)] == [0.0, 0.0, 0.0]


def test_a_clock_that_was_set_begins_anew() -> None:
    lag = LatenessStatistics(0.02)
    serve(lag, {})
    assert lag.add(0.5, 501.1) == 0.0  # backwards
    assert lag.add(0.51, 501.14) == pytest.approx(0.03, abs=1e-3)
    lag.reset()
    assert lag.add(0.52, 900.0) == 0.0
    assert lag.add(7000.0, 900.01) == 0.0  # forwards
    assert lag.add(7000.01, 900.05) == pytest.approx(0.03, abs=1e-3)


# -- the fix service ---------------------------------------------------------------------------------------------------

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
    reported, levels, over = list[FixMessage](), list[str](), asyncio.Event()

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
        publish=lambda _topic, message: reported.append(message),
        notify=lambda level, text: levels.append(level if level != "warning" else text),
        not_ready=not_ready,
    )
    serving = asyncio.get_running_loop().create_task(service.run())
    service.begin(FixRequest(1, 1.0, point, (0.0, 0.0, 0.0), DeckPose(0.0, 0.0, 0.0)))
    async with asyncio.timeout(10.0):
        await over.wait()
    serving.cancel()
    return reported, levels


@pytest.mark.parametrize(
    ("refusals", "are_fused"),
    [([], [True]), ([FixGated("far")], [False, True]), ([FixRefused("too old")] * 4, [False] * 3)],
)
async def test_every_fix_that_the_localizer_took_is_reported(
    refusals: list[Exception], are_fused: list[bool], config: Config
) -> None:
    reported, _ = await measured_once(config, refusals.copy(), None, None, lambda _event: None)
    assert [(fix.point, fix.is_fused, fix.is_set_aside) for fix in reported] == [
        (None, one, False) for one in are_fused
    ]


async def test_a_point_that_is_measured_already_is_done_and_needs_no_operator(config: Config) -> None:
    events = list[SurveyInput]()
    refused: Future[None] = Future()
    refused.set_exception(AlreadyMeasuredError("point 1/2/4 has been measured; its fix is not replaced"))
    store = SimpleNamespace(record_fix=lambda *_: refused)
    reported, levels = await measured_once(config, [], store, POINT, events.append)
    assert (events, levels, [fix.point for fix in reported]) == (
        [FixStored(POINT, 0.0)],
        ["point 1/2/4 has been measured; its fix is not replaced"],
        [(1, 2, 4)],
    )


async def test_a_laser_that_is_not_ready_is_waited_for_and_reported_once(
    config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ccatp.daemon.loops.fix_service.LASER_PERIOD_S", 0.0)
    reported, levels = await measured_once(config, [], None, None, lambda _event: None, not_ready=3)
    assert [fix.is_fused for fix in reported] == [True]
    assert levels == [f"measurement of the robot's place waits: {LASER_NOT_READY.message}"]
