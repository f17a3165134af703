"""Each condition of the danger loop in scripted frames: it is found, lasts, is over; which of two wins."""

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import combinations
from math import nan
from pathlib import Path
from typing import Any

import pytest

from ccatp.beacons.conditions import GROUP as BEACONS
from ccatp.conditions import (
    ALONE,
    TABLE,
    Condition,
    Group,
    Motion,
    Owner,
    all_conditions,
    fault,
    text_of,
)
from ccatp.conditions import danger as rows
from ccatp.core import EdgeSample, EventCode, ImuSample, Severity, Verdict, WheelSample
from ccatp.danger import DangerMonitor
from ccatp.links.robot_messages import CommandEcho, Sensors
from ccatp.links.topics import EstimateMessage
from ccatp.safety.escalation import most_severe
from tests.support.rows import DANGER
from tests.support.scenario import config_of, mirror_of

FRAME_S, SAMPLE_S = 0.01, 0.001
BEGIN_S = 3.0  # until then the robot is sound: rates, noise and set points are learned
LIMIT_S = 4.5  # instead of the configured ``hold_limit_s``
HEALTH = config_of("fyst-m2", health__hold_limit_s=LIMIT_S).health


@dataclass
class Frame:
    """What a frame says, and main with it; a fault changes some of it."""

    seq: int
    t_s: float
    number: int  # of frames since the fault began
    rates: tuple[float, float] = (0.0, 0.0)  # of the wheels, right and left, rad/s
    commanded: tuple[float, float, float, float] | None = (0.0, 0.0, 0.0, 0.0)
    noise: float = 1e-3
    wz_rad_s: float = 0.0
    imu_noise: float = 1e-4
    imu: int = 10
    enc: int = 10
    edge: int = 10
    off: tuple[int, ...] = ()
    fans: tuple[float, float] = (1.0, 1.0)
    soc: float = 1.0
    echoed: int = -2
    faults: tuple[str, ...] = ()
    x_m: float = 0.0
    sigma_m: float = 1e-4
    estimate_s: float | None = 0.0  # age
    is_dropped: bool = False


Change = Callable[[Frame], dict[str, Any]]


@dataclass
class Scripted:
    """A robot on the middle of a panel, and the monitor that judges it."""

    mirror: str = "fyst-m1"
    seq: int = 0
    offset_s: float = 0.0
    verdicts: list[Verdict] = field(default_factory=list)

    def __post_init__(self) -> None:
        cfg, mirror = config_of(self.mirror, health__hold_limit_s=LIMIT_S), mirror_of(self.mirror)
        self.monitor = DangerMonitor(mirror, cfg.robot, cfg.danger, cfg.health)
        self.radius_m, self.base_m = cfg.robot.wheel_radius_m, cfg.robot.wheel_base_m
        self.panel = min(mirror.panels.values(), key=lambda panel: panel.x_m**2 + panel.y_m**2)

    def run(self, until_s: float, change: Change = lambda _: {}, steady: Change = lambda _: {}) -> list[Verdict]:
        """Frames until then; returns their verdicts."""
        seen: list[Verdict] = []
        begin = self.seq
        while self.seq * FRAME_S < until_s:
            self.seq += 1
            frame = Frame(self.seq, self.seq * FRAME_S, self.seq - begin)
            for name, value in {**steady(frame), **change(frame)}.items():
                setattr(frame, name, value)
            if not frame.is_dropped:
                seen.append(self.monitor.step(self._sensors(frame), self._estimate(frame)))
        return seen

    def _sensors(self, frame: Frame) -> Sensors:
        t_s = frame.t_s + self.offset_s
        first_s = t_s - FRAME_S
        (right, left), jitter = frame.rates, [(-1.0) ** k * (1.0 + 1e-3 * (7 * frame.seq + k)) for k in range(1, 11)]
        states = [int(k not in frame.off) for k in range(4)]
        return Sensors(
            frame.seq,
            t_s,
            [
                ImuSample(first_s + k * SAMPLE_S, frame.imu_noise * z, frame.wz_rad_s + frame.imu_noise * z)
                for k, z in list(enumerate(jitter, 1))[: frame.imu]
            ],
            [
                WheelSample(first_s + k * SAMPLE_S, right + frame.noise * z, left + frame.noise * z)
                for k, z in list(enumerate(jitter, 1))[: frame.enc]
            ],
            [EdgeSample(first_s + k * SAMPLE_S, *states) for k in range(1, 11)][: frame.edge],
            None,
            frame.fans,
            frame.soc,
            CommandEcho(frame.seq if frame.echoed == -2 else frame.echoed, 0.0, 0.0, False),
            list(frame.faults),
        )

    def _estimate(self, frame: Frame) -> EstimateMessage | None:
        if frame.estimate_s is None:
            return None
        return EstimateMessage(
            seq=frame.seq - 1 - round(frame.estimate_s / FRAME_S), t_s=frame.t_s + self.offset_s - frame.estimate_s,
            x_m=self.panel.x_m + frame.x_m, y_m=self.panel.y_m, heading_rad=0.0, sigma_m=frame.sigma_m,
            state="driving", commanded=frame.commanded, drive_seq=frame.seq - 1,
        )  # fmt: skip


SPEED_RAD_S = 3.0
SPEED = (SPEED_RAD_S, SPEED_RAD_S)
TURN_RAD_S = 0.55  # of a body with one wheel at that speed and the other at rest, about
PER_WHEEL = 2.0 * TURN_RAD_S / SPEED_RAD_S  # of a body whose wheels turn against each other, per rate of one


def drives(frame: Frame) -> dict[str, Any]:
    """Straight on at one speed, with the set points of it."""
    return {"rates": SPEED, "commanded": (SPEED_RAD_S,) * 4} if frame.t_s > 0.5 else {}


def turns(frame: Frame, late_frames: int = 0) -> dict[str, Any]:
    """Turns on the spot to one side and to the other, with the set points of them."""
    right, late = _turn_at(frame.number), _turn_at(frame.number - late_frames)
    return {"rates": (right, -right), "commanded": (right, right, -right, -right), "wz_rad_s": PER_WHEEL * late}


def late_gyroscope(frame: Frame) -> dict[str, Any]:
    return turns(frame, late_frames=6)


def _turn_at(frame: int) -> float:
    """The right wheel's rate: a second of speeding up and slowing down, then as long a rest, and back."""
    at = frame % 400
    share = max(0.0, 1.0 - abs(at % 200 - 50) / 50)
    return SPEED_RAD_S * share * (1.0 if at < 200 else -1.0)


def stands(_: Frame) -> dict[str, Any]:
    return {}


def passes_panels(frame: Frame) -> dict[str, Any]:
    """By the estimate the robot goes to and fro over a seam."""
    return {"x_m": 0.3 - abs((0.5 * frame.number * FRAME_S) % 1.2 - 0.6)}


def always(**fields: Any) -> Change:
    return lambda _: fields


@dataclass
class Row:
    """How a condition is brought about.

    ``clears_s``: so long after the fault everything is permitted again; ``None`` where it is not. ``lasts``: it stays
    as long as the fault does, and its time limit comes.
    """

    condition: Condition
    change: Change
    steady: Change = stands
    cause: str = ""
    signal: str = ""
    clears_s: float | None = 4.0
    lasts: bool = True
    mirror: str = "fyst-m1"


SLOW_EDGES = "edge sensors deliver 100 samples/s, at least 200 are needed"
SLOW_ENCODERS = "wheel encoders deliver 20 samples/s, at least 80 are needed"

ROWS = [
    Row(rows.SENSOR_TOO_SLOW, always(edge=1), cause=SLOW_EDGES, signal="edge"),
    Row(rows.SENSOR_MUCH_TOO_SLOW, lambda frame: {"enc": frame.seq % 5 == 0}, drives, SLOW_ENCODERS, "enc"),
    Row(rows.ENCODER_BROKEN, always(rates=(SPEED_RAD_S, 0.0), noise=0.0), cause="the right encoder is frozen"),
    Row(rows.WHEEL_RUNS_AWAY, always(rates=(SPEED_RAD_S, 8.0)), drives, cause="the left wheel runs away", lasts=False),
    Row(
        rows.WHEEL_SPEED_WRONG, always(rates=(1.3 * SPEED_RAD_S, 1.3 * SPEED_RAD_S)), drives, signal="right_wheel",
        cause="turns 1.30 times as fast as commanded", lasts=False,
    ),
    Row(rows.WHEELS_STAND, always(rates=(0.0, 0.0)), drives, signal="encoders", lasts=False),
    Row(rows.ENCODER_COUNTS_NOTHING, always(rates=(0.0, SPEED_RAD_S)), drives, signal="encoder_right", lasts=False),
    Row(
        *(rows.WHEEL_BLOCKED, lambda _: {"rates": (SPEED_RAD_S, 0.0), "wz_rad_s": TURN_RAD_S}, drives),
        signal="left_wheel", lasts=False,
    ),
    Row(rows.WHEEL_CREEPS, always(rates=(0.1, 0.0)), cause="the right wheel turns while it is held", lasts=False),
    Row(rows.WHEEL_CREEPS_ON, always(rates=(0.1, 0.0)), cause="the right wheel turns while it is held"),
    Row(rows.WHEEL_DOES_NOT_STOP, always(rates=(0.0, 0.5)), signal="left_wheel", lasts=False),
    Row(rows.YAW_DISAGREES, always(wz_rad_s=0.4), drives, signal="imu_wz"),
    Row(
        rows.TURN_TIMES_DIFFER, late_gyroscope, turns, cause="the gyroscope shows turns", signal="imu_wz", clears_s=9.0,
        lasts=False
    ),
    Row(rows.FAN_TOO_LITTLE, always(fans=(0.1, 1.0)), cause="the left fan gives too little", mirror="fyst-m2"),
    Row(rows.FAN_WEAK, always(fans=(1.0, 0.7)), cause="the right fan gets weak", mirror="fyst-m2"),
    Row(rows.FAN_REPORTED, always(faults=("fan_left",)), cause="a fault of its left fan", mirror="fyst-m2"),
    Row(rows.FAN_REPORTED_ON_THE_FLAT, always(faults=("fan_right",)), signal="fan_right", ),
    Row(rows.DRIVES_TOO_LATE, lambda frame: {"echoed": frame.seq - 25}),
    Row(rows.DRIVES_LATE, lambda frame: {"echoed": frame.seq - 15}),
    Row(rows.CLOCK_JUMPED, lambda frame: {"t_s": frame.t_s + 1.0}, lasts=False),
    Row(rows.FRAMES_LOST, lambda frame: {"is_dropped": frame.number < 30}, lasts=False),
    Row(
        rows.EDGE_SENSOR_CHATTERS, lambda frame: {"off": (1,) if frame.number % 2 else ()}, signal="front_right",
    ),
    Row(rows.EDGE_SENSOR_FLASHES, always(off=(2,)), signal="rear_left", lasts=False),
    Row(rows.EDGE_SENSOR_STAYS_DARK, always(off=(2,)), signal="rear_left", lasts=False),
    Row(rows.IMU_LEFT_OUT, always(wz_rad_s=9.0), cause="the gyroscope's rate is impossible: not used"),
    Row(rows.SAMPLES_TOO_FEW, always(imu=5), signal="imu"),
    Row(rows.BATTERY_LOW, always(soc=0.01), signal="soc", clears_s=None),
    Row(rows.BATTERY_REPORTED, always(faults=("battery_low",)), signal="battery_low", clears_s=None),
    Row(rows.EDGE_SENSOR_BLIND, passes_panels, signal="front_left", lasts=False, clears_s=None),
    Row(rows.SEAM_MISSED, passes_panels, signal="front_left", lasts=False, clears_s=None),
    Row(rows.ENCODER_REPORTED, always(faults=("encoder_left",)), cause="the robot reports a fault of its left encoder"),
    Row(rows.EDGE_REPORTED, always(faults=("edge",))),
    Row(rows.STALL_REPORTED, always(faults=("stall",))),
    Row(rows.IMU_REPORTED, always(faults=("imu",))),
    Row(rows.UNKNOWN_REPORTED, always(faults=("mood",)), signal="mood"),
    Row(rows.EDGE_STALE, always(edge=0), signal="edge"),
    Row(rows.ENCODERS_STALE, always(enc=0), signal="enc"),
    Row(rows.NO_ESTIMATE, always(estimate_s=None), signal="estimate"),
    Row(rows.ESTIMATE_STALE, always(estimate_s=0.5), signal="estimate"),
    Row(rows.ESTIMATE_NOT_FINITE, always(sigma_m=nan), signal="estimate"),
    Row(rows.LIFTED, always(off=(0, 1, 2, 3)), signal="edge"),
]  # fmt: skip
NAMES = [row.condition.name for row in ROWS]


def is_found(verdict: Verdict, row: Row) -> bool:
    pattern = re.sub(r"\\{\w+\\}", ".+", re.escape(row.condition.message))
    is_it = re.match(pattern, text_of(verdict.cause)) is not None and row.cause in text_of(verdict.cause)
    return is_it and (not row.signal or verdict.signal == row.signal) and verdict.severity >= row.condition.severity


END_S = BEGIN_S + 1.25 * LIMIT_S


@pytest.mark.parametrize("row", ROWS, ids=NAMES)
def test_it_is_found_lasts_and_is_over(row: Row) -> None:
    condition, scripted = row.condition, Scripted(row.mirror)
    before = scripted.run(BEGIN_S, steady=row.steady)
    assert all(verdict.severity is Severity.NONE and verdict.forward for verdict in before[1:])
    seen = scripted.run(END_S, row.change, row.steady)
    found = [verdict for verdict in seen if is_found(verdict, row)]
    own = [verdict for verdict in found if verdict.severity is condition.severity]
    assert own[0].full_fans is condition.full_fans
    may_move = condition.motion is not Motion.NONE
    assert own[0].forward is own[0].reverse is own[0].turn is may_move
    if row.lasts:
        assert found == seen[-len(found) :]
        since_s = next(verdict.t_s for verdict in seen if verdict.signal == found[0].signal)
        graver = {
            verdict.severity: verdict.t_s - since_s for verdict in found[::-1] if verdict.severity != own[0].severity
        }
        assert graver == times_s(condition)
    after = scripted.run(END_S + (row.clears_s or 4.0), steady=row.steady)
    assert (after[-1].severity is Severity.NONE) is (row.clears_s is not None)
    assert after[-1].forward or row.clears_s is None


def times_s(condition: Condition) -> Any:
    """When the condition becomes graver, after its signal was found first."""
    times: dict[Severity, float] = {}
    if condition.escalates_to is not None:
        times[Severity.FAULT] = LIMIT_S  # also of what became a hold
        times[condition.raised_severity] = getattr(HEALTH, condition.limit.removeprefix("health."))
    return pytest.approx(times, abs=0.025)  # two frames: the monitors look at every second one


def test_a_sensor_that_was_slow_from_the_beginning_is_found() -> None:
    seen = Scripted().run(2.0, always(edge=1, imu=1, enc=1))
    assert (text_of(seen[-1].cause), seen[-1].severity, seen[-1].forward) == (SLOW_EDGES, Severity.SLOW, True)


def test_a_sensor_that_is_silent_is_not_slow() -> None:
    scripted = Scripted()
    seen = scripted.run(1.5)
    for begin_s in (2.0, 3.0, 4.0):
        seen += scripted.run(begin_s - 0.05, always(edge=0, enc=0, imu=0)) + scripted.run(begin_s + 0.5)
    causes = {text_of(verdict.cause) for verdict in seen}
    assert rows.ENCODERS_STALE.message in causes
    assert "deliver" not in "".join(causes)


def test_no_edge_sample_from_the_beginning() -> None:
    seen = Scripted().run(1.0, always(edge=0))
    assert {(text_of(verdict.cause), verdict.severity) for verdict in seen} == {("no edge samples", Severity.PAUSE)}


def test_no_frame_and_lines_that_are_none() -> None:
    scripted = Scripted()
    scripted.run(1.0)
    verdict = scripted.monitor.stale(100, 1.0)
    assert (text_of(verdict.cause), verdict.severity, verdict.forward) == (rows.NO_FRAME.message, Severity.PAUSE, False)
    found = [scripted.monitor.garbled(100, 1.0, 1.0 + 0.01 * k) for k in range(3)]
    assert found[:2] == [None, None]
    assert found[2] is not None
    assert (text_of(found[2].cause), found[2].severity) == (rows.LINES_GARBLED.message, Severity.HOLD)
    assert {text_of(verdict.cause) for verdict in scripted.run(2.5)} == {rows.LINES_GARBLED.message}
    assert scripted.run(4.0)[-1].severity is Severity.NONE


def test_a_sensor_that_stays_off_is_left_behind_with_the_edge() -> None:
    scripted = Scripted()
    scripted.run(BEGIN_S)

    def there_and_back(frame: Frame) -> dict[str, Any]:
        rate = SPEED_RAD_S if frame.number < 20 else -SPEED_RAD_S if frame.number < 90 else 0.0
        return {"off": (0,), "rates": (rate, rate), "commanded": (-SPEED_RAD_S, SPEED_RAD_S) * 2}

    seen = scripted.run(BEGIN_S + 1.5, there_and_back)
    causes = list(dict.fromkeys(text_of(verdict.cause) for verdict in seen if verdict.code is EventCode.NEAR_EDGE))
    assert causes == [rows.NO_SEAM.message, rows.EDGE_SENSOR_STAYS_OFF.message]
    assert (seen[-1].severity, seen[-1].signal) == (Severity.HOLD, "front_left")


ROOT = Path(__file__).parents[3]
ELSEWHERE = {
    "tests/unit/test_danger.py": (
        *(rows.RIM_AHEAD, rows.BEYOND_SEAM, rows.NO_SEAM, rows.OFF_WITHOUT_WHEELS, rows.CENTRE_NEAR_RIM),
        *(rows.ALL_OFF, rows.EARTHQUAKE, rows.EMERGENCY),
    ),
    "tests/unit/sensing/test_sample_times.py": (rows.SAMPLES_MISDATED,),
    "tests/unit/safety/test_grip_monitor.py": (
        rows.GRIP_LOST,
        rows.GRIP_LITTLE,
        rows.GRIP_TOO_LITTLE,
        rows.ACCELEROMETER_DIFFERENCES,
    ),
    "tests/unit/beacons/test_mission.py": tuple(row for row in DANGER if row.group == BEACONS),
}


def test_every_row_is_brought_about_here_or_in_the_named_tests() -> None:
    here = [row.condition for row in ROWS]
    source = Path(__file__).read_text(encoding="utf-8")
    alone = [row for row in DANGER if f"{row.name.upper()}.message" in source]
    alone += [row for row in DANGER if f'"{row.message}"' in source]
    elsewhere = [row for path in ELSEWHERE for row in ELSEWHERE[path]]
    assert set(DANGER) == {*here, *alone, *elsewhere}


def test_a_name_is_registered_once() -> None:
    with pytest.raises(ValueError, match="conditions: grip_lost is registered twice"):
        fault("grip_lost", Owner.MISSION, ALONE, Group.SURVEY, "again", "", "")
    assert TABLE["grip_lost"] is rows.GRIP_LOST


def test_only_conditions_that_are_reported_alone_have_equal_precedence() -> None:
    """A tie between findings of one frame is declared in no other way than by ``ALONE``."""
    numbers = [row.precedence for row in all_conditions() if row.precedence != ALONE]
    assert len(numbers) == len(set(numbers))
    assert {row.owner is Owner.DANGER for row in all_conditions() if row.precedence == ALONE} == {False}
    assert all(row.precedence != ALONE for row in DANGER)


def test_of_two_the_more_severe_counts_and_of_equal_ones_the_lowest_number() -> None:
    for first, second in combinations(DANGER, 2):
        found = first.found("a", 1.0, 0.0), second.found("b", 1.0, 0.0)
        winner = min(found, key=lambda one: (-one.severity, one.condition.precedence))
        assert most_severe(found) is most_severe(found[::-1]) is winner, f"{first.name} and {second.name}"


def test_what_the_gyroscope_shows_at_rest_is_no_turn_afterwards() -> None:
    robot = Scripted()
    biased = always(wz_rad_s=0.25)
    seen = robot.run(4.0, biased)[10:] + robot.run(8.0, biased, drives)  # the first frames have no estimate
    assert {text_of(verdict.cause) for verdict in seen} == {""}


@pytest.mark.parametrize("row", all_conditions(), ids=lambda row: row.name)
def test_a_condition_that_pauses_holds_or_is_a_fault_permits_no_motion(row: Condition) -> None:
    """Also if its severity was raised: the denials of a frame follow from the permitted motion of each row."""
    if {row.severity, row.raised_severity} & {Severity.PAUSE, Severity.HOLD, Severity.FAULT}:
        assert row.motion is Motion.NONE
