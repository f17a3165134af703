"""The ladder of severities, and monitors that are silent as long as nothing is wrong."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ccatp.config.loader import load_config
from ccatp.danger import DangerMonitor
from ccatp.health.commanded import CommandSpan
from ccatp.health.findings import Finding
from ccatp.health.ladder import Ladder, denies, gravest
from ccatp.mirror.mirror import build_mirror
from ccatp.samples import Severity
from ccatp.sim.robot import Robot
from ccatp.wire.topics import Estimate, is_estimate_due

HEALTH = load_config().health
DENYING = {Severity.PAUSE, Severity.HOLD, Severity.FAULT}


def finding(severity: Severity, signal: str = "x") -> Finding:
    return Finding(severity, str(severity), signal, 1.0, 0.0)


FINDINGS = st.lists(st.builds(finding, st.sampled_from(list(Severity)[1:]), st.sampled_from(["a", "b", "c"])))


@given(FINDINGS)
def test_the_gravest_wins_and_any_hold_denies(findings: list[Finding]) -> None:
    top = gravest(findings)
    assert (top is None) == (not findings)
    if top is not None:
        assert top.severity == max(one.severity for one in findings)
        assert top is next(one for one in findings if one.severity == top.severity)
    assert denies(findings) == any(one.severity in DENYING for one in findings)


@given(st.lists(st.tuples(st.floats(0.01, 5.0), FINDINGS), max_size=20))
def test_the_ladder_only_ever_raises(steps: list[tuple[float, list[Finding]]]) -> None:
    ladder, t_s = Ladder(HEALTH), 0.0
    for dt_s, findings in steps:
        t_s += dt_s
        for before, after in zip(findings, ladder.climb(t_s, findings), strict=True):
            assert after.severity >= before.severity
            assert after.severity is before.severity or before.severity in DENYING
            assert after.signal == before.signal


def test_a_pause_becomes_a_hold_and_a_hold_a_fault() -> None:
    ladder, pause = Ladder(HEALTH), finding(Severity.PAUSE)
    ends = [(0.0, Severity.PAUSE), (HEALTH.pause_limit_s, Severity.HOLD), (HEALTH.hold_limit_s, Severity.FAULT)]
    assert [ladder.climb(t_s, [pause])[0].severity for t_s, _ in ends] == [severity for _, severity in ends]
    ladder.climb(40.0, [])
    assert ladder.climb(41.0, [pause])[0].severity is Severity.PAUSE


@pytest.mark.parametrize(("gap_s", "last"), [(10.0, Severity.FAULT), (45.0, Severity.HOLD)])
def test_what_comes_again_and_again_is_a_fault(gap_s: float, last: Severity) -> None:
    ladder = Ladder(HEALTH)
    found = []
    for k in range(HEALTH.retries + 2):
        found.append(ladder.climb(k * gap_s, [finding(Severity.HOLD)])[0].severity)
        ladder.climb(k * gap_s + 1.0, [])
    assert found[:-1] == [Severity.HOLD] * (HEALTH.retries + 1)
    assert found[-1] is last


TWISTS = st.lists(st.tuples(st.floats(-0.1, 0.1), st.floats(-1.0, 1.0), st.integers(20, 60)), min_size=1, max_size=4)


@settings(max_examples=12, deadline=None)
@given(st.sampled_from(["thesis", "thesis-x2", "hard", "extreme"]), TWISTS, st.integers(0, 1000))
def test_monitors_are_silent_where_nothing_is_wrong(
    world: str, twists: list[tuple[float, float, int]], seed: int
) -> None:
    cfg = load_config(overrides={"run.world": world})
    mirror = build_mirror(cfg.mirror)
    robot = Robot(cfg, mirror, np.random.default_rng(seed))
    robot.join_controller()
    robot.join_monitor()
    robot.world.plant.place(0.3, 0.3, 0.1 * seed)
    robot._sensors.edges.place(robot.world.plant)
    robot.command_fans(1, *cfg.robot.fan_duty)
    monitor = DangerMonitor(mirror, cfg.robot, cfg.danger, cfg.health)
    span, estimate, number, radius_m = CommandSpan(), None, 0, cfg.robot.wheel_radius_m
    v = omega = 0.0
    wanted = [(0.0, 0.0)] * 60 + [(a, b) for a, b, count in twists for _ in range(count)] + [(0.0, 0.0)] * 60
    driven = (0.0, 0.0)
    for v_wanted, omega_wanted in wanted:
        robot.advance()
        frame = robot.delivered
        if frame is None:
            continue
        verdict = monitor.step(frame, estimate)
        assert estimate is None or verdict.severity is Severity.NONE, verdict
        v += min(max(v_wanted - v, -0.0025), 0.0025)  # the limits of the accelerations, with the gate's headroom
        omega += min(max(omega_wanted - omega, -0.025), 0.025)
        if is_estimate_due(frame.seq):
            pose = robot.world.plant.pose
            estimate = Estimate(
                seq=frame.seq, t_s=frame.t, x_m=pose.x_m, y_m=pose.y_m, heading_rad=pose.heading_rad, sigma_m=1e-3,
                state="driving", commanded=span.take(*driven), drive_seq=number,
            )  # fmt: skip
        number += 1
        half = 0.5 * omega * cfg.robot.wheel_base_m
        driven = (v + half) / radius_m, (v - half) / radius_m
        span.add(*driven)
        robot.drive(number, *driven)
        robot.permit(number, verdict.forward, verdict.reverse, verdict.turn)
