"""Configurations, mirrors, and the simulated robot, as most tests want them."""

import json
import socket
from collections.abc import Callable
from functools import cache
from math import sqrt
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from ccatp.beacons.config.load import load_radio_config
from ccatp.beacons.config.models import RadioConfig
from ccatp.config.load import available, load_config
from ccatp.config.models import Config
from ccatp.dataloop import DataLoop, motor_robot, survey_robot
from ccatp.links.robot_codec import decode_from_robot
from ccatp.links.robot_messages import Sensors
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.onboard.sessions import ClientSession, RobotServer, ServerLog
from ccatp.sim.fault_plan import FaultPlan, parse_plan
from ccatp.sim.fault_proxy import FaultProxy
from ccatp.sim.robot import Robot

C = TypeVar("C")
# Recorded radio data are no part of the checkout; tests that read them are skipped where they are not beside it.
RADIO_DATA = Path(__file__).resolve().parents[3] / "shared" / "data" / "radio"
MIRRORS = tuple(available("mirror"))


def config_of(mirror: str = "fyst-m1", **overrides: object) -> Config:
    """The default configuration with changes; `run__seed=3` is the key `run.seed`."""
    return _loaded(load_config, {"run.mirror": mirror}, overrides)


def radio_config_of(system: str = "zigbee", /, **overrides: Any) -> RadioConfig:
    """The shipped configuration of robots among beacons with changes, likewise."""
    return _loaded(load_radio_config, {"system": system}, overrides)


_LOADED: dict[str, Any] = {}


def _loaded(load: Callable[[None, dict[str, object]], C], first: dict[str, object], overrides: dict[str, Any]) -> C:
    """A configuration; it is frozen, so the same settings give the same object: to load one takes 5 ms."""
    settings = first | {key.replace("__", "."): value for key, value in overrides.items()}
    key = f"{load.__name__} {settings!r}"
    if key not in _LOADED:
        _LOADED[key] = load(None, settings)
    found: C = _LOADED[key]
    return found


@cache
def mirror_of(name: str = "fyst-m1") -> Mirror:
    """A shipped mirror; one object for all tests."""
    return build_mirror(config_of(name).mirror)


class World(NamedTuple):
    """A shipped configuration and its mirror."""

    cfg: Config
    mirror: Mirror


@cache
def world_of(name: str = "fyst-m1") -> World:
    """The default configuration with a shipped mirror; one object for all tests."""
    return World(config_of(name), mirror_of(name))


def transport_rad(mirror: Mirror, x: float, y: float, dx: float, dy: float) -> float:
    """Change of the deck heading, rad, of a robot that drives (dx, dy) without turning about its own normal.

    ``dpsi = -fy (fxx dx + fxy dy) / ((1 + fx^2) W)``: a straight line on the surface (a geodesic) turns against the
    tangents of the lines y = const. For steps that are short against the radius of curvature.
    """
    _, fx, fy, fxx, fxy, _ = mirror.surface.jet(x, y)
    s2 = 1.0 + fx * fx
    return -fy * (fxx * dx + fxy * dy) / (s2 * sqrt(s2 + fy * fy))


def one_panel(**overrides: object) -> Config:
    """A survey of one panel without the calibration drive."""
    return config_of(**{"mirror": "fyst-m1", "run__panels": 1, "mission__calibration_length_m": 0.0, **overrides})  # type: ignore[arg-type]


def fault_plan(*rows: dict[str, object], section: str = "fault") -> FaultPlan:
    """A plan of these faults, or with `section="link"` of these faults of the link."""
    text = [
        f"[[{section}]]\n" + "\n".join(f"{key} = {json.dumps(value)}" for key, value in row.items()) for row in rows
    ]
    return parse_plan("\n".join(text), "plan")


def begin(proxy: FaultProxy, kind: str, direction: str = "both", **values: object) -> None:
    """Switch on a fault of the link that lasts."""
    (fault,) = fault_plan({"type": kind, "at_s": 0.0, "direction": direction, **values}, section="link").link
    proxy.switch_on(fault)


def boot(config: Config, mirror: Mirror, seed: int = 1, plan: FaultPlan | None = None) -> Robot:
    """A simulated robot at base that has just been switched on."""
    return Robot(config, mirror, np.random.default_rng(seed), plan)


def sensors_of(robot: Robot) -> Sensors:
    """The frame that it delivers, decoded."""
    message = decode_from_robot(robot.delivered_line[:-1])
    assert isinstance(message, Sensors)
    return message


def drive(robot: Robot, right_rad_s: float, left_rad_s: float, frames: int) -> list[dict[str, Any]]:
    """Drive for so many frames; the JSON lines that it delivered meanwhile."""
    lines = b""
    for _ in range(frames):
        robot.rules.drive(robot.seq + 1, right_rad_s, left_rad_s, robot.t_s)
        robot.advance()
        lines += robot.delivered_line
    return [json.loads(line) for line in lines.splitlines()]


def any_port() -> socket.socket:
    """A listening socket at any free port of this machine."""
    return socket.create_server(("127.0.0.1", 0))


class SurveyLoop(DataLoop):
    """A survey robot behind the link, at any free port."""

    robot: Robot

    def __init__(
        self, config: Config, *, lockstep: bool, key: bytes | None = None, log: ServerLog | None = None
    ) -> None:
        robot = survey_robot(config) if config.sim.robot.physics == "lag" else motor_robot(config)
        super().__init__(robot, lockstep=lockstep, key=key, log=log)

    async def start(self, listener: socket.socket | None = None) -> int:
        return await super().start(listener or any_port())


class Client(ClientSession):
    """One end of a connection to a `ServedRobot`; `sent` is what the robot sent."""

    def __init__(self, server: RobotServer, now_s: Callable[[], float]) -> None:
        super().__init__(server)
        self.sent, self.is_closed, self._now_s = b"", False, now_s
        server.accept(self, now_s())

    def write(self, data: bytes) -> None:
        assert not self.is_closed
        self.sent += data

    def close(self) -> None:
        self.is_closed = True

    def send(self, data: bytes) -> None:
        self.receive(data, self._now_s())

    def join(self, role: str = "controller") -> None:
        self.send(json.dumps({"type": "join", "role": role, "client": "test"}).encode() + b"\n")

    def drive(self, seq: int, ack: int, right: float = 3.0, left: float = 3.0) -> None:
        self.send(b'{"type":"drive","seq":%d,"ack":%d,"wr":%f,"wl":%f}\n' % (seq, ack, right, left))

    def permit(self, seq: int, ack: int, allowed: bytes = b"true") -> None:
        line = b'{"type":"permit","seq":%d,"ack":%d,"forward":%b,"reverse":%b,"turn":%b}\n'
        self.send(line % (seq, ack, allowed, allowed, allowed))

    @property
    def messages(self) -> list[dict[str, Any]]:
        """Everything received since the last call."""
        lines, self.sent = self.sent.splitlines(), b""
        return [json.loads(line) for line in lines]

    @property
    def kinds(self) -> list[str]:
        return [m["type"] if m["type"] != "sensors" else str(m["seq"]) for m in self.messages]


class ServedRobot:
    """A robot server on a clock of its own, and its clients; nothing waits."""

    def __init__(
        self,
        config: Config,
        mirror: Mirror,
        *,
        lockstep: bool = True,
        key: bytes | None = None,
        plan: FaultPlan | None = None,
    ) -> None:
        self.now_s = 1000.0
        self.notes: list[str] = []
        self.frames = 0
        self.robot = boot(config, mirror, plan=plan)
        self.server = RobotServer(self.robot, lockstep=lockstep, key=key, log=self)
        self.server.each_frame.append(self._count)
        self.server.begin(self.now_s)

    def info(self, event: str, **fields: object) -> None:
        """Take a line of the log."""
        self.notes.append(str(fields.get("text", event)))

    def _count(self) -> None:
        self.frames += 1

    def client(self, first: bytes = b"") -> Client:
        client = Client(self.server, lambda: self.now_s)
        if first:
            client.send(first)
        return client

    def run(self, seconds: float) -> None:
        """Let the wall clock go on."""
        end = self.now_s + seconds
        while self.server.next_frame_s <= end:
            self.now_s = self.server.next_frame_s
            self.server.tick(self.now_s)
        self.now_s = end
