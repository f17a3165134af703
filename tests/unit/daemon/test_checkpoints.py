"""Parts, database and checkpoint of a main loop: new, resumed, taken over."""

import random
from contextlib import nullcontext
from dataclasses import replace
from math import nan
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import msgspec
import numpy as np
import pytest
from msgspec import structs

from ccatp.conditions import text_of
from ccatp.conditions.danger import EARTHQUAKE
from ccatp.config.load import dump_config, load_config
from ccatp.config.models import Config
from ccatp.core import Cause, DeckPose, EventCode, Fix, PointId, Verdict
from ccatp.daemon.loops.checkpoint_writer import CheckpointWriter
from ccatp.daemon.loops.checkpoints import StoreUnusable, build_parts
from ccatp.daemon.loops.emergency_file import EMERGENCIES_FILE
from ccatp.daemon.supervision.process import Endpoints, ProcessArgs
from ccatp.daemon.supervision.run_dir import keep_origin
from ccatp.errors import ConfigError
from ccatp.links.robot_messages import Hello, RobotData
from ccatp.links.topics import MissionStatus
from ccatp.localizer import Localizer
from ccatp.mirror.mirror import build_mirror
from ccatp.records.checkpoint import CHECKPOINT_FILE, CheckpointError, CheckpointFile, read_checkpoint
from ccatp.records.store import MissionStore
from ccatp.survey.behaviours import MissionCommand, Settling
from ccatp.survey.budget import BudgetProgress, TimeBudget
from ccatp.survey.composition import Checkpoint, SurveyParts
from ccatp.survey.engagement import Earthquake, Held, Over
from ccatp.survey.events import (
    Abort,
    Fault,
    FixFailed,
    FixStored,
    Mode,
    Pause,
    Resume,
    StopHere,
    SurveyOutcome,
    TakenOver,
)
from ccatp.survey.planning.route import Route
from ccatp.survey.points import Failure, PointLog
from ccatp.survey.state import OnRoute, SurveyPhase, SurveyState
from ccatp.survey.statechart import Mission
from ccatp.survey.turn import offers_of, turn_of, turn_text
from tests.faults.linking import Measured
from tests.support.mission_story import ABORT, FREE, Story, from_first_leg


def args(config: Config, folder: Path) -> ProcessArgs:
    folder.mkdir(exist_ok=True)
    (folder / "config.toml").write_text(dump_config(config))
    return ProcessArgs(config, folder, Endpoints(folder), None, False, False)


def build(of: ProcessArgs) -> tuple[SurveyParts, MissionStore]:
    assert isinstance(of.config, Config)
    return build_parts(of.config, of)


@pytest.fixture
def parts(tmp_path: Path) -> SurveyParts:
    built, store = build(args(load_config(None, {"run.panels": 1}), tmp_path))
    store.close()
    return built


def hello(config: Config, **changes: Any) -> Hello:
    robot = config.robot
    names = ("wheel_radius_m", "wheel_base_m", "edge_sensors_m", "max_wheel_rad_s")
    same = {name: getattr(robot, name) for name in names}
    fields: dict[str, Any] = {**same, "puck_m": (0.0, 0.0, robot.puck_height_m), "fan_floor": 0.0, **changes}
    return Hello("ccatp-robot/1", 1, "0" * 32, "none", True, 100.0, 0.25, RobotData(**fields))


@pytest.mark.parametrize(
    ("mirror", "changes", "why"),
    [
        ("fyst-m1", {}, ""),
        ("fyst-m1", {"wheel_radius_m": 0.0303}, ""),  # calibrated here
        ("fyst-m1", {"wheel_radius_m": 0.04}, r"wheel_radius_m is 0\.03 here and 0\.04 there"),
        ("fyst-m1", {"wheel_base_m": 0.2}, r"wheel_base_m is 0\.15 here and 0\.2 there"),
        ("fyst-m1", {"edge_sensors_m": ((0.09, 0.09), (0.09, -0.09), (-0.09, 0.09), (-0.1, -0.09))}, "edge sensor is"),
        ("fyst-m1", {"puck_m": (0.0, 0.02, 0.05)}, "the puck is at"),
        ("fyst-m2", {"fan_floor": 0.6}, ""),
        ("fyst-m2", {}, "the mirror overhangs and the robot has no fan floor"),
    ],
)
def test_another_robot_is_refused(
    parts: SurveyParts, config: Config, mirror: str, changes: dict[str, Any], why: str
) -> None:
    under_test = replace(parts, mirror=build_mirror(load_config(None, {"run.mirror": mirror}).mirror))
    refusal = pytest.raises(ConfigError, match=why) if why else nullcontext()
    with refusal:
        under_test.check_robot(hello(config, **changes))


def test_a_store_is_not_overwritten_and_a_resumed_plan_leaves_out_what_is_measured(tmp_path: Path) -> None:
    where = args(load_config(None, {"run.panels": 1}), tmp_path)
    built, store = build(where)
    first = next(stop.point for stop in built.route.stops if stop.point is not None)
    fix = Fix(1.0, (0.0, 0.0, 0.0), tuple(np.eye(3).ravel().tolist()), 1.0, (1, 2, 3, 4), 0.0)
    store.record_fix(first, fix, DeckPose(0.0, 0.0, 0.0)).result(5.0)
    store.close()
    with pytest.raises(StoreUnusable, match=r"mission\.sqlite"):
        build(where)
    again, store = build(replace(where, is_resuming=True))
    store.close()
    assert (again.mission.state.points.done, again.total_points) == ((first,), 9)
    assert first not in {stop.point for stop in again.route.stops}


# -- taken over --------------------------------------------------------------------------------------------------------

QUAKE = structs.replace(
    FREE, code=EventCode.ABORTED, cause=EARTHQUAKE.cause(), forward=False, reverse=False, turn=False, raised=1,
    is_shaking=True,
)  # fmt: skip
LACKING, LATE = Failure("no lengths", had_second_try=True), Failure("no time for it", False, True)
FIX = Fix(1.0, (0.0, 0.0, 0.0), tuple(np.eye(3).ravel().tolist()), 1.0, (1, 2, 3, 4), 0.0)


@pytest.fixture
def driving(config: Config) -> Story:
    cfg = from_first_leg(config)
    story = Story(cfg, build_mirror(cfg.mirror))
    story.until_state(Mode.DRIVING)
    return story


def taken_over(story: Story, **event: Any) -> SurveyState:
    """What another main loop begins with."""
    survey, state = story.mission.survey, story.mission.state
    after, _ = survey.handle(
        state, TakenOver(**{"measured": state.points.done, "skipped": state.points.skipped, **event})
    )
    assert after.is_lost
    assert after.mode in (Mode.IDLE, Mode.HELD)
    assert (after.course, after.earthquake, after.severity, after.is_latched) == (OnRoute(), Earthquake.NONE, 0, False)
    return after


def in_force(state: SurveyState) -> tuple[str, str]:
    """Cause of an abort, and of a hold that an operator has to end."""
    return text_of(state.abort_cause), text_of(state.cause) if state.is_held_by_hand else ""


@pytest.mark.parametrize("is_new_run", [False, True])
def test_a_pause_and_an_abort(driving: Story, is_new_run: bool) -> None:
    mission = driving.mission
    assert in_force(taken_over(driving, is_new_run=is_new_run)) == ("", "")
    driving.frame(ABORT)
    assert in_force(taken_over(driving, is_new_run=is_new_run)) == ("emergency: fire", "")
    assert mission.handle(Pause(Cause("operator"))) is None
    after = taken_over(driving, is_new_run=is_new_run)
    assert (in_force(after), after.emergency_epoch) == (("emergency: fire", "operator"), 1)  # that emergency is not new


@pytest.mark.fault("O1")
def test_an_earthquake_is_kept_by_the_danger_loop(driving: Story) -> None:
    """Who takes over is held by the next verdict, and goes home when it is over; nobody has to resume."""
    driving.frame(QUAKE)
    assert driving.mission.state.is_paused
    after = taken_over(driving)
    assert (in_force(after), after.is_paused, after.full_fans) == (("emergency: earthquake", ""), False, True)
    driving.mission = Mission(driving.mission.survey, after)
    driving.frame(QUAKE)
    assert driving.mission.state.is_paused


def test_what_was_stopped_on_its_way_home_goes_home_when_it_continues(driving: Story) -> None:
    assert driving.mission.handle(Abort(Cause("operator"))) is None
    assert driving.mission.handle(StopHere()) is None
    after = taken_over(driving, is_new_run=True)
    assert (in_force(after), after.mode) == (("operator", ""), Mode.IDLE)


def test_what_is_at_base_has_nothing_in_force(driving: Story) -> None:
    driving.until_state(Mode.DONE, ABORT)
    after = taken_over(driving, is_new_run=True)
    assert (in_force(after), after.emergency_epoch, after.outcome) == (("", ""), 0, SurveyOutcome.NONE)
    assert in_force(taken_over(driving)) == ("emergency: fire", "")  # died there: it is not another survey


def test_a_fault_waits_for_an_operator_who_begins_again_instead(driving: Story) -> None:
    driving.mission.handle(Fault(Cause("a wheel is blocked")))
    after = taken_over(driving)
    assert (in_force(after), after.is_faulted) == (("", "a wheel is blocked"), True)
    after = taken_over(driving, is_new_run=True)
    assert (in_force(after), after.is_faulted) == (("", "a wheel is blocked"), False)


def test_what_failed_and_the_time_that_passed_outlive_a_process(driving: Story) -> None:
    first, second, third = (stop.point for stop in driving.stops)
    assert first
    assert second
    assert third
    budget = BudgetProgress(begun_s=1.0, planned_s=50.0, next_s=5.0)
    state = structs.replace(
        driving.mission.state,
        points=PointLog(failed={first: LACKING, third: LATE}, due=(first, second)),
        failures=2,
        backoffs=1,
        budget=budget,
        full_fans=True,
    )
    driving.mission = Mission(driving.mission.survey, state)
    after = taken_over(driving, elapsed_s=80.0)
    kept = ("points", "failures", "backoffs", "full_fans", "request")
    for name in kept:
        assert getattr(after, name) == getattr(driving.mission.state, name), name
    assert after.budget == BudgetProgress(None, 50.0, 5.0, before_s=80.0)
    # Measured, or failed, after the checkpoint was written.
    after = taken_over(driving, measured=(first,), skipped=(second,))
    assert (after.points.done, after.points.skipped, after.points.due) == ((first,), (second,), ())
    assert after.points.failed == {third: LATE, second: Failure("not measured")}
    # An operator begins again: all that is not measured is tried.
    after = taken_over(driving, skipped=(), is_new_run=True)
    assert after.points == PointLog()
    assert (after.budget, after.failures) == (BudgetProgress(), 0)


def test_the_time_before_a_kill_counts(config: Config) -> None:
    mirror = build_mirror(config.mirror)
    budget = TimeBudget(600.0, mirror, config.limits, 1.0)
    points = [PointId(5, 5, k) for k in (1, 2, 3)]
    progress = BudgetProgress(begun_s=0.0)
    assert budget.review(progress, 100.0, mirror.base_pose, points) is points
    assert budget.review(progress._replace(before_s=495.0), 100.0, mirror.base_pose, points) is None
    assert budget.progress(progress._replace(before_s=9.0), mirror.base_pose, points).before_s == 9.0


class Doomed(Story):
    """Point 2 cannot be measured; main is killed after the given frames, and another one goes on with what is kept."""

    def __init__(self, config: Config, kills: set[int]) -> None:
        super().__init__(config, build_mirror(config.mirror))
        self.survey = self.mission.survey
        self.auto_fix = False
        self.kills, self.tries, self.frames = kills, list[PointId](), 0
        self.kept = self.mission.state

    def frame(self, verdict: Verdict | None = FREE) -> MissionCommand:
        order, mission = super().frame(verdict), self.mission
        point = mission.state.measuring_point
        if order.measure and point is not None:
            self.tries.append(point)
        if order.measure:
            failed = point is not None and point.point == 2
            mission.handle(FixFailed(point, "no lengths") if failed else FixStored(point))
        if self.frames % 10 == 0:
            self.kept = msgspec.msgpack.decode(msgspec.msgpack.encode(mission.state), type=SurveyState)
        self.frames += 1
        if self.frames in self.kills:
            done, skipped = mission.state.points.done, mission.state.points.skipped
            self.mission = Mission(self.survey, self.survey.handle(self.kept, TakenOver(done, skipped, self.t))[0])
        return order


@pytest.mark.parametrize("seed", range(6))
def test_a_point_is_retried_once_however_often_main_is_killed(config: Config, seed: int) -> None:
    cfg = from_first_leg(config)
    alone = Doomed(cfg, set())
    alone.until_state(Mode.DONE)
    assert [point.point for point in alone.tries] == [1, 2, 3, 2]
    killed = Doomed(cfg, set(random.Random(seed).sample(range(1, 2 * alone.frames), 6)))
    killed.until(lambda: killed.mission.state.mode is Mode.DONE, frames=20_000)
    here, there = killed.mission.state, alone.mission.state
    assert (here.points, here.outcome) == (there.points, there.outcome)
    assert killed.tries == alone.tries


# -- in files ----------------------------------------------------------------------------------------------------------


def test_a_survey_continues_from_its_directory(tmp_path: Path) -> None:
    where = args(load_config(None, {"run.panels": 1}), tmp_path)
    built, store = build(where)
    one, two, three, *_ = (stop.point for stop in built.route.stops if stop.point is not None)
    store.record_fix(one, FIX, DeckPose(0.0, 0.0, 0.0)).result(5.0)
    store.record_skipped(two, 2.0).result(5.0)
    state = structs.replace(built.mission.state, points=PointLog(failed={two: LACKING, three: LATE}))
    built = replace(built, mission=Mission(built.mission.survey, state))
    assert built.mission.handle(Fault(Cause("a wheel is blocked"))) is None
    writer = CheckpointWriter(tmp_path, built.localizer, built.mission, is_patient=True)
    writer.boot = 7
    assert writer.is_due(3)
    writer.write(3, 0.03, 12.5)
    writer.close()
    store.close()

    restarted, store = build(replace(where, is_restarted=True))
    store.close()
    state = restarted.mission.state
    assert (state.mode, text_of(state.cause), state.is_faulted) == (Mode.HELD, "a wheel is blocked", True)
    assert (state.points.done, state.points.skipped, state.budget.before_s) == ((one,), (two,), 12.5)
    assert state.points.failed == {two: LACKING, three: LATE}
    assert len({stop.point for stop in state.route.stops} - {None}) == 6
    assert restarted.start is not None
    assert restarted.start[0] == built.localizer.deck_pose
    assert restarted.start[1][0] >= 0.005  # it stood, and may have been touched
    assert restarted.localizer.position_sigma_m == pytest.approx(restarted.start[1][0], rel=1e-9)

    resumed, store = build(replace(where, is_resuming=True, is_held=True))
    store.close()
    state = resumed.mission.state
    assert (state.mode, text_of(state.cause), state.is_faulted) == (Mode.HELD, "a wheel is blocked", False)
    assert (state.points, state.budget.before_s) == (PointLog((one,)), 0.0)
    assert len({stop.point for stop in state.route.stops} - {None}) == 8


@pytest.mark.parametrize("outcome", [SurveyOutcome.AT_BASE, SurveyOutcome.STOPPED])
def test_a_robot_that_an_emergency_sent_to_its_base_stands_there_until_it_is_cleared(
    tmp_path: Path, outcome: SurveyOutcome
) -> None:
    where = args(load_config(None, {"run.panels": 1}), tmp_path)
    built, store = build(where)
    over = structs.replace(built.mission.state, phase=Over(outcome), emergency_epoch=1)
    writer = CheckpointWriter(tmp_path, built.localizer, Mission(built.mission.survey, over), is_patient=True)
    writer.write(3, 0.03, 12.5)
    writer.close()
    store.close()
    (tmp_path / EMERGENCIES_FILE).write_text('{"active": [{"id": "of-fire", "kind": "fire", "note": ""}]}')
    again, store = build(replace(where, is_resuming=True, is_held=True))
    store.close()
    state = again.mission.state
    at_base = outcome is SurveyOutcome.AT_BASE
    assert state.is_held_by_hand
    assert (state.emergency_epoch is None) == at_base
    # Before the first verdict, which will say the same, resume is refused and not offered.
    assert again.mission.handle(Resume()) == "an emergency of before is latched: 'ccatp clear' it first"
    status = MissionStatus(seq=-1, t_s=0.0, state="held", turn=turn_of(state, None, offers_of(again.mission, None)))
    assert turn_text(status).line.endswith("Next: the observatory: clear the emergency; then resume")
    assert (turn_text(status).request, text_of(state.cause)[:10]) == ("", "restarted:")


@pytest.mark.fault("P24")
def test_files_of_another_run_are_refused(tmp_path: Path, measured: Measured) -> None:
    older, one, two = (args(load_config(None, {"run.panels": 1}), tmp_path / name) for name in ("older", "one", "two"))
    for where in (older, one, two):
        if where is not older:
            keep_origin(where.run_dir, is_sim=True, is_realtime=False, is_new=True)
        built, store = build(where)
        store.close()
        writer = CheckpointWriter(where.run_dir, built.localizer, built.mission, is_patient=True)
        writer.write(3, 0.03, 12.5)
        writer.close()
    for where in (older, one):
        build(replace(where, is_resuming=True))[1].close()
    for foreign in (older, two):
        for name, why in ((CHECKPOINT_FILE, "is of another run, .* set it at base"), ("mission.sqlite", "another run")):
            before = (one.run_dir / name).read_bytes()
            (one.run_dir / name).write_bytes((foreign.run_dir / name).read_bytes())
            with pytest.raises((CheckpointError, StoreUnusable), match=why):
                build(replace(one, is_resuming=True))
            (one.run_dir / name).write_bytes(before)
    build(replace(one, is_resuming=True))[1].close()
    measured("P24", 0)


def test_the_checkpoint_is_due_ten_times_a_second_and_at_each_hold_or_abort(driving: Story, tmp_path: Path) -> None:
    localizer = SimpleNamespace(
        deck_pose=DeckPose(1.0, 2.0, 0.5), position_sigma_m=1e-4, heading_sigma_rad=1e-3, speed_m_s=0.1, rate_rad_s=0.2
    )
    mission, seqs = driving.mission, []
    writer = CheckpointWriter(tmp_path, cast(Localizer, localizer), mission, is_patient=True)
    for seq in range(60):
        if seq == 15:
            mission.handle(Abort(Cause("fire")))
        if seq == 38:
            mission.handle(Pause(Cause("operator")))
        if seq == 42:
            mission.handle(Fault(Cause("x")))
        if seq == 55:
            localizer.deck_pose = DeckPose(nan, 0.0, 0.0)
        if writer.is_due(seq):
            writer.write(seq, 0.01 * seq, 0.02 * seq)
        writer.close()
        found = read_checkpoint(tmp_path / CHECKPOINT_FILE, Checkpoint)
        writer._file = CheckpointFile(tmp_path / CHECKPOINT_FILE, is_patient=True)
        assert found is not None
        seqs.append(found.seq)
    writer.close()
    assert found is not None
    assert [k for k, seq in enumerate(seqs) if k == seq] == [0, 10, 15, 20, 30, 38, 40, 42, 50]
    assert (found.t_s, found.elapsed_s, found.boot) == (0.5, 1.0, -1)
    assert (found.pose, found.sigma_m, found.heading_sigma_rad) == (DeckPose(1.0, 2.0, 0.5), 1e-4, 1e-3)
    assert (found.speed_m_s, found.rate_rad_s) == (0.1, 0.2)
    assert found.state == structs.replace(mission.state, route=Route((), (0.0,)), points=PointLog())


@pytest.mark.parametrize("change", ["none", "number of the format", "mode", "cause", "abort_cause", "finding"])
def test_a_checkpoint_of_an_older_format_is_refused(driving: Story, tmp_path: Path, change: str) -> None:
    """Formats 1 and 2: causes as texts. Format 3: flags beside the mode. Format 4: four lists of points."""
    found = Checkpoint(1, 1, 0.01, 0.01, DeckPose(0.0, 0.0, 0.0), 1e-4, 1e-3, 0.0, 0.0, driving.mission.state)
    record = msgspec.msgpack.decode(msgspec.msgpack.encode(found))
    assert record[0] == 5
    if change == "number of the format":
        record[0] = 3
    elif change == "mode":
        record[1 + Checkpoint.__struct_fields__.index("state")]["mode"] = "driving"
    elif change != "none":
        state = record[1 + Checkpoint.__struct_fields__.index("state")]
        state[change] = "earthquake"
    file = CheckpointFile(tmp_path / CHECKPOINT_FILE, is_patient=True)
    for _ in range(2):
        file.write(record)
    file.close()
    if change == "none":
        assert read_checkpoint(tmp_path / CHECKPOINT_FILE, Checkpoint) is not None
        return
    with pytest.raises(
        CheckpointError, match="checkpoint: written by a version of ccatp with another format, so the robot's place"
    ):
        read_checkpoint(tmp_path / CHECKPOINT_FILE, Checkpoint)


@pytest.mark.parametrize(
    ("phase", "v", "omega", "sigmas"),
    [
        (Settling(), 0.0, 0.0, (0.005, 0.010)),
        (Held(), 0.0019, -0.0099, (0.005, 0.010)),
        (Held(), -0.002, 0.0, (0.0110, 0.0905)),
        (Held(), 0.0, 0.01, (0.0103, 0.0950)),
        (None, 0.0, 0.0, (0.0103, 0.0905)),  # drives
        (None, -0.1, 0.5, (0.0542, 0.3152)),
    ],
)
def test_a_robot_that_was_not_observed_may_be_elsewhere(
    driving: Story, phase: SurveyPhase | None, v: float, omega: float, sigmas: tuple[float, float]
) -> None:
    survey_state = driving.mission.state if phase is None else structs.replace(driving.mission.state, phase=phase)
    found = Checkpoint(1, 1, 0.01, 0.01, DeckPose(0.0, 0.0, 0.0), 1e-4, 1e-3, v, omega, survey_state)
    assert found.sigmas(driving.config.limits) == pytest.approx(sigmas, abs=1e-4)  # as they are written here
