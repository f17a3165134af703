"""Faults of the laser system: silent, gone, wrong, in another frame; and a robot that moves while it is measured."""

import asyncio
import random
import tracemalloc
from collections.abc import Callable
from math import dist
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ccatp.config.models import Config
from ccatp.core import Fix, PointId
from ccatp.daemon.fix_service import FixRequest
from ccatp.etalon_client import EtalonClient, EtalonError, EtalonTimeout, StaleLengths
from ccatp.links import multiline
from ccatp.links.robot_messages import LineBuffer
from ccatp.localizer import build_localizer
from ccatp.mirror.mirror import Mirror
from ccatp.mirror.multilateration import MultilaterationError, solve_fix
from ccatp.records.store import MissionStore, PlannedPoint
from ccatp.sim.etalon_server import EtalonSimulator, FixedPuck
from ccatp.survey.fix_gate import FixGate, FrameCheck, explain, signed_axes
from ccatp.survey.state import MissionState
from tests.contract.test_etalon_client import (
    CHANNELS,
    COLLIMATORS,
    EXPECTED,
    PUCK,
    ScriptedServer,
    client_of,
    flood,
    lengths,
    records,
    silence,
)
from tests.faults.linking import Measured
from tests.support.mission_story import FREE, Story, from_first_leg
from tests.support.scenario import config_of, mirror_of
from tests.support.sim_survey import (
    Laser,
    LaserRequest,
    MeasuredSurvey,
    failing,
    fix_service,
    honest,
    moved,
    patient,
    short_survey,
    single,
)
from tests.support.virtual_time import run_virtual

POINT = PointId(5, 5, 1)
KIDNAP_S = 15.0


def one_panel(**changes: object) -> Config:
    return short_survey("thesis", **{"run__seed": 3, **changes})


def is_point(number: int) -> Callable[[LaserRequest], bool]:
    return lambda m: m.point is not None and m.point.point == number


def failing_where(is_meant: Callable[[LaserRequest], bool]) -> Laser:
    def laser(measured: LaserRequest, fix: Fix) -> Fix:
        return failing(measured, fix) if is_meant(measured) else fix

    return laser


# -- E1, E10: no answer -----------------------------------------------------------------------------------------------


@pytest.mark.fault("E1")
def test_a_point_that_fails_is_skipped_flagged_and_measured_at_the_end(tmp_path: Path) -> None:
    failures: list[LaserRequest] = []

    def laser(measured: LaserRequest, fix: Fix) -> Fix:
        if is_point(5)(measured) and not failures:
            failures.append(measured)
            return failing(measured, fix)
        return fix

    run = MeasuredSurvey(one_panel(), tmp_path, laser)
    result = run.run()
    assert result.outcome == "complete"
    assert result.summary["points"]["measured"] == 9
    assert (result.summary["points"]["skipped"], run.mission.left_out) == (0, {})
    assert run.mission.done[-1] == failures[0].point  # when all others were done
    assert {status for _, status in run.stored} == {"measured"}
    assert len(run.all_fixes) == 9


@pytest.mark.fault("E1")
def test_a_point_that_fails_twice_is_told_with_its_reason(tmp_path: Path) -> None:
    run = MeasuredSurvey(one_panel(), tmp_path, failing_where(is_point(5)))
    result = run.run()
    assert result.outcome == "complete"
    assert (result.summary["points"]["measured"], result.summary["points"]["skipped"]) == (8, 1)
    assert list(run.mission.left_out.values()) == ["no reply"]
    assert len([m for m in run.asked if is_point(5)(m)]) == 2  # not again and again
    assert [point.point for point, status in run.stored if status == "skipped"] == [5]


@pytest.mark.fault("E1")
def test_three_points_in_a_row_hold_the_mission(tmp_path: Path) -> None:
    run = MeasuredSurvey(one_panel(), tmp_path, failing_where(lambda m: m.point is not None and m.point.point < 7))
    result = run.run()
    assert run.mission.is_faulted
    assert run.mission.state is MissionState.HELD
    assert result.cause == "3 measurements in a row failed: no reply"
    assert (len(run.mission.done), len(run.mission.skipped)) == (3, 3)


class Desk:
    """The fix service with a real client and a real store, and a mission that asks for one point."""

    def __init__(self, config: Config, client: EtalonClient, folder: Path) -> None:
        self.failed: list[str] = []
        self.done: list[PointId | None] = []
        self.over = asyncio.Event()
        self.store = MissionStore.create(
            folder / "m.sqlite", mirror="x", seed=1, config_toml="", points=[PlannedPoint(POINT, 0.0, 0.0)]
        )
        mission = SimpleNamespace(
            is_awaiting_fix=True,
            is_lost=True,
            request=1,
            survey=SimpleNamespace(distance_m=lambda _pose: 0.0),
            fixed=self.done.append,
            not_fixed=lambda _point, cause: self.failed.append(cause),
        )
        self.service = fix_service(
            config,
            client.measure,
            patient(self.store),
            mission,
            on_finished=self.over.set,
            measuring_time_s=config.etalon.measuring_time_s,
        )
        self.estimate = mirror_of().base_pose

    async def measure(self) -> float:
        """Measure the point; the time it took."""
        loop = asyncio.get_running_loop()
        begun_s = loop.time()
        serving = loop.create_task(self.service.run())
        self.service.begin(FixRequest(1, 1.0, POINT, EXPECTED, self.estimate))
        await self.over.wait()
        took_s = loop.time() - begun_s
        serving.cancel()
        await asyncio.wait([serving])
        return took_s


def daemon_client(config: Config, port: int) -> EtalonClient:
    """With the deadlines that the daemon has."""
    return EtalonClient(config.etalon.model_copy(update={"port": port}), CHANNELS, COLLIMATORS)


@pytest.mark.fault("E1", "E10")
@pytest.mark.parametrize("action", [silence, flood, b"junk\r\n", lengths(channels=(1, 2)), lengths(server_error=4)])
def test_a_point_takes_ten_seconds_at_most(action: Any, config: Config, tmp_path: Path, measured: Measured) -> None:
    async def story() -> tuple[float, list[str], int]:
        server = ScriptedServer()
        await server.start()
        server.script += [action] * 50
        client = daemon_client(config, server.port)
        desk = Desk(config, client, tmp_path)
        took_s = await desk.measure()
        await client.close()
        await server.stop()
        desk.store.close()
        return took_s, desk.failed, len(server.asked)

    (took_s, failed, asked), _ = run_virtual(story())
    measured("E1", took_s)
    assert len(failed) == 1
    assert 3 <= asked <= 20
    assert took_s <= 10.0 + 1e-6


@pytest.mark.fault("E10")
def test_a_beam_that_is_free_again_costs_a_retry(config: Config, tmp_path: Path, measured: Measured) -> None:
    async def story() -> tuple[float, list[PointId | None], dict[str, int]]:
        standin = EtalonSimulator(
            config.sim.etalon, CHANNELS, COLLIMATORS, FixedPuck(PUCK), np.random.default_rng(4), measuring_time_s=0.5
        )
        client = daemon_client(config, await standin.start("127.0.0.1", 0))
        standin.model.blocked.update(CHANNELS[3:])
        desk = Desk(config, client, tmp_path)
        loop = asyncio.get_running_loop()
        loop.call_later(0.8, standin.model.blocked.clear)
        took_s = await desk.measure()
        await client.close()
        await standin.close()
        desk.store.close()
        return took_s, desk.done, dict(client.counts)

    (took_s, done, counts), _ = run_virtual(story())
    measured("E10", took_s)
    assert done == [POINT]
    assert counts["retries"] == 2


def test_a_point_missed_by_more_than_the_tolerance_is_approached_again(tmp_path: Path) -> None:
    # Set down 10 mrad askew, the four-state filter misses the first points by some 4 mm.
    run = MeasuredSurvey(one_panel(run__seed=1, run__filter="kf", mission__correction_tolerance_m=0.003), tmp_path)
    result = run.run()
    assert result.outcome == "complete"
    assert any("approaching it again" in line for line in run.said)
    points = {"total": 9, "measured": 9, "first_arrival_within_10mm": 9, "skipped": 0}
    assert result.summary["points"] == points


# -- E2, E6, E7, E8: the server ---------------------------------------------------------------------------------------


@pytest.mark.fault("E2")
async def test_lengths_of_the_last_place_are_no_fix_of_this_one() -> None:
    server = ScriptedServer()
    await server.start()
    async with client_of(server.port) as client:
        await client.measure(1.0, EXPECTED)
        await client.measure(2.0, EXPECTED)  # the robot has not moved: the same lengths may be right
        elsewhere = (EXPECTED[0] + 0.2, *EXPECTED[1:])
        with pytest.raises(StaleLengths, match=r"the lengths are those of the last place, 200 mm from here"):
            await client.measure(3.0, elsewhere)
        wrong = records()
        server.script.append(
            multiline.format_reply(
                multiline.ChannelData((wrong[0]._replace(length_mm=wrong[0].length_mm + 1e-4), *wrong[1:]))
            )
        )
        await client.measure(4.0, elsewhere)
    await server.stop()


@pytest.mark.fault("E2")
def test_random_delays_assign_no_reply_to_another_request(measured: Measured) -> None:
    """Every reply names its request by where it puts the puck; late ones come while later requests wait."""

    async def story() -> int:
        server, rng, wrong = ScriptedServer(), random.Random(5), 0
        await server.start()

        def replying(position: tuple[float, float, float], delay_s: float) -> Any:
            async def action(writer: asyncio.StreamWriter) -> None:
                await asyncio.sleep(delay_s)
                writer.write(lengths(position))

            return action

        async with client_of(server.port, request_timeout_s=1.0, measuring_time_s=0.5) as client:
            for k in range(300):
                position = (PUCK[0] + 1e-4 * k, PUCK[1], PUCK[2])
                server.script.clear()
                server.script.append(replying(position, rng.choice((0.0, 0.5, 0.99, 1.01, 3.0))))
                try:
                    fix = await client.measure(float(k), EXPECTED)
                except EtalonTimeout:
                    continue
                wrong += dist(fix.position_m, position) > 1e-6
        await server.stop()
        return wrong

    wrong, took_s = run_virtual(story())
    measured("E2", wrong)
    assert wrong == 0
    assert took_s > 100.0  # there were late ones


@pytest.mark.fault("E6")
@pytest.mark.parametrize("down_s", [0.5, 2.0, 4.4])
def test_a_server_that_is_restarted_is_found_and_the_point_counts_once(
    down_s: float, config: Config, tmp_path: Path, measured: Measured
) -> None:
    async def story() -> tuple[float, list[PointId | None], int]:
        server = ScriptedServer()
        await server.start()
        client = daemon_client(config, server.port)
        await client.connect()
        await server.stop()
        desk = Desk(config, client, tmp_path)

        async def restart() -> float:
            await asyncio.sleep(down_s)
            await server.start()
            return asyncio.get_running_loop().time()

        starting = asyncio.get_running_loop().create_task(restart())
        await desk.measure()
        late_s = asyncio.get_running_loop().time() - await starting
        await client.close()
        await server.stop()
        fixes = desk.store.fixes()
        desk.store.close()
        return late_s, desk.done, fixes[-1].id  # counts fixes that were stored, replaced ones too

    (late_s, done, fixes), _ = run_virtual(story())
    measured("E6", late_s, "s")
    measured("E6", fixes - 1, "twice")
    assert (done, fixes) == ([POINT], 1)
    assert late_s <= 5.0


@pytest.mark.fault("E7")
def test_mutilated_replies_are_bad_replies_and_nothing_else(measured: Measured) -> None:
    rng = random.Random(7)
    good = [lengths(), b"isconnected_1\r\n", b"environmentdata_5.0_525.0_30.0\r\n", b"error_busy\r\n"]
    surprises = 0
    for _ in range(20_000):
        line = bytearray(rng.choice(good))
        for _ in range(rng.randint(1, 6)):
            at = rng.randrange(len(line) + 1)
            line[at : at + rng.randint(0, 3)] = rng.randbytes(rng.randint(0, 3))
        try:
            for text in LineBuffer(multiline.MAX_LINE_BYTES).feed(bytes(line) + b"\n"):
                reply = multiline.parse_reply(text.rstrip(b"\r"))
                if isinstance(reply, multiline.ChannelData):
                    multiline.valid_lengths(reply, CHANNELS)
        except multiline.BadReply:
            pass
        except Exception:
            surprises += 1
    measured("E7", surprises)
    assert surprises == 0


@pytest.mark.fault("E8")
async def test_a_reply_without_an_end_takes_no_memory(measured: Measured) -> None:
    server = ScriptedServer()
    await server.start()
    async with client_of(server.port, retries=2) as client:
        await client.measure(1.0, EXPECTED)
        server.script += [flood, flood, flood]
        tracemalloc.start()
        before, _ = tracemalloc.get_traced_memory()
        with pytest.raises(EtalonError, match="line of more than 65536 bytes"):
            await client.measure(2.0, EXPECTED)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    await server.stop()
    mebibytes = (peak - before) / 2**20
    measured("E8", mebibytes)
    assert mebibytes <= 1.0


# -- E3, E4: wrong positions ------------------------------------------------------------------------------------------


@pytest.mark.fault("E3")
@pytest.mark.parametrize("name", ["ekf", "kf"])
def test_outliers_are_not_fused(name: str, tmp_path: Path, measured: Measured) -> None:
    rng = np.random.default_rng(11)

    def laser(m: LaserRequest, fix: Fix) -> Fix:
        if m.t_s < 1.0 or rng.random() > 0.3:
            return fix
        direction = rng.normal(size=3)
        offset = 10.0 ** rng.uniform(-3.0, 0.0) * direction / np.linalg.norm(direction)
        return moved(fix, tuple(offset))

    run = MeasuredSurvey(one_panel(run__filter=name), tmp_path, laser)
    run.run()
    outliers = [m for m in run.asked if m.offset_m > 0.0]
    fused = [m for m in outliers if m.is_fused and not m.nis <= 25.0]
    measured("E3", len(fused))
    assert len(outliers) >= 4
    assert fused == []


@pytest.mark.fault("E3")
@pytest.mark.parametrize(("height_m", "is_taken"), [(0.0045, True), (-0.0055, False)])
def test_a_puck_off_the_surface_is_not_believed(height_m: float, is_taken: bool, tmp_path: Path) -> None:
    cfg, mirror = one_panel(), mirror_of()

    def laser(m: LaserRequest, fix: Fix) -> Fix:
        if not is_point(5)(m):
            return fix
        x, y, _ = mirror.foot_of_puck(fix.position_m, cfg.robot.puck_height_m)
        normal = mirror.rotate_world_from_deck(mirror.surface.normal(x, y))
        return moved(fix, tuple(height_m * n for n in normal))  # type: ignore[arg-type]

    run = MeasuredSurvey(cfg, tmp_path, laser)
    result = run.run()
    assert result.summary["points"]["skipped"] == (0 if is_taken else 1)
    asked = [m for m in run.asked if is_point(5)(m)]
    assert all(m.is_fused is is_taken for m in asked)
    if not is_taken:
        assert len(asked) == 6  # three times, and three times once more at the end
        assert "off the surface" in next(iter(run.mission.left_out.values()))


@pytest.mark.fault("E4")
@pytest.mark.parametrize("way", [(0.03, 0.0, 0.0), (0.0, -0.06, 0.0), (0.1, 0.1, 0.2)])
def test_a_robot_put_elsewhere_is_believed_after_three_fixes(
    way: tuple[float, float, float], tmp_path: Path, measured: Measured
) -> None:
    dx, dy, turn = way
    keys = f"at_s = {KIDNAP_S}\ndx_m = {dx}\ndy_m = {dy}\ndheading_rad = {turn}"
    run = MeasuredSurvey(one_panel(), tmp_path, honest, single(f'signal = "body"\ntype = "kidnap"\n{keys}'))
    result = run.run()
    assert run.injected[0].samples > 0
    after = [m for m in run.asked if m.t_s > KIDNAP_S]
    needed = next(k for k, m in enumerate(after, start=1) if m.is_fused)
    measured("E4", needed)
    assert needed <= 3
    assert result.outcome == "complete"
    assert result.summary["points"]["measured"] == 9


# -- E5: frame and unit -----------------------------------------------------------------------------------------------


@pytest.mark.fault("E5")
@pytest.mark.parametrize("name", ["fyst-m1", "fyst-m2", "thesis-m1", "thesis-m2"])
def test_every_exchange_of_axes_and_units_is_refused_at_the_first_fix(name: str, measured: Measured) -> None:
    cfg, mirror = config_of(name), mirror_of(name)
    puck = mirror.puck_world(mirror.base_pose, cfg.robot.puck_height_m)
    true_m = {c: float(np.linalg.norm(p - puck)) for c, p in zip(mirror.channels, mirror.collimators_m, strict=True)}
    accepted, explained, lies = 0, 0, 0
    for matrix in signed_axes()[1:]:
        lies += 1
        accepted += refusal(cfg, mirror, mirror.collimators_m @ matrix.T, true_m, explained_too=lies % 8 == 0) == ""
    for factor in (1e-3, 1e3, 25.4, 1.0 / 25.4):
        for places, lengths_m in (
            (mirror.collimators_m * factor, true_m),
            (mirror.collimators_m, {c: factor * r for c, r in true_m.items()}),
        ):
            lies += 1
            why = refusal(cfg, mirror, places, lengths_m, explained_too=True)
            accepted += why == ""
            explained += "unit is wrong" in why
    assert lies == 47 + 8
    measured("E5", 100.0 * (lies - accepted) / lies)
    assert accepted == 0
    assert explained == 8
    assert refusal(cfg, mirror, mirror.collimators_m, true_m, explained_too=True) == ""


def refusal(
    cfg: Config, mirror: Mirror, collimators_m: Any, lengths_m: dict[int, float], *, explained_too: bool
) -> str:
    """What the operator is told at the first fix of a laser system with these places and lengths, or empty."""
    places = dict(zip(mirror.channels, collimators_m, strict=True))
    puck = mirror.puck_world(mirror.base_pose, cfg.robot.puck_height_m)
    scrutiny = FixGate(mirror, cfg)
    scrutiny._collimators_m = places
    try:
        fix = solve_fix(cfg.etalon, 0.0, puck, lengths_m, places)
    except MultilaterationError as error:
        return scrutiny.refusal_of(lengths_m, puck) if explained_too else str(error)
    return scrutiny.review(fix, puck, mirror.base_pose, np.diag((4e-6, 4e-6, 1e-4))).refusal


@pytest.mark.fault("E5")
def test_what_the_first_place_hides_the_second_shows() -> None:
    """A robot in the plane of symmetry sees a mirrored axis only once it has moved."""
    cfg = config_of().etalon
    check = FrameCheck(cfg)
    assert check.look((0.0, 2.0, 5.0), (0.0, 2.0, 5.001)) is None
    fault = check.look((-0.2, 2.0, 5.0), (0.2, 2.0, 5.0))
    assert fault is not None
    assert str(fault) == "the axes are wrong: what should be (x, y, z) is (-x, y, z)"
    assert not check.is_over


@pytest.mark.fault("E5")
def test_the_check_ends_with_three_places_that_span_a_plane() -> None:
    check = FrameCheck(config_of().etalon)
    for place in ((1.0, 2.0, 5.0), (1.2, 2.0, 5.0), (1.0, 2.0, 5.0), (1.1, 2.0, 5.0)):
        assert check.look(place, place) is None
    assert not check.is_over  # all on a line
    assert check.look((1.0, 2.3, 5.0), (1.0, 2.3, 5.0)) is None
    assert check.is_over
    assert check.look((9.0, 9.0, 9.0), (1.0, 2.0, 5.0)) is None


def test_a_place_that_no_exchange_explains() -> None:
    assert explain((1.0, 2.0, 3.0), (1.0, 2.0, 3.4), 0.05) == ""
    fault = FrameCheck(config_of().etalon).look((1.0, 2.0, 3.0), (1.0, 2.0, 3.4))
    assert fault is not None
    assert str(fault).startswith("no exchange of axes or units explains it")


@pytest.mark.fault("E5")
def test_a_mission_in_a_wrong_frame_does_not_begin(tmp_path: Path) -> None:
    def turned(_m: LaserRequest, fix: Fix) -> Fix:
        return moved(fix, (0.3, 0.0, 0.0))

    run = MeasuredSurvey(one_panel(), tmp_path, turned)
    run.run()
    assert run.mission.is_faulted
    assert run.mission.cause == (
        "the laser system sees the robot 0.30 m from its base: no exchange of axes or units explains it; is it at "
        "base, and is this the mirror?"
    )
    assert not run.states_s.get(MissionState.DRIVING, 0.0)
    assert len(run.asked) == 1


# -- E9: measured while moving ----------------------------------------------------------------------------------------


@pytest.mark.fault("E9")
def test_nothing_counts_that_was_measured_while_the_robot_moved(
    config: Config, tmp_path: Path, measured: Measured
) -> None:
    """Frames and replies race: the robot is pushed at random times, the server takes its time."""
    cfg, mirror = from_first_leg(config), mirror_of()
    moving = bumps = counted = 0

    async def race(seed: int) -> None:
        nonlocal moving, bumps, counted
        rng, story = random.Random(seed), Story(cfg, mirror)
        story.auto_fix = False
        motion_s: list[float] = []
        fused: list[tuple[float, float]] = []  # when the lengths were asked for, and when they were taken
        loop = asyncio.get_running_loop()

        async def measure(t_s: float, expected_m: Any) -> Fix:
            await asyncio.sleep(rng.uniform(0.0, 1.0))
            return Fix(t_s, (0.0, 0.0, 0.0), (1e-12,) * 9, 1.0, (1, 2, 3, 4), 0.0)

        localizer = build_localizer(cfg, mirror)
        points = [PlannedPoint(PointId(5, 5, k), 0.0, 0.0) for k in (1, 2, 3)]
        folder = tmp_path / f"{seed}"
        folder.mkdir()

        def fuse(fix: Fix) -> float:
            fused.append((fix.t_s, story.t))
            return 0.0

        stub = SimpleNamespace(
            fuse_fix=fuse, notices=[], pose=localizer.pose, pose_covariance=np.eye(3), position_sigma_m=5e-6
        )
        with MissionStore.create(folder / "m.sqlite", mirror="x", seed=1, config_toml="", points=points) as store:
            far = cfg.model_copy(update={"mission": cfg.mission.model_copy(update={"correction_tolerance_m": 1e3})})
            desk = fix_service(far, measure, patient(store), story.mission, localizer=stub)
            serving = loop.create_task(desk.run())
            done = 0
            for _ in range(6000):
                if story.mission.state is MissionState.DONE:
                    break
                if story.mission.state is MissionState.MEASURING and rng.random() < 0.012:
                    story.v, bumps = 0.02, bumps + 1
                if abs(story.v) > cfg.control.settle_speed_m_s:
                    motion_s.append(story.t)
                order = story.frame(FREE)
                if order.measure:
                    point = story.mission.measuring_point
                    desk.begin(FixRequest(story.mission.request, story.t, point, (0.0, 0.0, 0.0), story.motion().deck))
                await asyncio.sleep(0.01)
                if len(story.mission.done) > done:
                    done, counted = len(story.mission.done), counted + 1
                    begun_s, taken_s = fused[-1]
                    moving += any(begun_s - 0.2 <= t <= taken_s for t in motion_s)
            assert story.mission.state is MissionState.DONE
            serving.cancel()
            await asyncio.wait([serving])

    for seed in range(2):
        run_virtual(race(seed))
    measured("E9", moving)
    assert counted == 6
    assert bumps > 5
    assert moving == 0
