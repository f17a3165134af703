"""A main loop that takes over from one that was killed: found again before it moves, every point measured once."""

import random

import pytest

from ccatp.config.load import load_config
from ccatp.config.models import Config
from ccatp.control.gate import Denial
from ccatp.core import Twist
from ccatp.links.robot_messages import Sensors
from ccatp.survey.state import MissionState
from tests.faults.restarting import RestartingRehearsal

MISSIONS = 30


def config(seed: int, **overrides: object) -> Config:
    mirror = ("fyst-m1", "fyst-m2")[seed // 2 % 2]
    named = {"run.world": ("thesis", "hard")[seed % 2], "run.mirror": mirror, "run.seed": seed, "run.panels": 1}
    return load_config(overrides={**named, **overrides})


def check(rehearsal: RestartingRehearsal) -> None:
    result = rehearsal.run()
    measured = rehearsal.measured
    assert result.outcome == "complete", result.cause
    assert rehearsal.states, "nobody was killed"
    assert len(measured) == len(set(measured)) == 9
    assert result.summary["danger"]["falls"] == 0
    assert result.summary["points"]["skipped"] == 0


@pytest.mark.fault("P17")
@pytest.mark.parametrize("seed", [2, 5])
def test_killed_while_turning_and_driving(seed: int) -> None:
    rehearsal = RestartingRehearsal(config(seed, **{"mission.calibration_length_m": 0.0}), {350, 1480})
    check(rehearsal)
    # The record says how far the robot may be from it, with room to spare.
    assert max(rehearsal.first_moves_m) < 2.0


@pytest.mark.slow
@pytest.mark.fault("P17")
@pytest.mark.parametrize("seed", range(MISSIONS))
def test_killed_at_random_instants(seed: int) -> None:
    rng = random.Random(seed)
    check(RestartingRehearsal(config(seed), {rng.randrange(100, 7000) for _ in range(3)}))


class Burning(RestartingRehearsal):
    """There is a fire, and main dies on its way home; or main has died, and its successor looks for the heading."""

    def __init__(self, cfg: Config, *, is_before: bool) -> None:
        super().__init__(cfg, set() if is_before else {1200})
        self._is_before, self._is_raised = is_before, False

    def _serve(self, frame: Sensors, dt_s: float) -> None:
        is_time = frame.seq > 1000 if self._is_before else bool(self.states)
        if not self._is_raised and is_time and self.mission.state is MissionState.DRIVING:
            assert self.monitor.emergency("fire", "a") is None
            self._is_raised = True
            self._kills |= {frame.seq + 60} if self._is_before else set()
        super()._serve(frame, dt_s)


@pytest.mark.fault("O1", "P1")
@pytest.mark.parametrize("is_before", [True, False])
def test_whoever_takes_over_in_a_fire_finds_the_heading_and_goes_home(is_before: bool) -> None:
    run = Burning(config(1, **{"mission.calibration_length_m": 0.0}), is_before=is_before)
    result = run.run()
    assert (run.states == [MissionState.RETURNING]) is is_before
    assert len(run.states) == 1
    assert (result.outcome, result.cause) == ("aborted, at base", "emergency: fire")
    assert run.gate.denied[Denial.ABORTED] == 0  # it drove to find its heading, too
    assert result.summary["danger"]["falls"] == 0


class Watching(RestartingRehearsal):
    """Notes whether wheels were asked to turn before the first fix of a main loop that takes over."""

    early: list[Twist]

    def _take_over(self) -> None:
        super()._take_over()
        self.early, mission = [], self.mission
        step, self._has_fix = mission.step, False
        fixed = mission.fixed

        def watch(motion, verdict):  # type: ignore[no-untyped-def]
            order = step(motion, verdict)
            if not self._has_fix and (order.twist.v_m_s or order.twist.omega_rad_s):
                self.early.append(order.twist)
            return order

        def note(point):  # type: ignore[no-untyped-def]
            self._has_fix = True
            fixed(point)

        mission.step, mission.fixed = watch, note  # type: ignore[method-assign]


@pytest.mark.fault("P11", "P17")
def test_nothing_moves_before_it_is_found() -> None:
    rehearsal = Watching(config(1, **{"mission.calibration_length_m": 0.0}), {350})
    check(rehearsal)
    assert rehearsal.states[0] in (MissionState.TURNING, MissionState.DRIVING)
    assert rehearsal.early == []
