"""Frames go on, but their samples do not support the pose: the robot stands, is located by a fix, and continues."""

from itertools import pairwise

import pytest

from ccatp.core import Severity
from ccatp.survey.events import Mode
from tests.faults.linking import Measured
from tests.support.cases import slow_case
from tests.support.scenario import one_panel
from tests.support.sim_survey import Seen, watched

# As in ``test_injected``.
DRIVING_S, TURNING_S = 7.5, 3.7
HARD = one_panel(run__world="hard")
ENCODERS = ("encoder_right", "encoder_left")
# One value of a sample of the inertial unit, or of the edge sensors, takes the whole sample away.
SILENT = {"all": ("imu_ax", *ENCODERS, "edge_rear_left"), "encoders and edges": (*ENCODERS, "edge_rear_left")}
# Long enough for the fix after the gap and the next point.
WATCHED_S = 12.0


def worst_arrival_mm(at_s: float, for_s: float, *faults: str) -> float:
    """The worst first arrival after a fault, mm; between the hold and the next fix the robot does not move."""
    run = watched(
        HARD,
        lambda one: one.t_s > at_s + for_s + WATCHED_S,
        *(f"{fault} at_s={at_s} for_s={for_s}" for fault in faults),
    )
    held = run.first(at_s, lambda one: one.verdict.severity >= Severity.HOLD)
    assert held.t_s - at_s < 0.2
    stands = run.first(held.t_s, lambda one: one.is_zero)
    moves = run.first(stands.t_s, lambda one: not one.is_zero)
    waiting = [one for one in run.since(stands.t_s) if one.t_s < moves.t_s]
    assert has_measured(waiting)
    arrivals = [row.distance_m for row in run.laser.stops if row.t_s > at_s and row.approach == 1]
    assert arrivals
    return 1e3 * max(arrivals)


def has_measured(seen: list[Seen]) -> bool:
    modes = [one.state for one in seen]
    return any(a is Mode.MEASURING and b is not a for a, b in pairwise([*modes, None]))


@pytest.mark.fault("S30")
@pytest.mark.parametrize(
    ("silent", "at_s", "for_s"),
    [
        ("all", DRIVING_S, 1.9),
        ("encoders and edges", TURNING_S, 0.5),
        slow_case("all", TURNING_S, 0.5),
        slow_case("encoders and edges", DRIVING_S, 0.5),
        slow_case("encoders and edges", TURNING_S, 1.9),
        slow_case("all", DRIVING_S, 0.5),
        slow_case("all", TURNING_S, 1.9),
        slow_case("encoders and edges", DRIVING_S, 1.9),
    ],
)
def test_after_a_gap_of_samples_the_robot_is_located_before_it_moves(
    silent: str, at_s: float, for_s: float, measured: Measured
) -> None:
    worst_mm = worst_arrival_mm(at_s, for_s, *(f"{signal} off" for signal in SILENT[silent]))
    assert worst_mm <= 10.0
    measured("S30", worst_mm)


@pytest.mark.fault("S31")
@pytest.mark.parametrize(
    ("by_s", "at_s"),
    [(-5.0, DRIVING_S), (0.4, TURNING_S), slow_case(-5.0, TURNING_S), slow_case(0.4, DRIVING_S)],
)
def test_samples_of_impossible_times_are_a_gap(by_s: float, at_s: float, measured: Measured) -> None:
    clocks = (f"{sensor}_clock jump by_s={by_s}" for sensor in ("encoder", "edge"))
    worst_mm = worst_arrival_mm(at_s, 1.9, *clocks)
    assert worst_mm <= 10.0
    measured("S31", worst_mm)


@pytest.mark.fault("F11")
@pytest.mark.parametrize(
    ("factor", "signals"),
    [
        (0.75, ("right_wheel", "left_wheel")),
        (1.25, ("right_wheel", "left_wheel")),
        (1.25, ("left_wheel",)),
        slow_case(0.5, ("right_wheel", "left_wheel")),
        slow_case(1.5, ("right_wheel", "left_wheel")),
    ],
)
def test_wheels_that_turn_at_a_wrong_multiple_are_held(
    factor: float, signals: tuple[str, ...], measured: Measured
) -> None:
    faults = (f"{signal} gain at_s=1.0 factor={factor}" for signal in signals)
    run = watched(HARD, lambda one: one.verdict.severity >= Severity.HOLD or one.t_s > 12.0, *faults)
    verdict = run.seen[-1].verdict
    assert verdict.severity >= Severity.HOLD
    assert verdict.signal in {"right_wheel", "left_wheel", "imu_wz"}
    begun_s = run.first(1.0, lambda one: not one.is_zero).t_s
    assert run.seen[-1].t_s - begun_s <= 1.0
    measured("F11", run.seen[-1].t_s - begun_s)
