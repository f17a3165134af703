"""Faults of the laser system: silent, gone, wrong, in another frame; and a robot that moves while it is measured."""

import asyncio
import random
import tracemalloc
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from math import dist
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ccatp.conditions import text_of
from ccatp.config.models import Config
from ccatp.core import Fix, PointId
from ccatp.daemon.loops.fix_service import FixRequest
from ccatp.etalon_client import EtalonClient, EtalonError, EtalonTimeout, StaleLengths
from ccatp.links import multiline
from ccatp.localizer import build_localizer
from ccatp.mirror.mirror import Mirror
from ccatp.mirror.multilateration import MultilaterationError, solve_fix
from ccatp.records.store import MissionStore, StoredPoint
from ccatp.sim.etalon_server import EtalonSimulator, FixedPuck
from ccatp.survey.events import Mode
from ccatp.survey.fix_gate import SIGNED_AXES, FixGate, FrameCheck, explain
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
)  # fmt: skip
from tests.faults.linking import Measured
from tests.support.cases import slow_case
from tests.support.mission_story import FREE, Story, from_first_leg
from tests.support.scenario import any_port, config_of, mirror_of, one_panel
from tests.support.sim_survey import (
    Desk,
    LaserRequest,
    MeasuredSurvey,
    failing,
    fix_service,
    moved,
    patient,
    plan_of,
    serving,
    sightless,
)  # fmt: skip
from tests.support.virtual_time import run_virtual

POINT = PointId(5, 5, 1)
KIDNAP_S = 15.0
SURVEY = one_panel(run__seed=3)


def is_point(m: LaserRequest, *numbers: int) -> bool:
    return m.point is not None and m.point.point in numbers


# -- E1, E10: no answer -----------------------------------------------------------------------------------------------


@pytest.mark.fault("E1")
@pytest.mark.parametrize(
    ("points", "times", "outcome", "measured", "skipped", "why"),
    [
        pytest.param((5,), 1, "complete", 9, 0, [], id="once: measured at the end"),
        pytest.param(
            (5,), 99, "complete", 8, 1, ["no reply"], id="twice: told with its reason", marks=pytest.mark.slow
        ),
        pytest.param(range(1, 7), 99, "faulted", 3, 3, [], id="three in a row hold the mission"),
    ],
)  # fmt: skip
def test_points_that_fail(
    points: Any, times: int, outcome: str, measured: int, skipped: int, why: list[str], tmp_path: Path
) -> None:
    failures: list[LaserRequest] = []

    def laser(m: LaserRequest, fix: Fix) -> Fix:
        if is_point(m, *points) and len(failures) < times:
            failures.append(m)
            return failing(m, fix)
        return fix

    run = MeasuredSurvey(SURVEY, tmp_path, laser)
    result = run.run()
    assert result.outcome == outcome
    assert (len(run.mission.state.points.done), len(run.mission.state.points.skipped)) == (measured, skipped)
    assert len(run.all_fixes) == result.summary["points"]["measured"] == measured
    assert result.summary["points"]["skipped"] == skipped
    assert {point for point, status in run.stored if status == "skipped"} == set(run.mission.state.points.skipped)
    if outcome == "complete":
        assert list(run.mission.survey.left_out(run.mission.state).values()) == why
        assert len([m for m in run.asked if is_point(m, *points)]) == 2  # not again and again
        assert run.mission.state.points.done[-1] == failures[0].point or why  # when all others were done
    else:
        assert run.mission.state.is_faulted
        assert run.mission.state.mode is Mode.HELD
        assert result.cause == "3 measurements in a row failed: no reply"


def daemon_client(config: Config, port: int) -> EtalonClient:
    """With the deadlines that the daemon has."""
    return EtalonClient(config.etalon.model_copy(update={"port": port}), CHANNELS, COLLIMATORS)


@asynccontextmanager
async def desk_of(config: Config, port: int, folder: Path) -> AsyncIterator[tuple[Desk, EtalonClient, MissionStore]]:
    """The fix service with a real client and a real store of one point."""
    client = daemon_client(config, port)
    plan = [StoredPoint(POINT, 0.0, 0.0)]
    with MissionStore.create(folder / "m.sqlite", mirror="x", seed=1, config_toml="", points=plan) as store:
        desk = Desk(config, client.measure, patient(store), config.etalon.measuring_time_s)
        async with serving(desk.service):
            yield desk, client, store
        await client.close()


async def time_of_a_point(desk: Desk) -> float:
    """Measure the point; the time it took."""
    begun_s = asyncio.get_running_loop().time()
    desk.begin(POINT, EXPECTED)
    await desk.over.wait()
    return asyncio.get_running_loop().time() - begun_s


@pytest.mark.fault("E1", "E10")
@pytest.mark.parametrize("action", [silence, flood, b"junk\r\n", lengths(channels=(1, 2)), lengths(server_error=4)])
def test_a_point_takes_ten_seconds_at_most(action: Any, config: Config, tmp_path: Path, measured: Measured) -> None:
    async def story() -> tuple[float, list[str], int]:
        server = ScriptedServer()
        await server.start()
        server.script += [action] * 50
        async with desk_of(config, server.port, tmp_path) as (desk, _, _):
            took_s = await time_of_a_point(desk)
        await server.stop()
        return took_s, desk.failed, len(server.asked)

    (took_s, failed, asked), _ = run_virtual(story())
    measured("E1", took_s)
    assert len(failed) == 1
    assert 3 <= asked <= 20
    assert took_s <= 10.0 + 1e-6


@pytest.mark.fault("E10")
def test_a_beam_that_is_free_again_costs_a_retry(config: Config, tmp_path: Path, measured: Measured) -> None:
    async def story() -> tuple[float, list[PointId | None], int]:
        standin = EtalonSimulator(config.sim.etalon, CHANNELS, COLLIMATORS, FixedPuck(PUCK), np.random.default_rng(4))
        async with desk_of(config, await standin.start(any_port()), tmp_path) as (desk, client, _):
            standin.model.blocked.update(CHANNELS[3:])
            asyncio.get_running_loop().call_later(0.8, standin.model.blocked.clear)
            took_s = await time_of_a_point(desk)
        await standin.close()
        return took_s, desk.done, client.counts["retries"]

    (took_s, done, retries), _ = run_virtual(story())
    measured("E10", took_s)
    assert (done, retries) == ([POINT], 2)


def test_a_point_missed_by_more_than_the_tolerance_is_approached_again(tmp_path: Path) -> None:
    # Set down 10 mrad askew, the four-state filter misses the first points by some 4 mm.
    run = MeasuredSurvey(one_panel(run__seed=1, run__filter="kf", mission__correction_tolerance_m=0.003), tmp_path)
    result = run.run()
    assert result.outcome == "complete"
    assert any("approaching it again" in line for line in run.said)
    points = {"total": 9, "measured": 9, "first_arrival_within_10mm": 9, "skipped": 0}
    assert result.summary["points"] == points


# -- E2, E6, E8: the server ------------------------------------------------------------------------------------------


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
        first, *rest = records()
        other = multiline.ChannelData((first._replace(length_mm=first.length_mm + 1e-4), *rest))
        server.script.append(multiline.format_reply(other))
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
@pytest.mark.parametrize("down_s", [0.5, 4.4])
def test_a_server_that_is_restarted_is_found_and_the_point_counts_once(
    down_s: float, config: Config, tmp_path: Path, measured: Measured
) -> None:
    async def story() -> tuple[float, list[PointId | None], int]:
        server = ScriptedServer()
        await server.start()
        async with desk_of(config, server.port, tmp_path) as (desk, client, store):
            await client.connect()
            await server.stop()

            async def restart() -> float:
                await asyncio.sleep(down_s)
                await server.start()
                return asyncio.get_running_loop().time()

            starting = asyncio.get_running_loop().create_task(restart())
            await time_of_a_point(desk)
            late_s = asyncio.get_running_loop().time() - await starting
            count = "SELECT count(*) FROM fixes"  # replaced ones too
            number: int = store._submit(lambda db: db.execute(count).fetchone()[0]).result()
        await server.stop()
        return late_s, desk.done, number

    (late_s, done, fixes), _ = run_virtual(story())
    measured("E6", late_s, "s")
    measured("E6", fixes - 1, "twice")
    assert (done, fixes) == ([POINT], 1)
    assert late_s <= 5.0


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
@pytest.mark.parametrize("name", ["ekf", pytest.param("kf", marks=pytest.mark.slow)])
def test_outliers_are_not_fused(name: str, tmp_path: Path, measured: Measured) -> None:
    rng = np.random.default_rng(11)

    def laser(m: LaserRequest, fix: Fix) -> Fix:
        if m.t_s < 1.0 or rng.random() > 0.3:
            return fix
        direction = rng.normal(size=3)
        offset = 10.0 ** rng.uniform(-3.0, 0.0) * direction / np.linalg.norm(direction)
        return moved(fix, tuple(offset))

    run = MeasuredSurvey(one_panel(run__seed=3, run__filter=name), tmp_path, laser)
    run.run()
    outliers = [m for m in run.asked if m.offset_m > 0.0]
    fused = [m for m in outliers if m.is_fused and not m.nis <= 25.0]
    measured("E3", len(fused))
    assert len(outliers) >= 4
    assert fused == []


@pytest.mark.fault("E3")
@pytest.mark.parametrize(("height_m", "is_taken"), [slow_case(0.0045, True), (-0.0055, False)])
def test_a_puck_off_the_surface_is_refused(height_m: float, is_taken: bool, tmp_path: Path) -> None:
    mirror = mirror_of()

    def laser(m: LaserRequest, fix: Fix) -> Fix:
        if not is_point(m, 5):
            return fix
        x, y, _ = mirror.foot_of_puck(fix.position_m, SURVEY.robot.puck_height_m)
        normal = mirror.rotate_world_from_deck(mirror.surface.normal(x, y))
        return moved(fix, tuple(height_m * n for n in normal))  # type: ignore[arg-type]

    run = MeasuredSurvey(SURVEY, tmp_path, laser)
    result = run.run()
    assert result.summary["points"]["skipped"] == (0 if is_taken else 1)
    asked = [m for m in run.asked if is_point(m, 5)]
    assert all(m.is_fused is is_taken for m in asked)
    if not is_taken:
        assert len(asked) == 6  # three times, and three times once more at the end
        assert "off the surface" in next(iter(run.mission.survey.left_out(run.mission.state).values()))


@pytest.mark.fault("E4")
@pytest.mark.parametrize(
    "way",
    [
        pytest.param((0.03, 0.0, 0.0), marks=pytest.mark.slow),
        pytest.param((0.0, -0.06, 0.0), marks=pytest.mark.slow),
        (0.1, 0.1, 0.2),
    ],
)
def test_a_robot_put_elsewhere_is_accepted_after_three_fixes(
    way: tuple[float, float, float], tmp_path: Path, measured: Measured
) -> None:
    dx, dy, turn = way
    plan = plan_of(f"body kidnap at_s={KIDNAP_S} dx_m={dx} dy_m={dy} dheading_rad={turn}")
    run = MeasuredSurvey(SURVEY, tmp_path, plan=plan)
    result = run.run()
    assert run.injected[0].samples > 0
    after = [m for m in run.asked if m.t_s > KIDNAP_S]
    needed = next(k for k, m in enumerate(after, start=1) if m.is_fused)
    measured("E4", needed)
    assert needed <= 3
    assert (result.outcome, result.summary["points"]["measured"]) == ("complete", 9)


# -- E5: frame and unit -----------------------------------------------------------------------------------------------


@pytest.mark.fault("E5")
@pytest.mark.parametrize("name", ["fyst-m1", slow_case("fyst-m2"), slow_case("thesis-m1"), "thesis-m2"])
def test_every_exchange_of_axes_and_units_is_refused_at_the_first_fix(name: str, measured: Measured) -> None:
    cfg, mirror = config_of(name), mirror_of(name)
    puck = mirror.puck_world(mirror.base_pose, cfg.robot.puck_height_m)
    true_m = {c: float(np.linalg.norm(p - puck)) for c, p in zip(mirror.channels, mirror.collimators_m, strict=True)}
    accepted, explained, lies = 0, 0, 0
    for matrix in SIGNED_AXES[1:]:
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
        return text_of(scrutiny.refusal_of(lengths_m, puck)) if explained_too else str(error)
    return text_of(scrutiny.review(fix, puck, mirror.base_pose, np.diag((4e-6, 4e-6, 1e-4))).refusal)


@pytest.mark.fault("E5")
@pytest.mark.parametrize(
    ("seen", "expected", "why"),
    [  # a robot in the plane of symmetry sees a mirrored axis only once it has moved
        ((-0.2, 2.0, 5.0), (0.2, 2.0, 5.0), "the axes are wrong: what should be (x, y, z) is (-x, y, z)"),
        ((1.0, 2.0, 3.0), (1.0, 2.0, 3.4), ""),
    ],
)
def test_what_the_first_place_hides_the_second_shows(seen: Any, expected: Any, why: str, config: Config) -> None:
    check = FrameCheck(config.etalon)
    assert check.look((0.0, 2.0, 5.0), (0.0, 2.0, 5.001)) is None
    assert check.look(seen, expected) == why
    assert not check.is_over
    assert explain((1.0, 2.0, 3.0), (1.0, 2.0, 3.4), 0.05) == ""


@pytest.mark.fault("E5")
def test_the_check_ends_with_three_places_that_span_a_plane(config: Config) -> None:
    check = FrameCheck(config.etalon)
    for place in ((1.0, 2.0, 5.0), (1.2, 2.0, 5.0), (1.0, 2.0, 5.0), (1.1, 2.0, 5.0)):
        assert check.look(place, place) is None
    assert not check.is_over  # all on a line
    assert check.look((1.0, 2.3, 5.0), (1.0, 2.3, 5.0)) is None
    assert check.is_over
    assert check.look((9.0, 9.0, 9.0), (1.0, 2.0, 5.0)) is None


@pytest.mark.fault("E5")
def test_a_mission_in_a_wrong_frame_does_not_begin(tmp_path: Path) -> None:
    run = MeasuredSurvey(SURVEY, tmp_path, lambda _m, fix: moved(fix, (0.3, 0.0, 0.0)))
    run.run()
    assert run.mission.state.is_faulted
    assert text_of(run.mission.state.cause) == (
        "the laser system sees the robot 0.30 m from its base: no exchange of axes or units explains it; is it at "
        "base, and is this the mirror?"
    )
    assert not run.states_s.get(Mode.DRIVING, 0.0)
    assert len(run.asked) == 1


# -- E9: measured while moving ----------------------------------------------------------------------------------------


@pytest.mark.fault("E9")
def test_nothing_counts_that_was_measured_while_the_robot_moved(
    config: Config, tmp_path: Path, measured: Measured
) -> None:
    """Frames and replies race: the robot is pushed at random times, the server takes its time."""
    cfg, mirror = from_first_leg(config), mirror_of()
    far = cfg.model_copy(update={"mission": cfg.mission.model_copy(update={"correction_tolerance_m": 1e3})})
    points = [StoredPoint(PointId(5, 5, k), 0.0, 0.0) for k in (1, 2, 3)]
    moving = bumps = counted = 0

    async def race(seed: int) -> None:
        nonlocal moving, bumps, counted
        rng, story = random.Random(seed), Story(cfg, mirror)
        story.auto_fix = False
        motion_s: list[float] = []
        fused: list[tuple[float, float]] = []  # when the lengths were asked for, and when they were taken

        async def measure(t_s: float, expected_m: Any) -> Fix:
            await asyncio.sleep(rng.uniform(0.0, 1.0))
            return Fix(t_s, (0.0, 0.0, 0.0), (1e-12,) * 9, 1.0, (1, 2, 3, 4), 0.0)

        def fuse(fix: Fix) -> float:
            fused.append((fix.t_s, story.t))
            return 0.0

        localizer, path = sightless(fuse_fix=fuse, pose=build_localizer(cfg, mirror).pose), tmp_path / f"{seed}.sqlite"
        with MissionStore.create(path, mirror="x", seed=1, config_toml="", points=points) as store:
            service = fix_service(far, measure, patient(store), story.mission, localizer=localizer)
            async with serving(service):
                done = 0
                for _ in range(6000):
                    if story.state.mode is Mode.DONE:
                        break
                    if story.state.mode is Mode.MEASURING and rng.random() < 0.012:
                        story.v, bumps = 0.02, bumps + 1
                    if abs(story.v) > cfg.control.settle_speed_m_s:
                        motion_s.append(story.t)
                    order = story.frame(FREE)
                    if order.measure:
                        point, here = story.state.measuring_point, story.deck()
                        service.begin(FixRequest(story.state.request, story.t, point, (0.0, 0.0, 0.0), here))
                    await asyncio.sleep(0.01)
                    if len(story.state.points.done) > done:
                        done, counted = len(story.state.points.done), counted + 1
                        begun_s, taken_s = fused[-1]
                        moving += any(begun_s - 0.2 <= t <= taken_s for t in motion_s)
                assert story.state.mode is Mode.DONE

    for seed in range(2):
        run_virtual(race(seed))
    measured("E9", moving)
    assert counted == 6
    assert bumps > 5
    assert moving == 0
