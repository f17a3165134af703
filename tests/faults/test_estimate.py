"""A filter that breaks, gravity in the acceleration, a main loop that takes over: the estimate is right."""

import random
from collections.abc import Callable
from math import cos, sin
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from scipy.stats import chi2

from ccatp.conditions import text_of
from ccatp.config.models import Config
from ccatp.control.gate import Denial
from ccatp.core import Twist
from ccatp.daemon.loops.mission_runner import DriveCommand
from ccatp.links.robot_messages import Sensors
from ccatp.studies.sil_run import SilRun
from ccatp.survey.events import FixStored, Mode
from tests.faults.linking import Measured
from tests.support.cases import slow_case
from tests.support.scenario import config_of, one_panel
from tests.support.sim_survey import MeasuredSurvey, RestartedSurvey

# -- a filter that breaks in mid-mission: held in the same frame, found again by one fix ------------------------------


def nan_noise(filter_: Any) -> None:
    """The next prediction has a covariance that is no number."""
    predict = filter_.predict

    def harmed(F: Any, Q: Any) -> None:
        filter_.predict = predict
        predict(F, Q * np.nan)

    filter_.predict = harmed


def nan_reading(filter_: Any) -> None:
    """The next measurement is no number."""
    _harm_update(filter_, lambda z, R: (z * np.nan, R))


def indefinite(filter_: Any) -> None:
    """The next measurement has a negative variance."""
    _harm_update(filter_, lambda z, R: (z, -1e3 * np.abs(R) - 1e3))


def _harm_update(filter_: Any, harm: Callable[[Any, Any], tuple[Any, Any]]) -> None:
    update = filter_.update

    def harmed(z: Any, H: Any, R: Any) -> Any:
        filter_.update = update
        z, R = harm(z, R)
        return update(z, H, R)

    filter_.update = harmed


class Broken(MeasuredSurvey):
    """The filter is broken while the robot drives."""

    harm: Callable[[Any], None]
    broken_at_s: float | None = None
    held_at_s: float | None = None
    drive = (0.0, 0.0)

    def _drive(self, drive: DriveCommand) -> None:
        super()._drive(drive)
        self.drive = drive.right_rad_s, drive.left_rad_s

    def look(self, frame: Sensors) -> None:
        if self.broken_at_s is None and self.mission.state.points.done and self.mission.state.mode is Mode.DRIVING:
            self.broken_at_s = frame.t
            localizer: Any = self.localizer
            # The end of a block of frames: the filter is asked in this one.
            localizer._block.dt_s = localizer._full.update_period_s
            type(self).harm(localizer._estimate._filter)

    def _serve(self, frame: Sensors, dt_s: float) -> None:
        before = self.localizer.deck_pose
        super()._serve(frame, dt_s)
        if self.broken_at_s is not None and self.held_at_s is None and self.localizer.is_frozen:
            self.held_at_s = frame.t
            assert text_of(self.mission.state.cause).startswith("filter: ")
            assert self.mission.state.mode in (
                Mode.HELD,
                Mode.SETTLING,
            )  # for a fix, and for nothing else
            assert self.mission.state.measuring_point is None
            assert self.drive == (0.0, 0.0)
            now = self.localizer.deck_pose
            assert np.isfinite((now.x_m, now.y_m, now.heading_rad)).all()
            assert np.hypot(now.x_m - before.x_m, now.y_m - before.y_m) < 0.002  # a frame of the way


@pytest.mark.fault("S27")
@pytest.mark.parametrize("harm", [nan_noise, slow_case(nan_reading), indefinite])
def test_a_broken_filter_freezes_holds_and_begins_again_with_a_fix(
    harm: Callable[[Any], None], tmp_path: Path, measured: Measured
) -> None:
    run = type("Harmed", (Broken,), {"harm": staticmethod(harm)})(one_panel(run__seed=3), tmp_path)
    result = run.run()
    assert run.broken_at_s is not None
    assert run.held_at_s is not None
    ticks = round((run.held_at_s - run.broken_at_s) * run.cfg.sim.robot.frame_hz)
    measured("S27", ticks)
    assert ticks <= 1
    assert (result.outcome, result.summary["points"]["measured"]) == ("complete", 9)
    assert result.counts["diverged"] == 1
    first = next(m for m in run.asked if m.t_s > run.held_at_s)
    assert first.point is None  # nothing but a fix comes first


# -- gravity in the acceleration on an inclined mirror: each rest shows it as part of the bias ------------------------

TWO_DEGREES_M_S2 = 0.34  # of an attitude that is two degrees wrong; sixty times the sensor's noise


class Leaking(SilRun):
    """The robot's own attitude is wrong: a part of gravity along its heading stays in the acceleration."""

    largest_m_s2 = 0.0

    def _serve(self, frame: Sensors, dt_s: float) -> None:
        down_x, down_y, _ = self.mirror.rotate_deck_from_world((0.0, 0.0, -1.0))
        heading_rad = self.localizer.deck_pose.heading_rad
        leak_m_s2 = TWO_DEGREES_M_S2 * (down_x * cos(heading_rad) + down_y * sin(heading_rad))
        self.largest_m_s2 = max(self.largest_m_s2, abs(leak_m_s2))
        imu = [sample._replace(ax_m_s2=sample.ax_m_s2 + leak_m_s2) for sample in frame.imu]
        super()._serve(msgspec.structs.replace(frame, imu=imu), dt_s)


@pytest.mark.fault("S10")
@pytest.mark.parametrize("seeds", [(1,), slow_case((1, 2, 3))])
def test_innovations_stay_within_their_band(seeds: tuple[int, ...]) -> None:
    found = list[float]()
    for seed in seeds:
        # With its calibration drive: before it, creep and slip may be anything, and no fix is a surprise.
        rehearsal = Leaking(config_of(run__panels=1, run__world="hard", run__seed=seed))
        result = rehearsal.run()
        assert result.summary["points"]["measured"] == 9
        found += [stop.nis for stop in result.stops]
        assert rehearsal.largest_m_s2 > 0.1
    low, high = (chi2.ppf(share, 2 * len(found)) / len(found) for share in (0.025, 0.975))
    assert low < np.mean(found) < high


# -- a main loop that takes over from one that was killed -------------------------------------------------------------

MISSIONS = 30


def restarted(seed: int, **overrides: object) -> Config:
    mirror = ("fyst-m1", "fyst-m2")[seed // 2 % 2]
    return config_of(mirror, run__world=("thesis", "hard")[seed % 2], run__seed=seed, run__panels=1, **overrides)


def check(rehearsal: RestartedSurvey) -> None:
    result = rehearsal.run()
    measured = rehearsal.mission.state.points.done
    assert result.outcome == "complete", result.cause
    assert rehearsal.states, "nobody was killed"
    assert len(measured) == len(set(measured)) == 9
    assert result.summary["danger"]["falls"] == 0
    assert result.summary["points"]["skipped"] == 0


@pytest.mark.fault("P17")
@pytest.mark.parametrize("seed", [slow_case(2), 5])
def test_killed_while_turning_and_driving(seed: int) -> None:
    rehearsal = RestartedSurvey(restarted(seed, mission__calibration_length_m=0.0), {350, 1480})
    check(rehearsal)
    # The record says how far the robot may be from it, with room to spare.
    assert max(rehearsal.first_moves_m) < 2.0


@pytest.mark.slow
@pytest.mark.fault("P17")
@pytest.mark.parametrize("seed", range(MISSIONS))
def test_killed_at_random_instants(seed: int) -> None:
    rng = random.Random(seed)
    check(RestartedSurvey(restarted(seed), {rng.randrange(100, 7000) for _ in range(3)}))


class Burning(RestartedSurvey):
    """There is a fire, and main dies on its way home; or main has died, and its successor looks for the heading."""

    def __init__(self, cfg: Config, *, is_before: bool) -> None:
        super().__init__(cfg, set() if is_before else {1200})
        self._is_before, self._is_raised = is_before, False

    def _serve(self, frame: Sensors, dt_s: float) -> None:
        is_time = frame.seq > 1000 if self._is_before else bool(self.states)
        if not self._is_raised and is_time and self.mission.state.mode is Mode.DRIVING:
            assert self.monitor.emergency("fire", "a") is None
            self._is_raised = True
            self._kills |= {frame.seq + 60} if self._is_before else set()
        super()._serve(frame, dt_s)


@pytest.mark.fault("O1", "P1")
@pytest.mark.parametrize("is_before", [True, False])
def test_a_main_loop_that_takes_over_in_a_fire_finds_the_heading_and_goes_home(is_before: bool) -> None:
    run = Burning(restarted(1, mission__calibration_length_m=0.0), is_before=is_before)
    result = run.run()
    assert (run.states == [Mode.RETURNING]) is is_before
    assert len(run.states) == 1
    assert (result.outcome, result.cause) == ("aborted, at base", "emergency: fire")
    assert run.pipeline.gate.denied[Denial.ABORTED] == 0  # it drove to find its heading, too
    assert result.summary["danger"]["falls"] == 0


class Watching(RestartedSurvey):
    """Notes whether wheels were asked to turn before the first fix of a main loop that takes over."""

    early: list[Twist]

    def _take_over(self) -> None:
        super()._take_over()
        self.early, mission = [], self.mission
        step, handle, self._has_fix = mission.step, mission.handle, False

        def watch(motion, verdict):  # type: ignore[no-untyped-def]
            order = step(motion, verdict)
            if not self._has_fix and (order.twist.v_m_s or order.twist.omega_rad_s):
                self.early.append(order.twist)
            return order

        def note(event):  # type: ignore[no-untyped-def]
            self._has_fix |= isinstance(event, FixStored)
            return handle(event)

        mission.step, mission.handle = watch, note  # type: ignore[method-assign]


@pytest.mark.fault("P11", "P17")
def test_nothing_moves_before_it_is_found() -> None:
    rehearsal = Watching(restarted(1, mission__calibration_length_m=0.0), {350})
    check(rehearsal)
    assert rehearsal.states[0] in (Mode.TURNING, Mode.DRIVING)
    assert rehearsal.early == []
