"""Every monitor of the package is registered, so that none is mute; a reset makes each of them like a new one."""

import ast
import inspect
import pkgutil
from collections import deque
from collections.abc import Iterator
from importlib import import_module
from typing import Any

import numpy as np
import pytest
from pydantic import BaseModel

import ccatp.safety
from ccatp.conditions.danger import FRAMES_LOST
from ccatp.config.models import Config
from ccatp.core import EdgeSample, GravitySample, ImuSample, WheelSample
from ccatp.links.robot_messages import CommandEcho, Sensors
from ccatp.links.topics import EstimateMessage
from ccatp.mirror.mirror import Mirror
from ccatp.safety.health_monitor import HealthMonitor
from ccatp.safety.monitor import Monitor
from ccatp.safety.robot_state_monitors import BatteryMonitor
from ccatp.safety.rules import SafetyRules


@pytest.fixture
def health(config: Config, mirror: Mirror) -> HealthMonitor:
    return HealthMonitor(config.health, config.danger, config.robot, mirror, lambda _: False)


def classes_of_the_package() -> Iterator[type]:
    for module in pkgutil.walk_packages(ccatp.safety.__path__, "ccatp.safety."):
        for one in vars(import_module(module.name)).values():
            if inspect.isclass(one) and one.__module__ == module.name:
                yield one


def unregistered(health: HealthMonitor, classes: Iterator[type]) -> set[type]:
    """The monitors among some classes that are not registered."""
    registered = {type(monitor) for monitor in health.monitors}
    return {one for one in classes if issubclass(one, Monitor) and one not in {Monitor, *registered}}


def test_every_monitor_of_the_package_is_registered(health: HealthMonitor) -> None:
    assert unregistered(health, classes_of_the_package()) == set()
    assert len(health.monitors) == 13


def test_a_monitor_that_is_not_registered_is_noticed(health: HealthMonitor) -> None:
    class Mute(Monitor):
        pass

    assert unregistered(health, iter([*classes_of_the_package(), Mute])) == {Mute}


def makes_findings(one: type) -> bool:
    calls = (node for node in ast.walk(ast.parse(inspect.getsource(one))) if isinstance(node, ast.Call))
    return any(isinstance(call.func, ast.Attribute) and call.func.attr == "found" for call in calls)


def test_a_class_that_makes_findings_is_a_monitor_or_judges_itself() -> None:
    makers = [one for one in classes_of_the_package() if makes_findings(one)]
    assert len(makers) >= 12
    assert [one.__name__ for one in makers if not issubclass(one, (Monitor, SafetyRules))] == []


def test_a_finding_of_each_monitor_is_a_finding_of_all(health: HealthMonitor) -> None:
    finding = FRAMES_LOST.found("frames", 1.0, 0.5)
    for monitor in health.monitors:
        health.reset()
        monitor.latch(1.0).see(0.0, finding)
        assert [one for each in health.monitors for one in each.findings(0.5)] == [finding]
        assert [one for each in health.monitors for one in each.findings(1.0)] == []


KEPT = {"bias_rad_s", "missed", "_blind", "_garbled_s"}
"""What a reset keeps on purpose, beside the finding about the battery."""


def state_of(value: Any) -> Any:
    """A value with all that it consists of; configuration, map and functions left out."""
    if isinstance(value, int | float | str | None):
        return value
    if isinstance(value, list | tuple | deque):
        return [state_of(one) for one in value]
    if isinstance(value, dict):
        return {name: state_of(one) for name, one in value.items()}
    if isinstance(value, BaseModel | Mirror) or callable(value):
        return None
    names = getattr(type(value), "__slots__", None) or vars(value)
    return {name: state_of(getattr(value, name)) for name in names if name not in KEPT}


def test_a_reset_makes_every_monitor_like_a_new_one(config: Config, mirror: Mirror) -> None:
    def build() -> HealthMonitor:
        return HealthMonitor(config.health, config.danger, config.robot, mirror, lambda _: False)

    new, used, rng = [state_of(one) for one in build().monitors], build(), np.random.default_rng(1)
    used.jumped(0.0, 1.0)
    for seq in range(1, 600):
        t_s = 0.01 * seq + 0.5 * (seq // 200)
        rates = rng.uniform(-3.0, 3.0, 2).tolist() if seq > 100 else (0.0, 0.0)
        enc = [WheelSample(t_s, *rates)] * (1 + 9 * (seq < 300))
        imu = [ImuSample(t_s - 0.001 * k, *rng.normal(0.0, 0.01, 2).tolist()) for k in range(4, -1, -1)]
        imu = [*imu, ImuSample(t_s, 4.0, 9.0 * (seq > 400))]
        edge = [EdgeSample(t_s, *rng.integers(0, 2, 4).tolist())]
        echo, faults = CommandEcho(seq - 30, 0.3 * (seq > 500), 0.0, False), ["stall", "fan_left"]
        gravity = GravitySample(t_s, 0.9, 0.0, 0.3)
        frame = Sensors(seq, t_s, imu, enc, edge, gravity, (0.1, 0.1), 0.01, echo, faults)
        estimate = EstimateMessage(
            seq=seq, t_s=t_s, x_m=0.01 * seq, y_m=0.0, heading_rad=0.0, sigma_m=1e-4, state="driving",
            commanded=(0.5, 1.0, 0.5, 1.0), drive_seq=seq, grip=1.01,
        )  # fmt: skip
        used.learn(t_s, estimate, (0, 0, 0, 0), (None, None, None, None))
        used.step(t_s, frame, enc, edge, is_permitted=True, is_any_off=True)
    used.limit_wheels(1.0)
    for monitor, before in zip(used.monitors, new, strict=True):
        assert state_of(monitor) != before, type(monitor).__name__
    used.reset()
    for monitor, before in zip(used.monitors, new, strict=True):
        if isinstance(monitor, BatteryMonitor):
            assert monitor.finding is not None
            monitor.finding = None
        assert state_of(monitor) == before, type(monitor).__name__
