"""Faults of sensors, wheels, battery and fans: each is injected, real at the robot and answered in time."""

from collections.abc import Callable
from contextlib import suppress
from itertools import pairwise
from math import hypot, inf
from statistics import mean
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ccatp.conditions import text_of
from ccatp.conditions.danger import IMU_LEFT_OUT, TURN_TIMES_DIFFER
from ccatp.control.gate import FanGate
from ccatp.core import Severity
from ccatp.sim.fault_plan import parse_plan
from ccatp.studies.sil_run import SilRun
from ccatp.survey.events import Mode, SurveyOutcome
from tests.faults.linking import Measured
from tests.support.cases import slow_case
from tests.support.scenario import config_of, one_panel
from tests.support.sim_survey import Enough, Seen, Watched, plan_of, watched

# Of the first seconds of a short survey in the hard world with seed 1: see ``test_the_times_are_what_they_are_called``.
DRIVING_S, BRAKING_S, TURNING_S, STANDING_S = 7.5, 8.9, 3.7, 9.6
THESIS_DRIVING_S, THESIS_BRAKING_S = 6.2, 7.2
HARD = one_panel(run__world="hard")
IMPATIENT = one_panel(run__world="hard", health__hold_limit_s=5.0)
THESIS = one_panel()
PAUSE, HOLD = Severity.PAUSE, Severity.HOLD
SIDES = ("right", "left")
RUNAWAYS = {"left_wheel", "encoder_left"}
ENCODERS = ("encoder_right", "encoder_left")
INERTIAL = ("imu_ax", "imu_wz")
EDGES = ("edge_front_left", "edge_front_right", "edge_rear_left", "edge_rear_right")


def each(signals: tuple[str, ...], rest: str) -> tuple[str, ...]:
    """The same fault of several signals."""
    return tuple(f"{signal} {rest}" for signal in signals)


def after(t_s: float) -> Callable[[Seen], bool]:
    return lambda one: one.t_s >= t_s


def held(severity: Severity = PAUSE) -> Callable[[Seen], bool]:
    return lambda one: one.verdict.severity >= severity and one.t_s > 1.0


def to_its_end(_: Seen) -> bool:
    return False


def in_the_next(is_it: Callable[[Seen], bool]) -> Callable[[Seen], bool]:
    """The frame after the first of which something is true: then the mission has decided by that verdict."""
    seen: list[bool] = []

    def is_next(one: Seen) -> bool:
        seen.append(is_it(one))
        return any(seen[:-1])

    return is_next


def slow(one: Seen) -> bool:
    return one.verdict.severity is Severity.SLOW and one.t_s > 1.0


def is_moving(one: Seen) -> bool:
    return one.state in (Mode.DRIVING, Mode.TURNING)


def steps_m(seen: list[Seen]) -> list[float]:
    """How far the estimate moved from frame to frame."""
    places = [one.estimate for one in seen]
    return [hypot(b[0] - a[0], b[1] - a[1]) for a, b in pairwise(places)]


def error_m(one: Seen) -> float:
    return hypot(one.estimate[0] - one.pose.x_m, one.estimate[1] - one.pose.y_m)


def entered(seen: list[Seen], state: Mode, before: Mode | None = None) -> int:
    """How often a state began, after one or after any other."""
    pairs = [(a.state, b.state) for a, b in pairwise(seen)]
    return sum(b is state and a is not state and before in (None, a) for a, b in pairs)


def test_the_times_are_what_they_are_called() -> None:
    run = watched(HARD, after(10.0))
    at = {t_s: run.first(t_s, lambda _: True) for t_s in (DRIVING_S, BRAKING_S, TURNING_S, STANDING_S)}
    assert at[DRIVING_S].state is at[BRAKING_S].state is Mode.DRIVING
    assert min(map(abs, at[DRIVING_S].drive)) > 3.0 > abs(at[BRAKING_S].drive[0]) > 0.5
    assert at[TURNING_S].state is Mode.TURNING
    assert at[STANDING_S].is_zero
    assert all(one.verdict.severity is Severity.NONE for one in run.since(0.1))


def test_a_copied_mission_is_the_whole_one() -> None:
    fault = f"encoder_left garbage at_s={DRIVING_S} for_s=0.05 beyond=0.0"  # of random numbers
    copied, whole = watched(HARD, after(10.0), fault), Watched(HARD, plan_of(fault), after(10.0))
    with suppress(Enough):
        whole.run()
    places = [[(one.pose, one.estimate, one.drive) for one in run.seen] for run in (copied, whole)]
    assert places[0] == places[1]
    assert [record.changed for record in copied.injected] == [record.changed for record in whole.injected]


# -- the wheels are commanded to stand ----------------------------------------------------------------------------


# Row of the fault table, faults, when, until when they are watched, limit in time, and what is expected.
Stop = tuple[str, tuple[str, ...], float, Callable[[Seen], bool], float, dict[str, Any]]


def is_further(row: Stop) -> bool:
    """Whether another case shows the same: the same fault of the other wheel, of the other sign, of a middle size."""
    name, (fault, *others), at_s, *_ = row
    if name == "F9":
        return at_s != DRIVING_S and "rate_rad_s=-8.0" in fault
    return (name in ("S1", "F8") and "left" in fault) or (name == "S8" and "offset=-0.2" in fault and not others)


def stops() -> list[Any]:
    never_far: dict[str, Any] = {"way_m": 0.03}
    rows: list[Stop] = []
    for at_s in (DRIVING_S, TURNING_S):
        for side in SIDES:
            rows += [
                ("S1", (f"encoder_{side} stuck value=0.0",), at_s, held(), 0.3, {**never_far, "severity": HOLD}),
                ("F8", (f"{side}_wheel blocked",), at_s, to_its_end, 0.3, {"holds": (2, 3)}),
            ]
        rows.append(("S3", each(ENCODERS, "stuck value=0.0"), at_s, held(), 0.3, never_far))
    both = each(("right_wheel", "left_wheel"), "blocked")
    rows.append(("F10", both, DRIVING_S, held(HOLD), 0.3, {}))
    for at_s in (DRIVING_S, TURNING_S, STANDING_S):
        for rate in (8.0, -8.0):
            fault = f"left_wheel runaway for_s=0.4 rate_rad_s={rate}"
            rows.append(("F9", (fault,), at_s, after(at_s + 0.31), 0.1, {"signals": RUNAWAYS, "by": HOLD}))
    rows += [
        ("S8", (f"imu_wz wrong offset={step}",), DRIVING_S, held(), 1.2, {"signals": {"imu_wz"}})
        for step in (0.1, -0.2, 0.5)
    ]
    rows += [
        ("S16", each(signals, "off"), DRIVING_S, to_its_end, 0.1, {"less_s": 0.15, "cause": "stale", "hold_s": 2.3})
        for signals in (ENCODERS, ("edge_front_left",))
    ]
    rows.append(("S25", each(EDGES, "stuck value=0.0"), DRIVING_S, to_its_end, 0.1, {"cause": "fallen"}))
    further = [pytest.mark.slow]
    return [
        pytest.param(
            row,
            marks=[pytest.mark.fault(row[0]), *(further if is_further(row) else [])],
            id=f"{row[0]} {row[1][0]} at {row[2]}",
        )
        for row in rows
    ]


@pytest.mark.parametrize("case", stops())
def test_it_stops_in_time(case: Stop, measured: Measured) -> None:
    row, faults, at_s, until, limit_s, expected = case
    run = watched(IMPATIENT if row in ("S16", "S25") else HARD, until, *each(faults, f"at_s={at_s}"))
    zero_s = run.time_to_zero_s(at_s)
    time_s = zero_s - expected.get("less_s", 0.0)
    assert time_s <= limit_s
    assert run.way_m(at_s, at_s + zero_s) <= expected.get("way_m", inf)
    found = run.first(at_s, held(expected.get("by", PAUSE)))
    assert found.verdict.severity is expected.get("severity", found.verdict.severity)
    assert found.verdict.signal in expected.get("signals", {found.verdict.signal})
    if until is to_its_end:  # held, with its cause, and not waiting for ever
        assert run.mission.state.is_faulted
        assert expected.get("cause", "") in text_of(run.mission.state.cause)
        fewest, most = expected.get("holds", (0, inf))
        assert fewest <= entered(run.seen, Mode.HELD) <= most
        assert run.first(at_s, held(HOLD)).t_s - at_s < expected.get("hold_s", inf)
        assert not run.robot.world.is_fallen
        assert run.robot.fans.duty == (1.0, 1.0) or row != "S25"
    measured(row, time_s if row == "S8" else 1e3 * time_s)


@pytest.mark.parametrize("rate", [8.0, slow_case(-8.0)])
def test_a_wheel_that_runs_away_while_its_encoder_is_slow(rate: float) -> None:
    times_s = []
    for at_s in (DRIVING_S + 0.01 * k for k in range(0, 20, 4)):  # between samples that are 0.03 s apart, or at one
        slow_ones = each(ENCODERS[::-1], f"slow at_s={at_s - 1.0} every=3")
        fault = f"left_wheel runaway at_s={at_s} for_s=0.4 rate_rad_s={rate}"
        run = watched(HARD, after(at_s + 0.61), *slow_ones, fault)
        times_s.append(run.time_to_zero_s(at_s))
        assert run.first(at_s, held(HOLD)).verdict.signal in RUNAWAYS
    assert mean(times_s) <= 0.15  # two faults at once: not the 0.1 s of one
    assert max(times_s) <= 0.15 + 0.03


@pytest.mark.fault("S19")
@pytest.mark.parametrize("hz", [100.0, slow_case(60.0), 40.0])
def test_a_sensor_that_chatters_holds(hz: float, measured: Measured) -> None:
    fault = f"edge_front_right intermittent at_s={DRIVING_S} period_s={1.0 / hz} duty=0.5 value=0.0"
    run = watched(HARD, lambda one: one.t_s > DRIVING_S and one.is_zero, fault)
    assert run.seen[-1].t_s - DRIVING_S <= 0.2
    measured("S19", 1e3 * (run.seen[-1].t_s - DRIVING_S))


@pytest.mark.fault("S33")
@pytest.mark.parametrize(
    ("signals", "by_s"),
    [(INERTIAL, 0.035), slow_case(INERTIAL, 0.05), (INERTIAL, 0.1), (ENCODERS, 0.05), slow_case(ENCODERS, 0.1)],
)
def test_sensors_with_wrong_time_stamps_hold(signals: tuple[str, ...], by_s: float, measured: Measured) -> None:
    run = watched(HARD, held(HOLD), *each(signals, f"delayed at_s=0.0 by_s={by_s} stamps='fresh'"))
    last = run.seen[-1]
    assert last.verdict.severity is Severity.HOLD
    assert not run.mission.state.points.done
    if signals is INERTIAL:  # encoders that are late also disagree with the set points
        assert last.verdict.cause.condition == TURN_TIMES_DIFFER.name
        assert last.verdict.limit < last.verdict.value < by_s + 0.015  # a lower bound: turns hardly last longer
    turning_s = sum(b.t_s - a.t_s for a, b in pairwise(run.seen) if a.state is Mode.TURNING)
    measured("S33", turning_s)
    assert turning_s < 2.0


@pytest.mark.fault("S34")
@pytest.mark.parametrize("by_s", [0.05, 0.1])
def test_inertial_samples_that_arrive_late_are_left_out(by_s: float, measured: Measured) -> None:
    late = each(INERTIAL, f"delayed at_s={DRIVING_S} by_s={by_s} stamps='old'")
    run = watched(HARD, lambda one: slow(one) and one.t_s > DRIVING_S, *late)
    assert run.seen[-1].verdict.cause.condition == IMU_LEFT_OUT.name
    measured("S34", 1e3 * (run.seen[-1].t_s - DRIVING_S))
    assert run.seen[-1].t_s - DRIVING_S < 0.25


@pytest.mark.fault("S24")
def test_a_sensor_that_goes_off_in_a_turn_stops_the_turn(measured: Measured) -> None:
    at_s = TURNING_S + 0.3
    fault = f"edge_front_right stuck at_s={at_s} value=0.0"
    run = watched(HARD, lambda one: one.t_s > at_s and one.drive[0] - one.drive[1] <= 0.0, fault)
    declared = run.first(at_s, lambda one: one.verdict.code == 1)
    assert run.seen[-1].t_s - declared.t_s <= 0.1
    assert run.seen[-1].t_s - at_s <= 0.2  # over a seam the sensor may sweep its width first
    measured("S24", 1e3 * (run.seen[-1].t_s - declared.t_s))


# -- found as what it is -----------------------------------------------------------------------------------------------


@pytest.mark.fault("S2")
@pytest.mark.parametrize("at_s", [THESIS_DRIVING_S, THESIS_BRAKING_S, slow_case(7.3), 7.5])
def test_an_encoder_that_freezes_in_motion_is_found_at_the_stop(at_s: float, measured: Measured) -> None:
    run = watched(THESIS, held(), f"encoder_left stuck at_s={at_s}")
    verdict = run.seen[-1].verdict
    # Found as what it is, or before that because the gyroscope contradicts it.
    assert verdict.severity is HOLD
    assert verdict.signal in {"encoder_left", "imu_wz"}
    stopped = next((one.t_s for one in run.since(at_s) if one.is_zero), run.seen[-1].t_s)
    assert run.seen[-1].t_s - stopped <= 0.5
    measured("S2", 1e3 * (max(run.seen[-1].t_s - stopped, 0.0)))


@pytest.mark.fault("S2")
def test_an_encoder_frozen_at_the_stop(measured: Measured) -> None:
    run = watched(HARD, held(), f"encoder_left stuck at_s={STANDING_S} value=3.3")
    assert (run.seen[-1].verdict.severity, run.seen[-1].verdict.signal) == (HOLD, "encoder_left")
    assert "frozen" in text_of(run.seen[-1].verdict.cause)
    assert run.seen[-1].t_s - STANDING_S <= 0.5
    measured("S2", 1e3 * (run.seen[-1].t_s - STANDING_S))


@pytest.mark.fault("S6")
@pytest.mark.parametrize("factor", [0.0, 0.3])
def test_a_wheel_that_slips_holds_and_a_fix_follows(factor: float, measured: Measured) -> None:
    run = watched(HARD, after(DRIVING_S + 6.0), f"right_wheel slip at_s={DRIVING_S} for_s=1.0 factor={factor}")
    first = run.first(DRIVING_S, held(HOLD))
    assert first.verdict.signal == "imu_wz"
    assert any(one.state is Mode.MEASURING for one in run.since(first.t_s))
    assert run.way_m(DRIVING_S, first.t_s) < 0.05
    before = [one for one in run.since(DRIVING_S) if one.t_s < first.t_s]
    measured("S6", float(entered(before, Mode.MEASURING, Mode.SETTLING)))


@pytest.mark.fault("S7")
@pytest.mark.parametrize("speed_m_s", [0.002, slow_case(0.005), 0.02])
def test_wheels_that_creep_while_they_are_held(speed_m_s: float, measured: Measured) -> None:
    """The part of it that encoders see; a robot that glides on locked wheels shows at the next fix."""
    fault = f"right_wheel runaway at_s={STANDING_S} rate_rad_s={speed_m_s / 0.03}"
    run = watched(HARD, in_the_next(lambda one: one.verdict.severity is Severity.FAULT), fault)
    late_s = run.first(STANDING_S, held(HOLD)).t_s - (STANDING_S + 0.002 / speed_m_s)  # after 2 mm
    assert late_s <= 0.5
    assert text_of(run.seen[-1].verdict.cause) == "the right wheel turns while it is held"
    assert run.mission.state.full_fans
    assert run.mission.state.is_faulted
    measured("S7", 1e3 * max(late_s, 0.0))


@pytest.mark.parametrize("kind", ["sign=-1", "factor=0.5"])
def test_a_gyroscope_of_wrong_sign_or_scale_is_noticed_in_the_first_turn(kind: str) -> None:
    fault = f"imu_wz wrong at_s=2.0 {kind}"
    run = watched(HARD, lambda one: one.t_s > 2.0 and one.verdict.severity >= Severity.SLOW, fault)
    assert run.seen[-1].t_s < 4.5  # the turn is from 3.1 s to 4.5 s
    assert run.seen[-1].verdict.signal in {"imu", "imu_wz"}


@pytest.mark.fault("S9")
@pytest.mark.parametrize("fault", ["imu_wz stuck", "imu_ax stuck", "imu_wz stuck value=34.9"])
def test_an_inertial_unit_that_repeats_itself_is_not_used(fault: str, measured: Measured) -> None:
    run = watched(HARD, after(DRIVING_S + 1.2), f"{fault} at_s={DRIVING_S}")
    first = run.first(DRIVING_S, slow)
    assert first.t_s - DRIVING_S <= 0.2 + 0.011  # and a frame on the link
    assert run.localizer.counts["imu_doubted"] > 50
    driven = [one for one in run.since(DRIVING_S + 1.0) if one.state is Mode.DRIVING]
    assert all(0.015 * abs(sum(one.drive)) < 0.07 for one in driven)  # on it goes, slowly
    measured("S9", 1e3 * (first.t_s - DRIVING_S))


@pytest.mark.fault("S16")
@pytest.mark.parametrize(
    ("signals", "seed"),
    [(ENCODERS, 1), slow_case(ENCODERS, 2), slow_case(ENCODERS, 3), (("edge_front_left",), 1), (("imu_wz",), 1)],
)
def test_a_slow_sensor_slows_the_robot(signals: tuple[str, ...], seed: int) -> None:
    cfg = one_panel(run__world="hard", run__seed=seed)
    run = watched(cfg, held(Severity.SLOW), *each(signals, f"slow at_s={DRIVING_S} every=3"))
    assert run.seen[-1].t_s - DRIVING_S <= 1.05
    # A few samples of an encoder that counts steps are no wheel that runs away.
    assert run.seen[-1].verdict.severity is Severity.SLOW


@pytest.mark.fault("S18")
@pytest.mark.parametrize("corner", ["front_left", slow_case("rear_right")])
def test_an_edge_sensor_that_stays_off_is_no_edge(corner: str, measured: Measured) -> None:
    run = watched(IMPATIENT, to_its_end, f"edge_{corner} stuck at_s={DRIVING_S} value=0.0")
    first = run.first(DRIVING_S, held(HOLD))
    assert first.verdict.signal == corner
    assert first.t_s - DRIVING_S <= 3.0
    assert entered(run.seen, Mode.BACKING_OFF) <= 2
    assert run.mission.state.is_faulted
    assert not run.robot.world.is_fallen
    measured("S18", first.t_s - DRIVING_S)


@pytest.mark.fault("S17")
def test_a_blind_edge_sensor_is_found_by_the_seams(measured: Measured) -> None:
    cfg = one_panel(run__world="hard", run__panels=0, run__order="optimised")
    run = watched(cfg, lambda one: one.verdict.severity is HOLD, "edge_front_left stuck at_s=1.0 value=1.0")
    last = run.seen[-1].verdict
    assert (last.signal, last.value) == ("front_left", 2.0)
    assert any(slow(one) and one.verdict.signal == "front_left" for one in run.seen)
    measured("S17", last.value)


@pytest.mark.fault("S28")
def test_a_robot_put_elsewhere_is_found_at_the_next_point(measured: Measured) -> None:
    fault = f"body kidnap at_s={DRIVING_S} dx_m=-0.03 dy_m=0.02 dheading_rad=0.0"
    run = watched(HARD, after(25.0), fault)
    assert run.injected[0].samples == 1
    assert len({one.estimate for one in run.seen if one.state is Mode.MEASURING}) > 1
    found = run.first(DRIVING_S + 0.1, lambda one: error_m(one) < 0.005)
    before = [one for one in run.since(DRIVING_S) if one.t_s < found.t_s]
    stops = entered(before, Mode.MEASURING, Mode.SETTLING)
    assert stops <= 1
    measured("S28", float(stops))


@pytest.mark.fault("F6")
@pytest.mark.parametrize("fault", ["soc stuck value=0.2", 'faults raise names=["battery_low"]'])
def test_a_low_battery_sends_the_robot_home(fault: str, measured: Measured) -> None:
    run = watched(HARD, to_its_end, f"{fault} at_s=3.0")
    home = run.first(3.0, lambda one: one.state is Mode.RETURNING)
    assert home.t_s - 3.0 < 5.5
    assert run.mission.state.outcome is SurveyOutcome.AT_BASE
    # The stand-in's charge stays what it was, so this is what is left at base, too.
    measured("F6", 100.0 * (0.2 if "soc" in fault else 1.0))


@pytest.mark.fault("L13")
@pytest.mark.parametrize(("delay_s", "severity"), [(0.02, 0), (0.06, Severity.SLOW), (0.12, Severity.PAUSE)])
def test_a_late_link_slows_the_robot_and_then_holds_it(delay_s: float, severity: int, measured: Measured) -> None:
    world = HARD.world.model_copy(update={"sensors_delay_s": delay_s, "commands_delay_s": delay_s})
    run = watched(HARD.model_copy(update={"world": world}), after(4.01))
    worst = max(one.verdict.severity for one in run.since(0.5))
    assert worst >= severity
    assert (worst == 0) == (severity == 0)
    fastest = max(0.015 * abs(sum(one.drive)) for one in run.since(0.8))
    if severity:
        assert fastest <= 0.07
    # What it still drives while nobody knows yet, and while the wheels run down.
    way_mm = 1e3 * fastest * (2.0 * delay_s + HARD.sim.robot.wheel_lag_s)
    assert way_mm <= 20.0
    measured("L13", way_mm)


# -- numbers, times and readings that cannot be ------------------------------------------------------------------------


@pytest.mark.fault("S4")
@pytest.mark.parametrize("token", ["NaN", slow_case("Infinity"), slow_case("1e999")])
def test_numbers_that_are_none_never_reach_the_filter(token: str, measured: Measured) -> None:
    fault = f'encoder_right non_finite at_s={DRIVING_S} for_s=0.3 token="{token}"'
    run = watched(HARD, after(DRIVING_S + 4.0), fault)
    # Without a frame there is no drive: the first one after the gap is zero, and a fix comes before the next motion.
    first = run.first(DRIVING_S + 0.15, lambda _: True)
    assert first.is_zero
    assert first.verdict.severity is HOLD
    assert all(abs(x) < 10.0 for one in run.seen for x in one.estimate)
    assert any(one.state is Mode.MEASURING for one in run.since(first.t_s))
    moved = [one.t_s for one in run.since(DRIVING_S) if one.t_s < first.t_s and not one.is_zero]
    measured("S4", 1e3 * (max(moved, default=DRIVING_S) - DRIVING_S))


@pytest.mark.fault("S4")
def test_three_lines_that_are_no_frames_within_a_tenth_of_a_second_hold(measured: Measured) -> None:
    # Four frames: no gap that would hold by itself.
    fault = f'encoder_right non_finite at_s={DRIVING_S} for_s=0.035 token="NaN"'
    run = watched(HARD, after(DRIVING_S + 4.0), fault)
    assert run.denied_s, "the permit stands"
    assert run.denied_s[0] <= DRIVING_S + 0.1
    first = run.first(DRIVING_S, held(HOLD))
    assert text_of(first.verdict.cause) == "lines of the robot were no frames"
    assert first.is_zero
    assert any(one.state is Mode.MEASURING for one in run.since(first.t_s))
    measured("S4", 1e3 * (run.denied_s[0] - DRIVING_S))


def test_two_lines_that_are_no_frames_cost_nothing() -> None:
    run = watched(HARD, after(DRIVING_S + 0.5), f'encoder_right non_finite at_s={DRIVING_S} for_s=0.005 token="NaN"')
    assert not run.denied_s
    assert all(one.verdict.severity < HOLD for one in run.seen)


@pytest.mark.fault("S5")
@pytest.mark.parametrize(
    "at_s", [DRIVING_S, slow_case(DRIVING_S + 0.07), DRIVING_S + 0.28, slow_case(DRIVING_S + 0.35)]
)
@pytest.mark.parametrize("kind", ["wrong offset=400.0", "garbage beyond=0.0"])
def test_no_reading_of_an_encoder_makes_the_pose_jump(kind: str, at_s: float, measured: Measured) -> None:
    run = watched(HARD, after(at_s + 0.6), f"encoder_left {kind} at_s={at_s} for_s=0.05")
    # Away from the robot: a step towards it is the correction, by readings that are right again.
    steps = [error_m(b) - error_m(a) for a, b in pairwise(run.since(1.0))]
    assert max(steps) <= 0.005
    assert error_m(run.seen[-1]) <= 0.010
    measured("S5", 1e3 * max(steps))


@pytest.mark.fault("S12")
@pytest.mark.parametrize(
    ("at_s", "by_s"),
    [
        (TURNING_S, 500.0),
        (STANDING_S, -3.0),
        *(slow_case(DRIVING_S, by_s) for by_s in (500.0, -3.0)),
        (DRIVING_S, 0.3),
    ],
)
def test_a_clock_that_jumps(by_s: float, at_s: float, measured: Measured) -> None:
    run = watched(HARD, after(at_s + 5.0), f"clock jump at_s={at_s} by_s={by_s}")
    assert not run.mission.state.is_faulted
    near = [one for one in run.since(at_s - 0.03) if one.t_s <= at_s + 0.1]
    travelled = [hypot(b.pose.x_m - a.pose.x_m, b.pose.y_m - a.pose.y_m) for a, b in pairwise(near)]
    beyond = max(steps_m(near)) - max(travelled)
    assert beyond <= 0.001
    assert any(map(is_moving, run.since(at_s + 0.5)))  # it goes on
    measured("S12", 1e3 * max(beyond, 0.0))


@pytest.mark.fault("S12")
@pytest.mark.parametrize("phase_s", [slow_case(0.0), slow_case(0.003), 0.007])
def test_a_clock_that_wraps_does_not_count_in_the_mission_time(phase_s: float) -> None:
    run = watched(HARD, after(12.0), f"clock wrap at_s=0.0 modulo_s={DRIVING_S + phase_s}")
    assert not run.mission.state.is_faulted
    assert run._time.offset_s == pytest.approx(DRIVING_S + phase_s, abs=0.011)  # one period, and one wrap only
    assert len(run.mission.state.points.done) >= 2


# -- what passes by ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fault", "until_s", "done"),
    [
        slow_case(f"encoder_right stuck at_s={DRIVING_S} for_s=1.0 value=0.0", 22.0, 3),  # a hold and a fix
        # A hold, a fix, and a leg that shows the heading again.
        pytest.param(f"right_wheel blocked at_s={DRIVING_S} for_s=1.5", 22.0, 3, marks=pytest.mark.fault("F8")),
        (f"edge_front_left stuck at_s={DRIVING_S} for_s=1.5 value=0.0", 20.0, 3),  # a back-off and a fix
        (f"imu_wz garbage at_s={TURNING_S} for_s=2.0 beyond=0.0", 20.0, 4),
    ],
)
def test_what_is_over_soon_does_not_end_the_mission(fault: str, until_s: float, done: int) -> None:
    run = watched(HARD, after(until_s), fault)
    assert not run.mission.state.is_faulted
    assert len(run.mission.state.points.done) >= done
    assert max(map(error_m, run.since(TURNING_S))) < 0.02 or not fault.startswith("imu")


def test_a_battery_that_seems_low_for_a_moment_does_not() -> None:
    run = watched(HARD, after(10.0), "soc stuck at_s=3.0 for_s=2.0 value=0.0")
    assert not any(one.verdict.severity for one in run.since(1.0))


@pytest.mark.fault("S26")
@pytest.mark.parametrize("at_s", [DRIVING_S, slow_case(TURNING_S), STANDING_S])
def test_a_flash_of_light_aborts_nothing(at_s: float, measured: Measured) -> None:
    run = watched(HARD, after(at_s + 9.0), *each(EDGES, f"stuck at_s={at_s} for_s=1.9 value=0.0"))
    assert not run.mission.state.is_faulted
    assert any(map(is_moving, run.since(at_s + 2.0)))
    measured("S26", float(run.mission.state.is_faulted))


# -- fans on an overhanging mirror -------------------------------------------------------------------------------------

OVERHANG = one_panel(run__mirror="fyst-m2", run__world="hard")
FANS_S = 4.0


def with_fans(cfg: Any, fault: str) -> Watched:
    return watched(cfg, after(FANS_S + 1.01), f"{fault} at_s={FANS_S}")


@pytest.mark.fault("F1", "F5")
@pytest.mark.parametrize(
    "fault", ["fans stuck value=0.3", "fans wrong factor=0.7", *(f'faults raise names=["fan_{s}"]' for s in SIDES)]
)
def test_a_fan_that_gives_too_little_holds_with_full_fans(fault: str, measured: Measured) -> None:
    run = with_fans(OVERHANG, fault)
    first = run.first(FANS_S, lambda one: one.verdict.severity is Severity.FAULT)
    assert first.is_zero
    assert run.mission.state.is_faulted
    assert "fan" in text_of(run.mission.state.cause)
    assert run.mission.state.full_fans
    assert run.parts.thrust.duty == (1.0, 1.0)  # sent; the rehearsal of a faulted mission ends before it arrives
    # The echo has to be low for 0.1 s; what counts is how long after that the wheels get their zero.
    late_s = first.t_s - FANS_S - (0.1 if "faults" not in fault else 0.0)
    assert late_s <= 0.1
    for row in ("F1", "F5"):
        measured(row, 1e3 * late_s)


@pytest.mark.fault("F2")
def test_fans_that_get_weaker_send_the_robot_home_in_time(measured: Measured) -> None:
    run = with_fans(OVERHANG, "fans wrong factor=0.91")
    assert run.seen[-1].state is Mode.RETURNING
    assert run.robot.fans.duty == (1.0, 1.0)
    measured("F2", 0.91 * OVERHANG.robot.fan_duty[0] / OVERHANG.sim.robot.fan_floor)


def test_a_robot_that_falls_because_a_fan_lost_its_thrust_is_found_in_the_next_frame() -> None:
    cfg = config_of("fyst-m2", run__panels=1, mission__calibration_length_m=0.0)
    run = SilRun(cfg, parse_plan('[[fault]]\nsignal = "left_fan"\ntype = "weak"\nat_s = 12.0\nshare = 0.4', "plan"))
    found = run.run()
    state = run.mission.state
    assert (run.robot.world.fall, found.summary["danger"]["falls"]) == ("thrust", 1)
    assert (state.is_faulted, state.cause.condition) == (True, "lifted")
    limit_s = cfg.health.lifted_limit_s + cfg.sim.robot.fall_thrust_s
    assert found.summary["mission_time_s"] - 12.0 == pytest.approx(limit_s, abs=0.05)  # five frames


def test_a_weak_fan_is_only_reported_where_the_mirror_does_not_overhang() -> None:
    run = with_fans(HARD, 'faults raise names=["fan_left"]')
    assert run.seen[-1].verdict.severity is Severity.INFORM
    assert run.seen[-1].verdict.forward
    assert not run.mission.state.is_faulted


@pytest.mark.fault("F3")
@given(st.lists(st.tuples(st.floats(), st.floats()) | st.tuples(st.floats(0.0, 1.0), st.floats(0.0, 1.0))))
def test_no_sequence_of_commands_undercuts_the_floor(commands: list[tuple[float, float]]) -> None:
    gate, duty, refused = FanGate(0.6), (0.6, 0.6), 0
    for command in commands:
        is_refused = gate.refusal(*command) is not None
        duty, refused = duty if is_refused else command, refused + is_refused
        assert 0.6 <= min(duty) <= max(duty) <= 1.0
    assert gate.refused == refused
