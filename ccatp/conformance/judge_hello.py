"""Pure. Judges of the hello."""

import re
from collections.abc import Sequence
from typing import Any

from ccatp.conformance.reading import Message, is_number, is_numbers, is_whole
from ccatp.conformance.verdict import require
from ccatp.wire.robot_messages import AUTH_HMAC, AUTH_NONE, PROTOCOL

_NONCE = re.compile(r"[0-9a-fA-F]{32}")
_POSITIVE = ("wheel_radius_m", "wheel_base_m", "max_wheel_rad_s")


def judge_fields(hello: Message) -> str:
    """Fields of the hello beside ``robot``, with their types.

    Raises:
        Broken: one is not as promised.
    """
    _right(hello, "protocol", hello.get("protocol") == PROTOCOL)
    _right(hello, "boot", is_whole(hello.get("boot")))
    _right(hello, "nonce", isinstance(hello.get("nonce"), str) and bool(_NONCE.fullmatch(hello["nonce"])))
    _right(hello, "auth", hello.get("auth") in {AUTH_NONE, AUTH_HMAC})
    _right(hello, "lockstep", isinstance(hello.get("lockstep"), bool))
    for name in ("frame_hz", "ttl_s"):
        _right(hello, name, is_positive(hello.get(name)))
    return f"{hello['protocol']}, auth {hello['auth']}, {hello['frame_hz']:g} Hz, ttl {hello['ttl_s']:g} s"


def judge_robot(hello: Message) -> str:
    """What the robot says of itself.

    Raises:
        Broken: a field is missing, of another shape, or the edge sensors stand in another order.
    """
    robot: Any = hello.get("robot")
    require(isinstance(robot, dict), f"robot = {robot!r}")
    for name in _POSITIVE:
        _right(robot, name, is_positive(robot.get(name)))
    floor: Any
    edges: Any
    floor, edges = robot.get("fan_floor"), robot.get("edge_sensors_m")
    _right(robot, "fan_floor", is_number(floor) and 0.0 <= floor <= 1.0)
    _right(robot, "puck_m", is_numbers(robot.get("puck_m"), 3))
    shape = isinstance(edges, list) and len(edges) == 4 and all(is_numbers(edge, 2) for edge in edges)
    _right(robot, "edge_sensors_m", shape)
    front_left, front_right, rear_left, rear_right = edges
    fore = min(front_left[0], front_right[0]) > max(rear_left[0], rear_right[0])
    aside = min(front_left[1], rear_left[1]) > max(front_right[1], rear_right[1])
    require(fore and aside, f"edge_sensors_m not in the order front-left, front-right, rear-left, rear-right: {edges}")
    return f"wheels {robot['wheel_radius_m']:g} m on {robot['wheel_base_m']:g} m, fan floor {floor:g}"


def judge_nonces(hellos: Sequence[Message]) -> str:
    """Nonces of several connections.

    Raises:
        Broken: one comes twice.
    """
    nonces = [hello.get("nonce") for hello in hellos]
    again = next((nonce for k, nonce in enumerate(nonces) if nonce in nonces[:k]), None)
    require(again is None, f"nonce {again} twice in {len(nonces)} connections")
    return f"{len(nonces)} connections, {len(nonces)} nonces"


def judge_boots(hellos: Sequence[Message]) -> str:
    """Boot numbers of several connections to one boot.

    Raises:
        Broken: they differ.
    """
    boots = [hello.get("boot") for hello in hellos]
    require(boots.count(boots[0]) == len(boots), f"boot changes without a power-up: {boots}")
    return f"boot {boots[0]} on {len(boots)} connections"


def is_positive(value: Any) -> bool:
    """Whether it is a finite number over 0."""
    return is_number(value) and value > 0.0


def _right(message: Message, name: str, is_right: bool) -> None:
    require(is_right, f"{name} = {message[name]!r}" if name in message else f"no {name}")
