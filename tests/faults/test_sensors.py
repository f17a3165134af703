"""Faults of sensors: each is injected, real at the robot and answered in time; what passes by is recovered from."""

from collections.abc import Callable
from itertools import pairwise
from math import hypot

import pytest

from ccatp.core import Severity
from ccatp.survey.state import MissionState
from tests.faults.linking import Measured
from tests.support.sim_survey import Seen, Watched, short_survey, watched

# Of the first seconds of a short survey in the hard world with seed 1: see ``test_the_times_are_what_they_are_called``.
DRIVING_S, BRAKING_S, TURNING_S, STANDING_S = 7.5, 8.9, 3.5, 9.6
HARD = short_survey()
IMPATIENT = short_survey(health__hold_limit_s=5.0)
THESIS = short_survey("thesis")
THESIS_DRIVING_S, THESIS_BRAKING_S = 6.2, 7.2


def after(t_s: float) -> Callable[[Seen], bool]:
    return lambda one: one.t_s >= t_s


def held(severity: Severity = Severity.PAUSE) -> Callable[[Seen], bool]:
    return lambda one: one.verdict.severity >= severity and one.t_s > 1.0


def slow(one: Seen) -> bool:
    return one.verdict.severity is Severity.SLOW and one.t_s > 1.0


def warned(one: Seen) -> bool:
    return one.verdict.severity >= Severity.SLOW and one.t_s > 1.0


def lines(signals: str, rest: str) -> str:
    """The same fault of several signals."""
    return "\n\n".join(f'signal = "{signal}"\n{rest}' for signal in signals.split())


def steps_m(seen: list[Seen]) -> list[float]:
    """How far the estimate moved from frame to frame."""
    places = [one.estimate for one in seen]
    return [hypot(b[0] - a[0], b[1] - a[1]) for a, b in pairwise(places)]


def changes(seen: list[Seen], before: MissionState, after_it: MissionState) -> int:
    """How often one state followed another."""
    return sum(a.state is before and b.state is after_it for a, b in pairwise(seen))


def falls(run: Watched) -> bool:
    return run.robot.world.is_fallen


def test_the_times_are_what_they_are_called() -> None:
    run = watched("", HARD, after(10.0))
    at = {t_s: run.first(t_s, lambda _: True) for t_s in (DRIVING_S, BRAKING_S, TURNING_S, STANDING_S)}
    assert at[DRIVING_S].state is at[BRAKING_S].state is MissionState.DRIVING
    assert min(map(abs, at[DRIVING_S].drive)) > 3.0 > abs(at[BRAKING_S].drive[0]) > 0.5
    assert at[TURNING_S].state is MissionState.TURNING
    assert at[STANDING_S].is_zero
    assert all(one.verdict.severity is Severity.NONE for one in run.since(0.1))


@pytest.mark.fault("S1")
@pytest.mark.parametrize("side", ["right", "left"])
@pytest.mark.parametrize("at_s", [DRIVING_S, TURNING_S])
def test_an_encoder_stuck_at_zero_holds(side: str, at_s: float, measured: Measured) -> None:
    run = watched(f'signal = "encoder_{side}"\ntype = "stuck"\nat_s = {at_s}\nvalue = 0.0', HARD, held())
    time_s = run.time_to_zero_s(at_s)
    assert time_s <= 0.3
    assert run.way_m(at_s, at_s + time_s) <= 0.03
    assert run.seen[-1].verdict.severity is Severity.HOLD
    measured("S1", 1e3 * time_s)


@pytest.mark.fault("S2")
@pytest.mark.parametrize("at_s", [THESIS_DRIVING_S, THESIS_BRAKING_S, 7.3, 7.5])
def test_an_encoder_that_freezes_in_motion_is_found_at_the_stop(at_s: float, measured: Measured) -> None:
    run = watched(f'signal = "encoder_left"\ntype = "stuck"\nat_s = {at_s}', THESIS, held())
    verdict = run.seen[-1].verdict
    # Found as what it is, or before that because the gyroscope contradicts it.
    assert verdict.severity is Severity.HOLD
    assert verdict.signal in {"encoder_left", "imu_wz"}
    stopped = next((one.t_s for one in run.since(at_s) if one.is_zero), run.seen[-1].t_s)
    assert run.seen[-1].t_s - stopped <= 0.5
    measured("S2", 1e3 * (max(run.seen[-1].t_s - stopped, 0.0)))


@pytest.mark.fault("S2")
def test_an_encoder_frozen_at_the_stop(measured: Measured) -> None:
    fault = f'signal = "encoder_left"\ntype = "stuck"\nat_s = {STANDING_S}\nvalue = 3.3'
    run = watched(fault, HARD, held())
    assert (run.seen[-1].verdict.severity, run.seen[-1].verdict.signal) == (Severity.HOLD, "encoder_left")
    assert "frozen" in run.seen[-1].verdict.cause
    assert run.seen[-1].t_s - STANDING_S <= 0.5
    measured("S2", 1e3 * (run.seen[-1].t_s - STANDING_S))


@pytest.mark.fault("S3")
@pytest.mark.parametrize("at_s", [DRIVING_S, TURNING_S])
def test_both_encoders_dead(at_s: float, measured: Measured) -> None:
    fault = lines("encoder_right encoder_left", f'type = "stuck"\nat_s = {at_s}\nvalue = 0.0')
    run = watched(fault, HARD, held())
    time_s = run.time_to_zero_s(at_s)
    assert time_s <= 0.3
    assert run.way_m(at_s, at_s + time_s) <= 0.03
    measured("S3", 1e3 * time_s)


def test_a_dead_encoder_that_comes_back_costs_a_hold_and_a_fix() -> None:
    fault = f'signal = "encoder_right"\ntype = "stuck"\nat_s = {DRIVING_S}\nfor_s = 1.0\nvalue = 0.0'
    run = watched(fault, HARD, after(22.0))
    assert not run.mission.is_faulted
    assert len(run.mission.done) >= 3


@pytest.mark.fault("S4")
@pytest.mark.parametrize("token", ["NaN", "Infinity", "1e999"])
def test_numbers_that_are_none_never_reach_the_filter(token: str, measured: Measured) -> None:
    fault = f'signal = "encoder_right"\ntype = "non_finite"\nat_s = {DRIVING_S}\nfor_s = 0.3\ntoken = "{token}"'
    run = watched(fault, HARD, after(DRIVING_S + 4.0))
    # Without a frame there is no drive: the first one after the gap is zero, and a fix comes before the next motion.
    first = run.first(DRIVING_S + 0.15, lambda _: True)
    assert first.is_zero
    assert first.verdict.severity is Severity.HOLD
    assert all(abs(x) < 10.0 for one in run.seen for x in one.estimate)
    assert any(one.state is MissionState.MEASURING for one in run.since(first.t_s))
    moved = [one.t_s for one in run.since(DRIVING_S) if one.t_s < first.t_s and not one.is_zero]
    measured("S4", 1e3 * (max(moved, default=DRIVING_S) - DRIVING_S))


@pytest.mark.fault("S4")
def test_three_lines_that_are_no_frames_within_a_tenth_of_a_second_hold(measured: Measured) -> None:
    # Four frames: no gap that would hold by itself.
    fault = f'signal = "encoder_right"\ntype = "non_finite"\nat_s = {DRIVING_S}\nfor_s = 0.035\ntoken = "NaN"'
    run = watched(fault, HARD, after(DRIVING_S + 4.0))
    assert run.denied_s, "the permit stands"
    assert run.denied_s[0] <= DRIVING_S + 0.1
    first = run.first(DRIVING_S, held(Severity.HOLD))
    assert first.verdict.cause == "lines of the robot were no frames"
    assert first.is_zero
    assert any(one.state is MissionState.MEASURING for one in run.since(first.t_s))
    measured("S4", 1e3 * (run.denied_s[0] - DRIVING_S))


def test_two_lines_that_are_no_frames_cost_nothing() -> None:
    fault = f'signal = "encoder_right"\ntype = "non_finite"\nat_s = {DRIVING_S}\nfor_s = 0.005\ntoken = "NaN"'
    run = watched(fault, HARD, after(DRIVING_S + 0.5))
    assert not run.denied_s
    assert all(one.verdict.severity < Severity.HOLD for one in run.seen)


@pytest.mark.fault("S5")
@pytest.mark.parametrize("kind", ['type = "wrong"\noffset = 400.0', 'type = "garbage"\nbeyond = 0.0'])
def test_no_reading_of_an_encoder_makes_the_pose_jump(kind: str, measured: Measured) -> None:
    run = watched(f'signal = "encoder_left"\nat_s = {DRIVING_S}\nfor_s = 0.05\n{kind}', HARD, after(DRIVING_S + 0.6))
    steps = steps_m(run.since(1.0))
    assert max(steps) <= 0.005
    measured("S5", 1e3 * max(steps))


@pytest.mark.fault("S6")
@pytest.mark.parametrize("factor", [0.0, 0.3])
def test_a_wheel_that_slips_holds_and_a_fix_follows(factor: float, measured: Measured) -> None:
    fault = f'signal = "right_wheel"\ntype = "slip"\nat_s = {DRIVING_S}\nfor_s = 1.0\nfactor = {factor}'
    run = watched(fault, HARD, lambda one: one.t_s > DRIVING_S + 6.0)
    first = run.first(DRIVING_S, held(Severity.HOLD))
    assert first.verdict.signal == "imu_wz"
    assert any(one.state is MissionState.MEASURING for one in run.since(first.t_s))
    assert run.way_m(DRIVING_S, first.t_s) < 0.05
    before = [one for one in run.since(DRIVING_S) if one.t_s < first.t_s]
    measured("S6", float(changes(before, MissionState.SETTLING, MissionState.MEASURING)))


@pytest.mark.fault("S8")
@pytest.mark.parametrize("step", [0.1, -0.2, 0.5])
def test_a_gyroscope_whose_bias_jumps_in_motion(step: float, measured: Measured) -> None:
    run = watched(f'signal = "imu_wz"\ntype = "wrong"\nat_s = {DRIVING_S}\noffset = {step}', HARD, held())
    time_s = run.time_to_zero_s(DRIVING_S)
    assert run.seen[-1].verdict.signal == "imu_wz"
    assert time_s <= 1.2
    measured("S8", time_s)


@pytest.mark.parametrize("kind", ["sign = -1", "factor = 0.5"])
def test_a_gyroscope_of_wrong_sign_or_scale_is_noticed_in_the_first_turn(kind: str) -> None:
    run = watched(f'signal = "imu_wz"\ntype = "wrong"\nat_s = 2.0\n{kind}', HARD,
                  lambda one: one.t_s > 2.0 and one.verdict.severity >= Severity.SLOW)  # fmt: skip
    assert run.seen[-1].t_s < 4.5  # the turn is from 3.1 s to 4.5 s
    assert run.seen[-1].verdict.signal in {"imu", "imu_wz"}


@pytest.mark.fault("S9")
@pytest.mark.parametrize(
    "fault", ['"imu_wz"\ntype = "stuck"', '"imu_ax"\ntype = "stuck"', '"imu_wz"\ntype = "stuck"\nvalue = 34.9']
)
def test_an_inertial_unit_that_repeats_itself_is_left_out(fault: str, measured: Measured) -> None:
    run = watched(f"signal = {fault}\nat_s = {DRIVING_S}", HARD, after(DRIVING_S + 1.2))
    first = run.first(DRIVING_S, slow)
    assert first.t_s - DRIVING_S <= 0.2 + 0.011  # and a frame on the link
    assert run.localizer.counts["imu_doubted"] > 50
    driven = [one for one in run.since(DRIVING_S + 1.0) if one.state is MissionState.DRIVING]
    assert all(0.015 * abs(sum(one.drive)) < 0.07 for one in driven)  # on it goes, slowly
    measured("S9", 1e3 * (first.t_s - DRIVING_S))


def test_garbage_of_the_gyroscope_does_not_end_the_mission() -> None:
    run = watched(
        f'signal = "imu_wz"\ntype = "garbage"\nat_s = {TURNING_S}\nfor_s = 2.0\nbeyond = 0.0', HARD, after(20.0)
    )
    assert not run.mission.is_faulted
    assert len(run.mission.done) >= 4
    errors = [hypot(one.estimate[0] - one.pose.x_m, one.estimate[1] - one.pose.y_m) for one in run.since(TURNING_S)]
    assert max(errors) < 0.02


@pytest.mark.fault("S12")
@pytest.mark.parametrize("at_s", [DRIVING_S, TURNING_S, STANDING_S])
@pytest.mark.parametrize("kind", ['"jump"\nby_s = 500.0', '"jump"\nby_s = -3.0', '"jump"\nby_s = 0.3'])
def test_a_clock_that_jumps(kind: str, at_s: float, measured: Measured) -> None:
    run = watched(f'signal = "clock"\ntype = {kind}\nat_s = {at_s}', HARD, after(at_s + 5.0))
    assert not run.mission.is_faulted
    near = [one for one in run.since(at_s - 0.03) if one.t_s <= at_s + 0.1]
    travelled = [hypot(b.pose.x_m - a.pose.x_m, b.pose.y_m - a.pose.y_m) for a, b in pairwise(near)]
    beyond = max(steps_m(near)) - max(travelled)
    assert beyond <= 0.001
    assert any(one.state in (MissionState.DRIVING, MissionState.TURNING) for one in run.since(at_s + 0.5))  # it goes on
    measured("S12", 1e3 * max(beyond, 0.0))


@pytest.mark.fault("S12")
@pytest.mark.parametrize("phase_s", [0.0, 0.003, 0.007])
def test_a_clock_that_wraps_does_not_count_in_the_mission_time(phase_s: float) -> None:
    run = watched(f'signal = "clock"\ntype = "wrap"\nat_s = 0.0\nmodulo_s = {DRIVING_S + phase_s}', HARD, after(12.0))
    assert not run.mission.is_faulted
    assert run._time.offset_s == pytest.approx(DRIVING_S + phase_s, abs=0.011)  # one period, and one wrap only
    assert len(run.mission.done) >= 2


@pytest.mark.fault("S16")
@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("signal", ["encoder_right encoder_left", "edge_front_left", "imu_wz"])
def test_a_slow_sensor_slows_the_robot(signal: str, seed: int) -> None:
    cfg = short_survey(run__seed=seed)
    run = watched(lines(signal, f'type = "slow"\nat_s = {DRIVING_S}\nevery = 3'), cfg, warned)
    assert run.seen[-1].t_s - DRIVING_S <= 1.05
    # A few samples of an encoder that counts steps are no wheel that runs away.
    assert run.seen[-1].verdict.severity is Severity.SLOW


@pytest.mark.fault("S16")
@pytest.mark.parametrize("signal", ["encoder_right encoder_left", "edge_front_left"])
def test_old_samples_hold_at_once_and_for_ever_they_end_in_a_fault(signal: str, measured: Measured) -> None:
    run = watched(lines(signal, f'type = "off"\nat_s = {DRIVING_S}'), IMPATIENT, lambda _: False)
    time_s = run.time_to_zero_s(DRIVING_S)
    assert time_s - 0.15 <= 0.1
    assert run.mission.is_faulted  # held, with its cause, and not waiting for ever
    assert "stale" in run.mission.cause
    assert run.first(DRIVING_S, held(Severity.HOLD)).t_s - DRIVING_S < 2.3
    measured("S16", 1e3 * (time_s - 0.15))


@pytest.mark.fault("S18")
@pytest.mark.parametrize("corner", ["front_left", "rear_right"])
def test_an_edge_sensor_that_stays_off_is_no_edge(corner: str, measured: Measured) -> None:
    run = watched(
        f'signal = "edge_{corner}"\ntype = "stuck"\nat_s = {DRIVING_S}\nvalue = 0.0', IMPATIENT, lambda _: False
    )
    first = run.first(DRIVING_S, held(Severity.HOLD))
    assert first.verdict.signal == corner
    assert first.t_s - DRIVING_S <= 3.0
    assert (
        sum(
            changes(run.seen, state, MissionState.BACKING_OFF)
            for state in MissionState
            if state is not MissionState.BACKING_OFF
        )
        <= 2
    )
    assert run.mission.is_faulted
    assert not falls(run)
    measured("S18", first.t_s - DRIVING_S)


def test_an_edge_sensor_off_for_a_moment_costs_a_back_off_and_a_fix() -> None:
    run = watched(
        f'signal = "edge_front_left"\ntype = "stuck"\nat_s = {DRIVING_S}\nfor_s = 1.5\nvalue = 0.0', HARD, after(20.0)
    )
    assert not run.mission.is_faulted
    assert len(run.mission.done) >= 3


@pytest.mark.fault("S19")
@pytest.mark.parametrize("hz", [100.0, 60.0, 40.0])
def test_a_sensor_that_chatters_holds(hz: float, measured: Measured) -> None:
    chatter = f'type = "intermittent"\nperiod_s = {1.0 / hz}\nduty = 0.5\nvalue = 0.0'
    fault = f'signal = "edge_front_right"\nat_s = {DRIVING_S}\n{chatter}'
    run = watched(fault, HARD, lambda one: one.t_s > DRIVING_S and one.is_zero)
    assert run.seen[-1].t_s - DRIVING_S <= 0.2
    measured("S19", 1e3 * (run.seen[-1].t_s - DRIVING_S))


@pytest.mark.fault("S24")
def test_a_sensor_that_goes_off_in_a_turn_stops_the_turn(measured: Measured) -> None:
    at_s = TURNING_S + 0.3
    run = watched(f'signal = "edge_front_right"\ntype = "stuck"\nat_s = {at_s}\nvalue = 0.0', HARD,
                  lambda one: one.t_s > at_s and one.drive[0] - one.drive[1] <= 0.0)  # fmt: skip
    declared = run.first(at_s, lambda one: one.verdict.code == 1)
    assert run.seen[-1].t_s - declared.t_s <= 0.1
    assert run.seen[-1].t_s - at_s <= 0.2  # over a seam the sensor may sweep its width first
    measured("S24", 1e3 * (run.seen[-1].t_s - declared.t_s))


ALL = "edge_front_left edge_front_right edge_rear_left edge_rear_right"


@pytest.mark.fault("S25")
def test_all_sensors_off_holds_with_full_fans(measured: Measured) -> None:
    run = watched(lines(ALL, f'type = "stuck"\nat_s = {DRIVING_S}\nvalue = 0.0'), IMPATIENT, lambda _: False)
    time_s = run.time_to_zero_s(DRIVING_S)
    assert time_s <= 0.1
    assert run.robot.fans.duty == (1.0, 1.0)
    assert run.mission.is_faulted
    assert "fallen" in run.mission.cause
    measured("S25", 1e3 * time_s)


@pytest.mark.fault("S26")
@pytest.mark.parametrize("at_s", [DRIVING_S, TURNING_S, STANDING_S])
def test_a_flash_of_light_aborts_nothing(at_s: float, measured: Measured) -> None:
    run = watched(lines(ALL, f'type = "stuck"\nat_s = {at_s}\nfor_s = 1.9\nvalue = 0.0'), HARD, after(at_s + 9.0))
    assert not run.mission.is_faulted
    assert any(one.state in (MissionState.DRIVING, MissionState.TURNING) for one in run.since(at_s + 2.0))
    measured("S26", float(run.mission.is_faulted))


@pytest.mark.fault("S28")
def test_a_robot_put_elsewhere_is_found_at_the_next_point(measured: Measured) -> None:
    run = watched(
        f'signal = "body"\ntype = "kidnap"\nat_s = {DRIVING_S}\ndx_m = -0.03\ndy_m = 0.02\ndheading_rad = 0.0',
        HARD,
        after(25.0),
    )
    assert run.injected[0].samples == 1
    points = len({one.estimate for one in run.seen if one.state is MissionState.MEASURING})
    assert points > 1
    found = run.first(
        DRIVING_S + 0.1, lambda one: hypot(one.estimate[0] - one.pose.x_m, one.estimate[1] - one.pose.y_m) < 0.005
    )
    before = [one for one in run.since(DRIVING_S) if one.t_s < found.t_s]
    stops = changes(before, MissionState.SETTLING, MissionState.MEASURING)
    assert stops <= 1
    measured("S28", float(stops))


@pytest.mark.fault("S17")
def test_a_blind_edge_sensor_is_found_by_the_seams(measured: Measured) -> None:
    cfg = short_survey(run__panels=0, run__order="optimised")
    run = watched('signal = "edge_front_left"\ntype = "stuck"\nat_s = 1.0\nvalue = 1.0', cfg,
                  lambda one: one.verdict.severity is Severity.HOLD)  # fmt: skip
    last = run.seen[-1].verdict
    assert (last.signal, last.value) == ("front_left", 2.0)
    assert any(slow(one) and one.verdict.signal == "front_left" for one in run.seen)
    measured("S17", last.value)
