"""All findings of a frame count: none hides what another one denies, and the highest severity selects the reaction."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations, combinations_with_replacement
from math import nan

import pytest
from msgspec.structs import replace

from ccatp.conditions import Condition, MonitorFinding
from ccatp.config.models import Config
from ccatp.core import Cause, EdgeSample, EventCode, ImuSample, Severity, Verdict, WheelSample
from ccatp.danger import DangerMonitor
from ccatp.links.robot_messages import CommandEcho, Sensors
from ccatp.links.topics import EstimateMessage
from ccatp.mirror.mirror import Mirror
from ccatp.safety.escalation import FindingLatch, with_findings
from tests.support.rows import DANGER
from tests.support.scenario import world_of

CODES = {
    "normal": Verdict.normal(7, 0.07),
    "at an edge": Verdict(7, 0.07, EventCode.NEAR_EDGE, Cause("rim_ahead"), "front_left", 0.1, 0.0, False, True, False),
    "an emergency": Verdict(
        7, 0.07, EventCode.ABORTED, Cause("emergency", {"kind": "fire"}), "emergency:fire", 1.0, 0.0, True, True, True
    ),
}


def found(row: Condition) -> MonitorFinding:
    return MonitorFinding(row, row.severity, row.cause(), row.name, 2.0, 1.0, row.full_fans)


def denied(verdict: Verdict) -> tuple[bool, bool, bool]:
    return not verdict.forward, not verdict.reverse, not verdict.turn


@pytest.mark.parametrize("code", CODES)
def test_of_every_pair_of_conditions_each_keeps_its_denial_its_severity_and_its_fans(code: str) -> None:
    before = CODES[code]
    for pair in combinations_with_replacement(DANGER, 2):
        alone = [with_findings(before, [found(row)]) for row in pair]
        for order in (pair, pair[::-1]):
            both, what = with_findings(before, [found(row) for row in order]), [row.name for row in order]
            assert denied(both) == tuple(map(max, *map(denied, alone))), what
            assert both.severity is max(row.severity for row in pair), what
            assert both.full_fans is any(row.full_fans for row in pair), what
            assert (both.code, both.seq, both.t_s) == (before.code, before.seq, before.t_s), what


def test_a_latch_keeps_the_highest_severity_and_the_full_fans_of_two_findings() -> None:
    for first, second in combinations_with_replacement(DANGER, 2):
        for a, b in ((first, second), (second, first)):
            latch = FindingLatch(1.0)
            latch.see(0.0, found(a))
            latch.see(0.1, found(b))
            kept, what = latch.finding, (a.name, b.name)
            assert kept is not None
            assert kept.condition is (b if b.severity > a.severity else a), what
            assert kept.full_fans is (a.full_fans or b.full_fans), what


# -- whole frames -----------------------------------------------------------------------------------------------------

Change = Callable[[Sensors, EstimateMessage | None], tuple[Sensors, EstimateMessage | None]]


def frames_with(**fields: object) -> Change:
    return lambda frame, estimate: (replace(frame, **fields), estimate)


def estimates_with(**fields: object) -> Change:
    return lambda frame, estimate: (frame, None if estimate is None else replace(estimate, **fields))


def _wheels(frame: Sensors, estimate: EstimateMessage | None) -> tuple[Sensors, EstimateMessage | None]:
    return replace(frame, enc=[WheelSample(t, 9.0, 9.0) for t, _, _ in frame.enc]), estimate


def _turns(frame: Sensors, estimate: EstimateMessage | None) -> tuple[Sensors, EstimateMessage | None]:
    return replace(frame, imu=[ImuSample(t, ax, 2.0) for t, ax, _ in frame.imu]), estimate


def _off(*corners: int) -> Change:
    def change(frame: Sensors, estimate: EstimateMessage | None) -> tuple[Sensors, EstimateMessage | None]:
        edge = [EdgeSample(s.t_s, *(0 if k in corners else v for k, v in enumerate(s[1:]))) for s in frame.edge]
        return replace(frame, edge=edge), estimate

    return change


def _reported(name: str) -> Change:
    return lambda frame, estimate: (replace(frame, faults=[*frame.faults, name]), estimate)


CHANGES: dict[str, Change] = {
    "no edge samples": frames_with(edge=[]),
    "no encoder samples": frames_with(enc=[]),
    "no inertial samples": frames_with(imu=[]),
    "no estimate": lambda frame, _: (frame, None),
    "an old estimate": estimates_with(t_s=0.0),
    "an estimate that is no number": estimates_with(x_m=nan),
    "one sensor off": _off(0),
    "all sensors off": _off(0, 1, 2, 3),
    "wheels that run away": _wheels,
    "a turn that the wheels do not make": _turns,
    "a slide that the robot reports": frames_with(sliding=True),
    "a low battery": _reported("battery_low"),
    **{f"a reported fault of {name}": _reported(name) for name in ("encoder_left", "edge", "stall", "imu", "fan_left")},
}
EVENTS = ("fire", "earthquake")
DURATION_S = 0.6


@dataclass(frozen=True)
class Robot:
    """A robot that stands in the middle of a panel, and a danger loop with all monitors."""

    cfg: Config
    mirror: Mirror

    def suffer(self, *names: str) -> list[Verdict]:
        """The verdicts of the frames in which these things happen together, after a second without any."""
        monitor = DangerMonitor(self.mirror, self.cfg.robot, self.cfg.danger, self.cfg.health)
        panel, noise = list(self.mirror.panels.values())[40], 0
        verdicts = []
        for seq in range(1, 101 + round(DURATION_S / 0.01)):
            t, noise = 0.01 * seq, (noise * 1103515245 + 12345) % 2**31
            times = [t - 1e-3 * k for k in reversed(range(10))]
            imu = [ImuSample(t, 1e-3 * (noise % 7), 1e-4 * (noise % 11))]
            wheels, edges = [WheelSample(s, 0.0, 0.0) for s in times], [EdgeSample(s, 1, 1, 1, 1) for s in times]
            echo = CommandEcho(seq, 0.0, 0.0, False)
            frame = Sensors(seq, t, imu, wheels, edges, None, (0.8, 0.8), 1.0, echo, [])
            estimate: EstimateMessage | None = EstimateMessage(
                seq=seq, t_s=t, x_m=panel.x_m, y_m=panel.y_m, heading_rad=0.0, sigma_m=1e-4, state="driving",
                commanded=(0.0, 0.0, 0.0, 0.0), drive_seq=seq,
            )  # fmt: skip
            if seq > 100:
                for name in names:
                    if name in CHANGES:
                        frame, estimate = CHANGES[name](frame, estimate)
                    elif seq == 101:
                        assert monitor.emergency(name, "5e0f8f6e-8a8b-4a3e-9d5f-0c2d6b1a7e01") is None
            verdict = monitor.step(frame, estimate)
            if seq > 100:
                verdicts.append(verdict)
            else:
                assert denied(verdict) == (False, False, False)
        return verdicts


ORDER = {EventCode.NORMAL: 0, EventCode.ABORTED: 1, EventCode.NEAR_EDGE: 2}  # interface control document 5


@pytest.fixture(scope="module")
def robot() -> Robot:
    return Robot(*world_of("thesis-m1"))


@pytest.fixture(scope="module")
def alone(robot: Robot) -> dict[str, list[Verdict]]:
    return {name: robot.suffer(name) for name in (*CHANGES, *EVENTS)}


# Without its samples a sensor cannot contradict anything any more, so what it showed is not found.
BLINDS = {
    "no edge samples": {"one sensor off", "all sensors off"},
    "no encoder samples": {"wheels that run away", "a turn that the wheels do not make"},
    "no inertial samples": {"a turn that the wheels do not make"},
    # A sensor that is off is judged by the map, and one of four only while the others are on.
    "no estimate": {"one sensor off"},
    "an old estimate": {"one sensor off"},
    "an estimate that is no number": {"one sensor off"},
    "all sensors off": {"one sensor off"},
    "wheels that run away": {"a turn that the wheels do not make", "one sensor off"},
    "a turn that the wheels do not make": {"wheels that run away"},
}


def test_each_thing_alone_is_found(alone: dict[str, list[Verdict]]) -> None:
    silent = [name for name, verdicts in alone.items() if not any(verdict.cause for verdict in verdicts)]
    # Six tenths of a second are too short for these: a low battery is believed after five seconds.
    assert silent == ["a low battery"]


def test_two_things_at_once_deny_what_each_of_them_denies(robot: Robot, alone: dict[str, list[Verdict]]) -> None:
    for a, b in combinations(alone, 2):
        if b in BLINDS.get(a, ()) or a in BLINDS.get(b, ()):
            continue
        for k, (both, *each) in enumerate(zip(robot.suffer(a, b), alone[a], alone[b], strict=True)):
            what = a, b, k, both
            assert all(d >= max(ds) for d, *ds in zip(denied(both), *map(denied, each), strict=True)), what
            assert both.severity >= max(verdict.severity for verdict in each), what
            assert ORDER[both.code] >= max(ORDER[verdict.code] for verdict in each), what
            assert both.full_fans >= max(verdict.full_fans for verdict in each), what


def test_missing_encoder_samples_hold_until_a_fix_whatever_else_is_missing(robot: Robot) -> None:
    for other in ("no edge samples", "no inertial samples", "no estimate", "an old estimate"):
        assert robot.suffer("no encoder samples", other)[-1].severity >= Severity.HOLD, other
