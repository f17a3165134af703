"""The limits of a robot: the same ones for each client, server, configuration, and the conformance suite."""

import asyncio
from contextlib import suppress
from typing import Any

import pytest
from msgspec.structs import replace

from ccatp.beacons.config.load import load_radio_config
from ccatp.beacons.sim.robot import build_beacon_robot
from ccatp.commissioning.conformance.harness import CheckFailed, Facts, parse
from ccatp.commissioning.probes import probe_robot
from ccatp.config.load import load_config, load_onboard_config
from ccatp.config.robot_limits import (
    FRAME_HZ,
    TOP_SPEED_M_S,
    TTL_S,
    VEHICLE_FRAME_HZ,
    WHEEL_BASE_M,
    WHEEL_RADIUS_M,
    Limits,
    hello_problems,
)
from ccatp.daemon.loops.robot_session import RobotSession, SessionHandler
from ccatp.errors import ConfigError
from ccatp.links.robot_codec import encode
from ccatp.links.robot_link import ImpossibleRobot
from ccatp.links.robot_messages import Hello, Joined
from tests.faults.linking import Measured
from tests.support.daemon import HELLO
from tests.support.scenario import boot, config_of, mirror_of, radio_config_of
from tests.support.sockets import scripted

# By the name in the hello. Beyond: a hair; allowed: the limit itself.
LIMITS = {"ttl_s": TTL_S, "frame_hz": FRAME_HZ, "wheel_radius_m": WHEEL_RADIUS_M, "wheel_base_m": WHEEL_BASE_M,
          "top_speed_m_s": TOP_SPEED_M_S}  # fmt: skip
CASES = [(name, side, is_beyond) for name in LIMITS for side in ("low", "high") for is_beyond in (True, False)]
BEACONS = build_beacon_robot(radio_config_of()).hello(boot=1, nonce="0" * 32, auth="none", lockstep=False)


def value_at(limits: Limits, side: str, *, is_beyond: bool) -> float:
    share = 1e-3 if is_beyond else -1e-9
    return limits.low * (1.0 - share) if side == "low" else limits.high * (1.0 + share)


def with_value(hello: Hello, name: str, value: float) -> Hello:
    """A hello with one value changed; the top speed stays as it is with another wheel radius."""
    robot = hello.robot
    if name in {"ttl_s", "frame_hz"}:
        return replace(hello, **{name: value})
    if name == "wheel_base_m":
        return replace(hello, robot=replace(robot, wheel_base_m=value))
    if name == "wheel_radius_m":
        return replace(hello, robot=replace(robot, wheel_radius_m=value, max_wheel_rad_s=0.24 / value))
    return replace(hello, robot=replace(robot, max_wheel_rad_s=value / robot.wheel_radius_m))


# No frame comes.
NOTHING = SessionHandler(on_sensors=lambda *_: None, on_joined=lambda _: None, on_lost=lambda _: None)


async def is_joined(hello: Hello) -> bool:
    """Whether both clients of the mission join a robot; they agree."""
    joins = 0

    async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        nonlocal joins
        writer.write(encode(hello))
        line = await reader.readline()
        if line:
            joins += 1
            writer.write(encode(Joined(role="monitor" if b'"monitor"' in line else "controller", session=joins)))
            await reader.read()

    async with scripted(talk) as port:
        cfg = load_config(overrides={"robot.port": port, "robot.reconnect_timeout_s": 20.0})
        for role, is_patient in (("controller", False), ("monitor", True)):  # the patient one tries only once, too
            client = RobotSession(cfg.robot, role, "test", NOTHING)  # type: ignore[arg-type]
            with suppress(ImpossibleRobot):
                async with asyncio.timeout(5.0):
                    await client.join(is_patient=is_patient)
            client.leave()
    assert joins in {0, 2}
    return joins == 2


@pytest.mark.fault("L18")
@pytest.mark.parametrize("among_beacons", [False, True])
async def test_a_client_joins_a_robot_within_the_limits_and_no_other(among_beacons: bool, measured: Measured) -> None:
    wrong = []
    for name, side, is_beyond in CASES:
        limits = VEHICLE_FRAME_HZ if among_beacons and name == "frame_hz" else LIMITS[name]
        hello = with_value(BEACONS if among_beacons else HELLO, name, value_at(limits, side, is_beyond=is_beyond))
        if await is_joined(hello) is is_beyond:
            wrong.append((name, side, is_beyond))
    assert not wrong
    measured("L18", 100.0 * (1.0 - len(wrong) / len(CASES)))


@pytest.mark.fault("L18")
@pytest.mark.parametrize("value", [0.0, -1.0])
@pytest.mark.parametrize("name", ["ttl_s", "frame_hz", "wheel_radius_m", "wheel_base_m", "max_wheel_rad_s"])
async def test_a_value_that_is_not_positive_is_refused_by_its_name_as_well(name: str, value: float) -> None:
    is_own = name in {"ttl_s", "frame_hz"}
    hello = replace(HELLO, **{name: value}) if is_own else replace(HELLO, robot=replace(HELLO.robot, **{name: value}))
    assert not await is_joined(hello)


@pytest.mark.fault("L18")
@pytest.mark.parametrize(("name", "side", "is_beyond"), CASES)
def test_the_conformance_suite_has_the_same_limits(name: str, side: str, is_beyond: bool) -> None:
    hello: dict[str, Any] = {"lockstep": False, "frame_hz": 100.0, "ttl_s": 0.25}
    hello["robot"] = {"wheel_radius_m": 0.03, "wheel_base_m": 0.15, "max_wheel_rad_s": 8.0, "fan_floor": 0.0}
    reported = with_value(HELLO, name, value_at(LIMITS[name], side, is_beyond=is_beyond))
    hello |= {key: getattr(reported, key) for key in ("frame_hz", "ttl_s")}
    hello["robot"] |= {
        key: getattr(reported.robot, key) for key in ("wheel_radius_m", "wheel_base_m", "max_wheel_rad_s")
    }
    if is_beyond:
        with pytest.raises(CheckFailed):
            parse(Facts, hello)
    else:
        assert parse(Facts, hello).ttl_s == reported.ttl_s


def load(kind: str, overrides: dict[str, object]) -> object:
    if kind == "onboard":
        return load_onboard_config(overrides=overrides)
    return load_config(overrides=overrides) if kind == "survey" else load_radio_config(None, overrides)


# What is not a key of [robot] with the name in the hello.
KEYS = {
    "survey": {"ttl_s": "sim.robot.ttl_s", "frame_hz": "sim.robot.frame_hz"},
    "onboard": {"ttl_s": "link.ttl_s", "frame_hz": "link.frame_hz"},
    "beacons": {"ttl_s": "sim.robot.ttl_s", "wheel_base_m": "vehicle.track_m"},
}


@pytest.mark.fault("L18")
@pytest.mark.parametrize("kind", KEYS)
@pytest.mark.parametrize(("name", "side"), [(name, side) for name in LIMITS for side in ("low", "high")])
def test_no_configuration_has_a_robot_beyond_the_limits(kind: str, name: str, side: str) -> None:
    is_step = (kind, name) == ("beacons", "frame_hz")
    value = value_at(VEHICLE_FRAME_HZ if is_step else LIMITS[name], side, is_beyond=True)
    if is_step:
        overrides: dict[str, object] = {"run.step_s": 1.0 / value}
    elif name == "top_speed_m_s":
        overrides = {"robot.max_wheel_rad_s": value / (0.0975 if kind == "beacons" else 0.03)}
    else:
        overrides = {KEYS[kind].get(name, f"robot.{name}"): value}
    with pytest.raises(ConfigError, match=r"must be (less|greater) than or equal to|the robot link allows"):
        load(kind, overrides)


@pytest.mark.fault("L18")
async def test_the_refusal_names_the_robot_the_value_and_its_limits() -> None:
    async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(encode(replace(HELLO, ttl_s=0.001, frame_hz=1.0)))
        await reader.readline()

    async with scripted(talk) as port:
        client = RobotSession(load_config(overrides={"robot.port": port}).robot, "controller", "test", NOTHING)
        says = (
            rf"the robot at 127\.0\.0\.1:{port} cannot be driven: "
            r"frame_hz is 1 Hz, the robot link allows 20 to 200 Hz; "
            r"ttl_s is 0\.001 s, the robot link allows 0\.05 to 1 s; correct its firmware$"
        )
        with pytest.raises(ImpossibleRobot, match=says):
            await client.join(is_patient=False)


@pytest.mark.fault("L18")
async def test_the_check_before_a_mission_says_what_has_to_be_corrected() -> None:
    async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(encode(with_value(HELLO, "top_speed_m_s", 0.0003)))
        await reader.readline()

    async with scripted(talk) as port:
        cfg = load_config(overrides={"robot.port": port})
        found = {one.name: one for one in await probe_robot(cfg, mirror_of())}["robot link"]
    assert "is 0.0003 m/s, the robot link allows 0.02 to 1 m/s" in found.found
    assert "the robot's own configuration" in found.todo


def test_the_simulated_robots_are_within_the_limits() -> None:
    survey = boot(config_of(), mirror_of()).hello(boot=1, nonce="0" * 32, auth="none", lockstep=True)
    for hello in (survey, BEACONS):
        robot, timing = hello.robot, {"frame_hz": hello.frame_hz, "ttl_s": hello.ttl_s}
        names = ("wheel_radius_m", "wheel_base_m", "max_wheel_rad_s")
        sizes = {name: getattr(robot, name) for name in names}
        assert not hello_problems(**timing, **sizes, has_vehicle=robot.vehicle is not None)
