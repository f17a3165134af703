"""Samples whose times cannot be are not used: their sensor is silent for the rules, and the times are reported."""

from collections.abc import Iterator
from math import inf, nan

import pytest
from msgspec.structs import replace

from ccatp.conditions import Condition, text_of
from ccatp.conditions.danger import EDGE_STALE, ENCODERS_STALE, SAMPLES_MISDATED
from ccatp.core import EdgeSample, GravitySample, ImuSample, Severity, Verdict, WheelSample
from ccatp.danger import DangerMonitor
from ccatp.links.robot_messages import CommandEcho, Sensors
from ccatp.links.topics import EstimateMessage
from ccatp.sensing.sample_times import LATEST_S, OLDEST_S, possible_samples, worst_offset_s
from tests.support.scenario import world_of


@pytest.mark.parametrize("offset_s", [-1.0, -0.5, 0.0, 0.0009])
def test_samples_with_possible_times_are_the_same_object(offset_s: float) -> None:
    samples = [WheelSample(5.0 + offset_s, 1.0, 1.0)]
    assert possible_samples(5.0, samples) is samples


@pytest.mark.parametrize("offset_s", [-5.0, -1.001, 0.0011, 0.4, 5.0, inf, -inf, nan])
def test_only_the_sample_with_an_impossible_time_is_not_used(offset_s: float) -> None:
    samples = [WheelSample(t, 1.0, 1.0) for t in (4.98, 5.0 + offset_s, 5.0)]
    assert possible_samples(5.0, samples) == [samples[0], samples[2]]


def test_the_worst_offset_has_the_sign_of_the_sample() -> None:
    samples = [ImuSample(t, 0.0, 0.0) for t in (4.0, 5.5, 2.0)]
    assert (worst_offset_s(5.0, samples), worst_offset_s(5.0, [])) == (-3.0, 0.0)
    assert (LATEST_S, OLDEST_S) == (0.001, 1.0)  # interface control document 1


def frames(wrong: str, offset_s: float | None, from_s: float = 1.0) -> Iterator[Verdict]:
    """Verdicts on a robot at rest whose samples of one sensor have wrong times from ``from_s`` on, or are missing."""
    cfg, mirror = world_of("thesis-m1")
    monitor = DangerMonitor(mirror, cfg.robot, cfg.danger, cfg.health)
    panel = list(mirror.panels.values())[40]
    for seq in range(1, 161):
        t = 0.01 * seq
        times = [t - 1e-3 * k for k in reversed(range(10))]
        late = times if t < from_s else [] if offset_s is None else [s + offset_s for s in times]
        stamps = {kind: late if kind == wrong else times for kind in ("imu", "enc", "edge", "gravity")}
        frame = Sensors(
            seq, t, [ImuSample(s, 1e-3 * (seq % 7), 1e-4 * (seq % 11)) for s in stamps["imu"][-1:]],
            [WheelSample(s, 0.0, 0.0) for s in stamps["enc"]], [EdgeSample(s, 1, 1, 1, 1) for s in stamps["edge"]],
            GravitySample(stamps["gravity"][-1], 0.0, 0.0, -1.0), (0.8, 0.8), 1.0,
            CommandEcho(seq, 0.0, 0.0, False), [],
        )  # fmt: skip
        estimate = EstimateMessage(
            seq=seq, t_s=t, x_m=panel.x_m, y_m=panel.y_m, heading_rad=0.0, sigma_m=1e-4, state="driving",
            commanded=(0.0, 0.0, 0.0, 0.0), drive_seq=seq,
        )  # fmt: skip
        verdict = monitor.step(frame, estimate)
        if t >= from_s:
            yield replace(verdict, raised=len([f for f in monitor.found if f.condition is SAMPLES_MISDATED]))


@pytest.mark.parametrize("offset_s", [-5.0, -1.02, 0.02, 0.4, 5.0])
@pytest.mark.parametrize(("kind", "row"), [("enc", ENCODERS_STALE), ("edge", EDGE_STALE)])
def test_a_sensor_whose_samples_have_impossible_times_is_silent(kind: str, row: Condition, offset_s: float) -> None:
    verdicts = list(frames(kind, offset_s))
    silent = list(frames(kind, None))
    permits = [[(v.forward, v.reverse, v.turn) for v in one] for one in (verdicts, silent)]
    assert permits[0] == permits[1]
    assert permits[0].index((False, False, False)) in (14, 15)  # the newest sample is then 0.15 s old
    assert verdicts[-1].cause == row.cause()
    assert all(verdict.raised for verdict in verdicts)
    assert verdicts[0].severity is Severity.INFORM


@pytest.mark.parametrize("offset_s", [-1.02, 0.4])
@pytest.mark.parametrize(("kind", "name"), [("imu", "accelerometer and gyroscope"), ("gravity", "gravity sensors")])
def test_other_samples_of_impossible_times_are_reported_and_not_used(kind: str, name: str, offset_s: float) -> None:
    verdicts = list(frames(kind, offset_s))
    assert all(verdict.raised for verdict in verdicts)
    way = "older than" if offset_s < 0.0 else "later than"
    assert text_of(verdicts[0].cause) == f"samples of the {name} are {way} their frame: not used"
    assert verdicts[0].value == pytest.approx(abs(offset_s), abs=0.01)
