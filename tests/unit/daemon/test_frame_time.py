"""When the main loop answers a frame, and how long a pause that it finds itself may last."""

import time
from types import SimpleNamespace
from typing import Any, cast

import pytest

from ccatp.conditions import Condition
from ccatp.conditions.mission import FRAME_LATE, FRAMES_OLD, LASER_NOT_READY, NO_FRAME_FOR, OPERATOR
from ccatp.config.load import load_config
from ccatp.core import Cause
from ccatp.daemon.loops.frame_lateness import LatenessStatistics
from ccatp.daemon.loops.frame_time import DriveSender, LockstepTime, RealTime
from ccatp.daemon.loops.mission_runner import STILL, DriveCommand, LoopLimits, MissionRunner
from ccatp.daemon.loops.pauses import PauseWatch
from ccatp.daemon.loops.robot_session import RobotSession
from ccatp.survey.engagement import EngagedMission, Engagement, EngagementRules, Held, Kind, Paused, Phase
from ccatp.survey.events import Fault, Mode, SurveyInput

MOVING = DriveCommand(1.0, 0.5)


class Driving(Phase, frozen=True, tag=True):
    kind, shown = Kind.WORK, Mode.DRIVING


class Rules(EngagementRules[Engagement]):
    rows = ()

    def proceed(self, s: Engagement) -> Engagement:
        return s


class Mission(EngagedMission[Engagement]):
    """Drives; keeps the events that it was given."""

    def __init__(self, events: list[SurveyInput]) -> None:
        super().__init__(Rules(), Engagement(Driving()))
        self._events = events

    def handle(self, event: SurveyInput) -> str | None:
        self._events.append(event)
        return super().handle(event)

    def enter(self, phase: Phase, cause: Cause) -> None:
        self._state = Engagement(phase, cause)


class Rig:
    """A runner whose robot stands while a measurement is awaited; what is sent and done.

    ``acks``: the frames whose drives were sent. ``events``: those of the mission.
    """

    def __init__(self) -> None:
        self.acks: list[int] = []
        self.events: list[SurveyInput] = []
        self.gaps = 0
        self.said: list[str] = []
        self.mission = Mission(self.events)
        telemetry = SimpleNamespace(notify_operator=lambda level, text: self.said.append(f"{level}: {text}"))
        self.stand_in = SimpleNamespace(
            is_busy=True, is_at_rest=True, mission=self.mission, telemetry=telemetry, on_tracking_gap=self._note_gap
        )
        self.runner = cast(MissionRunner, self.stand_in)
        link = SimpleNamespace(send_drive=lambda _seq, ack, *_, **__: self.acks.append(ack))
        session = cast(RobotSession, SimpleNamespace(link=link))
        self.drives = DriveSender(session, lambda *_: None)

    def frame(self, seq: int) -> int:
        """The number of a frame that has come."""
        self.drives.take(seq)
        return seq

    def hold(self, cause: Cause) -> None:
        self.mission.enter(Held(), cause)

    def _note_gap(self) -> None:
        self.gaps += 1


@pytest.fixture
def rig() -> Rig:
    return Rig()


def pause_watch(rig: Rig) -> PauseWatch:
    """A pause needs a fix after 10 s, and is a fault after 30 s."""
    return PauseWatch(rig.runner, LoopLimits(0.1, hold_s=30.0), load_config(None, {"health.pause_limit_s": 10.0}))


# -- lockstep ----------------------------------------------------------------------------------------------------------


def test_in_lockstep_the_answer_of_a_standing_robot_waits_for_the_measurement(rig: Rig) -> None:
    lockstep = LockstepTime(rig.runner, rig.drives)
    lockstep.answer(rig.frame(1), MOVING)
    assert (rig.acks, lockstep.withheld) == ([1], None)
    lockstep.answer(rig.frame(2), STILL)
    assert (rig.acks, lockstep.withheld) == ([1], 2)
    lockstep.release()
    assert rig.acks == [1]
    rig.stand_in.is_busy = False
    lockstep.release()
    assert (rig.acks, lockstep.withheld) == ([1, 2], None)
    lockstep.release()
    lockstep.hold(2)
    assert rig.acks == [1, 2]


def test_in_lockstep_a_pause_stops_time_once_the_robot_is_at_rest(rig: Rig) -> None:
    lockstep = LockstepTime(rig.runner, rig.drives)
    rig.stand_in.is_busy = False
    rig.mission.enter(Paused(), OPERATOR.cause())
    rig.stand_in.is_at_rest = False
    lockstep.answer(rig.frame(1), STILL)
    assert rig.acks == [1]
    rig.stand_in.is_at_rest = True
    lockstep.answer(rig.frame(2), STILL)
    assert (rig.acks, lockstep.withheld) == ([1], 2)
    lockstep.answer_withheld()
    assert (rig.acks, lockstep.withheld) == ([1, 2], None)


# -- real time ---------------------------------------------------------------------------------------------------------


def test_in_real_time_no_answer_is_withheld_and_a_hold_is_sent(rig: Rig) -> None:
    cfg = load_config()
    pauses = pause_watch(rig)
    real_time = RealTime(rig.runner, rig.drives, pauses, LatenessStatistics(0.02), limits=cfg.robot)
    real_time.answer(rig.frame(1), STILL)
    real_time.release()
    real_time.answer_withheld()
    assert (rig.acks, real_time.withheld) == ([1], None)
    real_time.hold(1)
    assert rig.acks == [1, 1]


def test_a_late_frame_is_planned_without_a_verdict_and_pauses_the_mission(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = load_config().robot
    planned: list[tuple[object, float]] = []

    def decide(_frame: object, verdict: object, lag_s: float) -> DriveCommand:
        planned.append((verdict, lag_s))
        return MOVING

    rig.stand_in.decide = decide
    logged: list[dict[str, Any]] = []
    rig.stand_in.telemetry.log = SimpleNamespace(warning=lambda _, **fields: logged.append(fields))
    pauses = pause_watch(rig)
    real_time = RealTime(rig.runner, rig.drives, pauses, LatenessStatistics(0.02), limits=robot)
    now_s = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: now_s)
    echo = SimpleNamespace(seq=-1, age=0.0)
    late_s = 2.0 * robot.lag_limit_s
    for seq, delay_s in enumerate((0.0, late_s)):
        now_s += 0.01 + delay_s
        sensors = SimpleNamespace(seq=seq, t=0.01 * seq, cmd=echo)
        real_time.decide(cast(Any, SimpleNamespace(sensors=sensors)), cast(Any, "verdict"))
    assert [verdict for verdict, _ in planned] == ["verdict", None]
    assert planned[1][1] == pytest.approx(late_s, abs=1.1e-2 * 0.01)  # the drift of the clocks in a frame
    assert [(one["seq"], one["limit_ms"]) for one in logged] == [(1, 1e3 * robot.lag_limit_s)]
    assert rig.mission.state.cause.condition == FRAME_LATE.name


# -- pauses ------------------------------------------------------------------------------------------------------------


def test_a_pause_needs_a_fix_after_its_first_limit_and_is_a_fault_after_its_second(rig: Rig) -> None:
    pauses = pause_watch(rig)
    assert pauses.interrupt(FRAMES_OLD, late_ms=300.0, limit_ms=250.0)
    assert rig.mission.state.cause.condition == FRAMES_OLD.name
    gaps = []
    for now_s in (0.0, 9.9, 10.0, 20.0, 29.9):
        pauses.escalate(now_s, counts=True)
        gaps.append(rig.gaps)
    assert gaps == [0, 0, 1, 1, 1]
    assert not any(isinstance(event, Fault) for event in rig.events)
    pauses.escalate(30.0, counts=True)
    assert isinstance(rig.events[-1], Fault)
    assert rig.events[-1].cause.lasted_s == 30.0
    assert [line.partition(":")[0] for line in rig.said] == ["error"]


@pytest.mark.parametrize(("row", "counts"), [(FRAMES_OLD, False), (NO_FRAME_FOR, True), (LASER_NOT_READY, True)])
def test_the_time_counts_neither_in_lockstep_nor_for_a_cause_that_does_not_escalate_here(
    rig: Rig, row: Condition, counts: bool
) -> None:
    pauses = pause_watch(rig)
    rig.hold(row.cause())
    for now_s in (0.0, 50.0, 100.0):
        pauses.escalate(now_s, counts=counts)
    assert rig.gaps == 0
    assert rig.events == []


def test_another_cause_of_the_main_loop_replaces_the_one_of_a_pause_and_no_other(rig: Rig) -> None:
    pauses = pause_watch(rig)
    assert pauses.interrupt(FRAME_LATE, late_ms=200.0, limit_ms=100.0)
    assert pauses.interrupt(NO_FRAME_FOR, limit_s=0.3)
    assert rig.mission.state.cause.condition == NO_FRAME_FOR.name
    rig.mission.enter(Paused(), OPERATOR.cause())
    assert not pauses.interrupt(NO_FRAME_FOR, limit_s=0.3)
    assert rig.mission.state.cause.condition == OPERATOR.name
