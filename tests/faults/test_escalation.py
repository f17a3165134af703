"""The ladder of severities, and monitors that are silent as long as nothing is wrong."""

from collections import deque
from collections.abc import Callable

import msgspec
import numpy as np
import pytest
import zmq
from hypothesis import given, settings
from hypothesis import strategies as st

from ccatp.conditions import MonitorFinding, text_of
from ccatp.config.load import load_config
from ccatp.control.wheel_motion import SentDrives
from ccatp.core import Severity, Verdict
from ccatp.danger import DangerMonitor
from ccatp.links.bus import EstimateSubscriber
from ccatp.links.topics import EstimateMessage, is_estimate_due
from ccatp.mirror.mirror import build_mirror
from ccatp.safety.escalation import SeverityEscalation, denies, most_severe
from ccatp.sim.robot import Robot
from tests.support.rows import DANGER

HEALTH = load_config().health
DENYING = {Severity.PAUSE, Severity.HOLD, Severity.FAULT}


def finding(severity: Severity, signal: str = "x") -> MonitorFinding:
    """Of the first condition of that severity that has the configured limits."""
    rows = [row for row in DANGER if row.severity is severity and row.retries is None]
    return rows[0].found(signal, 1.0, 0.0)


FINDINGS = st.lists(st.builds(finding, st.sampled_from(list(Severity)[1:]), st.sampled_from(["a", "b", "c"])))


@given(FINDINGS)
def test_the_highest_severity_counts_and_any_hold_denies(findings: list[MonitorFinding]) -> None:
    top = most_severe(findings)
    assert (top is None) == (not findings)
    if top is not None:
        assert top.severity == max(one.severity for one in findings)
        assert top is next(one for one in findings if one.severity == top.severity)
    assert denies(findings) == any(one.severity in DENYING for one in findings)


@given(st.lists(st.tuples(st.floats(0.01, 5.0), FINDINGS), max_size=20))
def test_escalation_only_raises_the_severity(steps: list[tuple[float, list[MonitorFinding]]]) -> None:
    ladder, t_s = SeverityEscalation(HEALTH), 0.0
    for dt_s, findings in steps:
        t_s += dt_s
        for before, after in zip(findings, ladder.escalate(t_s, findings), strict=True):
            assert after.severity >= before.severity
            assert after.severity is before.severity or before.severity in DENYING
            assert after.signal == before.signal


def test_a_pause_becomes_a_hold_and_a_hold_a_fault() -> None:
    ladder, pause = SeverityEscalation(HEALTH), finding(Severity.PAUSE)
    ends = [(0.0, Severity.PAUSE), (HEALTH.pause_limit_s, Severity.HOLD), (HEALTH.hold_limit_s, Severity.FAULT)]
    assert [ladder.escalate(t_s, [pause])[0].severity for t_s, _ in ends] == [severity for _, severity in ends]
    ladder.escalate(40.0, [])
    assert ladder.escalate(41.0, [pause])[0].severity is Severity.PAUSE


@pytest.mark.parametrize(("gap_s", "last"), [(10.0, Severity.FAULT), (45.0, Severity.HOLD)])
def test_a_hold_that_repeats_becomes_a_fault(gap_s: float, last: Severity) -> None:
    ladder = SeverityEscalation(HEALTH)
    found = []
    for k in range(HEALTH.retries + 2):
        found.append(ladder.escalate(k * gap_s, [finding(Severity.HOLD)])[0].severity)
        ladder.escalate(k * gap_s + 1.0, [])
    assert found[:-1] == [Severity.HOLD] * (HEALTH.retries + 1)
    assert found[-1] is last


TWISTS = st.lists(st.tuples(st.floats(-0.1, 0.1), st.floats(-1.0, 1.0), st.integers(20, 60)), min_size=1, max_size=4)


def found_on_the_way(
    world: str,
    wanted: list[tuple[float, float]],
    seed: int,
    received: Callable[[list[EstimateMessage], int], EstimateMessage | None],
    dv_m_s: float = 0.0025,
) -> list[Verdict]:
    """Verdicts that found something while a robot is driven, and nothing is wrong.

    Args:
        world: the world.
        wanted: v (m/s) and omega (rad/s), frame by frame.
        seed: of the robot.
        heard: what the danger loop has heard by a frame, of the estimates that were told.
        dv_m_s: how much faster from frame to frame; by itself the limit of the acceleration, with the gate's headroom.
    """
    cfg = load_config(overrides={"run.world": world})
    mirror = build_mirror(cfg.mirror)
    robot = Robot(cfg, mirror, np.random.default_rng(seed))
    robot.join("controller")
    robot.join("monitor")
    robot.world.plant.place(0.3, 0.3, 0.1 * seed)
    robot._sensors.edges.place(robot.world.plant)
    robot.command_fans(1, *cfg.robot.fan_duty)
    monitor = DangerMonitor(mirror, cfg.robot, cfg.danger, cfg.health)
    sent, reported, number, radius_m = (
        SentDrives(cfg.robot, robot.frame_s),
        list[EstimateMessage](),
        0,
        cfg.robot.wheel_radius_m,
    )
    v = omega = 0.0
    found: list[Verdict] = []
    for v_wanted, omega_wanted in wanted:
        robot.advance()
        frame = robot.delivered
        if frame is None:
            continue
        estimate = received(reported, frame.seq)
        verdict = monitor.step(frame, estimate)
        if estimate is not None and verdict.severity is not Severity.NONE:
            found.append(verdict)
        v += min(max(v_wanted - v, -dv_m_s), dv_m_s)
        omega += min(max(omega_wanted - omega, -0.025), 0.025)
        if is_estimate_due(frame.seq):
            pose = robot.world.plant.pose
            reported.append(EstimateMessage(
                seq=frame.seq, t_s=frame.t, x_m=pose.x_m, y_m=pose.y_m, heading_rad=pose.heading_rad, sigma_m=1e-3,
                state="driving", commanded=sent.take_span(), drive_seq=number,
            ))  # fmt: skip
        number += 1
        half = 0.5 * omega * cfg.robot.wheel_base_m
        driven = (v + half) / radius_m, (v - half) / radius_m
        sent.add(number, *driven)
        robot.drive(number, *driven)
        robot.permit(number, verdict.forward, verdict.reverse, verdict.turn)
    return found


@settings(max_examples=12, deadline=None)
@given(st.sampled_from(["thesis", "thesis-x2", "hard", "extreme"]), TWISTS, st.integers(0, 1000))
def test_monitors_are_silent_where_nothing_is_wrong(
    world: str, twists: list[tuple[float, float, int]], seed: int
) -> None:
    wanted = [(0.0, 0.0)] * 60 + [(a, b) for a, b, count in twists for _ in range(count)] + [(0.0, 0.0)] * 60
    assert not found_on_the_way(world, wanted, seed, lambda reported, _: reported[-1] if reported else None)


class Waiting:
    """What main has published and the danger loop has not received yet."""

    def __init__(self, *_: object, **__: object) -> None:
        self.messages: deque[EstimateMessage] = deque()

    def receive(self, _timeout_s: float) -> tuple[str, bytes, EstimateMessage] | None:
        return ("estimate", b"", self.messages.popleft()) if self.messages else None

    def maintain(self) -> None:
        pass

    def close(self) -> None:
        pass


@pytest.mark.fault("P8")
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("frames", "dv_m_s", "heard_until"),
    [
        pytest.param(12, 0.0025, lambda k: 95 if 100 < k < 126 else k, id="when they are all but old"),
        pytest.param(2, 0.05, lambda k: 95 if 100 < k < 111 else k, id="several at once"),
    ],
)
def test_drives_that_the_danger_loop_receives_late_have_moved_the_wheels(
    frames: int, dv_m_s: float, heard_until: Callable[[int], int], seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A robot that has stood for long drives on for a moment, and the estimates of that wait for the danger loop."""
    monkeypatch.setattr("ccatp.links.bus.Subscriber", Waiting)
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    ear = EstimateSubscriber(context, "inproc://main")
    context.destroy()
    waiting: deque[EstimateMessage] = ear._subscriber.messages  # type: ignore[attr-defined]
    arrived = 0

    def received(reported: list[EstimateMessage], k: int) -> EstimateMessage | None:
        nonlocal arrived
        while arrived < len(reported) and reported[arrived].seq <= heard_until(k):
            waiting.append(reported[arrived])
            arrived += 1
        return ear.latest(k, is_lockstep=False)

    wanted = [(0.0, 0.0)] * 100 + [(0.1, 0.0)] * frames + [(0.0, 0.0)] * 188
    found = found_on_the_way("hard", wanted, seed, received, dv_m_s)
    assert arrived > 50
    assert not [text_of(one.cause) for one in found if "wheel" in text_of(one.cause)]


@pytest.mark.parametrize(
    ("seq", "t_s", "expected"), [(70, 0.7, [0.0, 4.0]), (99, 0.99, [0.0, 4.0]), (99, float("nan"), [0.0])]
)
def test_the_commanded_speed_of_the_wheels_counts_however_old_the_estimate(
    seq: int, t_s: float, expected: list[float]
) -> None:
    cfg = load_config()
    monitor = DangerMonitor(build_mirror(cfg.mirror), cfg.robot, cfg.danger, cfg.health)
    robot = Robot(cfg, build_mirror(cfg.mirror), np.random.default_rng(1))
    wheels = monitor._health._wheels  # type: ignore[union-attr]
    wheels.take_commands(0.5, (0.0, 0.0, 0.0, 0.0))
    while (frame := robot.delivered) is None or frame.seq < 100:
        robot.advance()
        if frame is not None and frame.seq < 99:
            monitor.step(frame, None)
    estimate = EstimateMessage(
        seq=seq, t_s=t_s, x_m=0.0, y_m=0.0, heading_rad=0.0, sigma_m=1e-3, state="driving",
        commanded=(0.0, 4.0, 0.0, 4.0), drive_seq=1,
    )  # fmt: skip
    for _ in range(3):
        monitor.step(frame, estimate)
        frame = msgspec.structs.replace(frame, seq=frame.seq + 1)
    assert [span.right_high / cfg.robot.wheel_radius_m for span in wheels.set_points] == expected
