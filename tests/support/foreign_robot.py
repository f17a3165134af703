"""A robot and a laser system written from the interface contracts alone.

Nothing of ``ccatp`` is imported: the physics, the servers and the truth are its own, so that a
mistake that the project makes on both ends of a link shows. Lengths in m, angles in rad, times in
seconds of the robot's own clock, in which the physics runs, too. The deck frame has z on the side
the robot drives on.

    python tests/support/foreign_robot.py --port 7010 --laser-port 2001 --clock-error 0.005
"""

import argparse
import asyncio
import contextlib
import json
import math
import os
import random
import secrets
import signal
import time
import tomllib
from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

PROTOCOL = "ccatp-robot/1"
STEP_S = 0.001
LINE_LIMIT = 8192
BAD_LINES = 20  # in a second
TAKE_OVER_S = 5.0
ROLES = ("controller", "monitor")
Vector = tuple[float, ...]


@dataclass
class Options:
    mirror: str = str(Path(__file__).parents[2] / "configs/mirrors/fyst-m1.toml")
    port: int = 7010
    laser_port: int = 2001
    lockstep: bool = False
    seed: int = 1
    frame_hz: float = 100.0
    ttl_s: float = 0.25
    wheel_radius_m: float = 0.031
    wheel_base_m: float = 0.145
    wheel_lag_s: float = 0.06
    fan_floor: float = 0.0
    imu_hz: float = 100.0
    encoder_hz: float = 1000.0
    edge_hz: float = 1000.0
    gravity_hz: float = 10.0
    slip: float = 0.02  # mean, of each wheel, drawn for each leg
    slip_spread: float = 0.01
    creep: float = 0.01  # downhill, part of the speed
    gyroscope_sigma: float = 0.004
    gyroscope_bias: float = 0.005
    accelerometer_sigma: float = 0.02
    accelerometer_bias: float = 0.05
    encoder_sigma: float = 0.002
    gravity_sigma: float = 0.02
    start_sigma_m: float = 0.002
    start_sigma_rad: float = 0.01
    clock_error: float = 0.0  # relative rate of the robot's clock
    clock_wander: float = 0.0  # amplitude of its wandering
    clock_wander_period_s: float = 60.0
    age_s: float = 0.0  # frames reach the client this late
    age_jitter_s: float = 0.0
    lose_frames: float = 0.0  # probability that a frame is lost with its samples
    lose_samples: float = 0.0  # probability that a sample is not taken
    stall_every_s: float = 0.0  # frames stop ...
    stall_s: float = 0.1  # ... for this long, and then come at once
    drop_every_s: float = 0.0  # one session is reset
    restart_at_s: float = 0.0  # after its first motion; it restarts once, with the same boot number ...
    restart_s: float = 0.5  # ... as firmware without a counter does, and is away for this long
    other_base_m: float = 0.0  # wheel base in the hello after the restart: another robot answers; 0: the same one
    blocked_beams: float = 0.0  # probability that a channel of the laser has no beam
    lose_replies: float = 0.0  # probability that a laser reply never comes
    laser_ready_after_s: float = 0.0


class Mirror:
    """Panels, surface and frames of a mirror file."""

    def __init__(self, path: str) -> None:
        data = tomllib.loads(Path(path).read_text(encoding="utf-8"))
        self.data, panels = data, data["panels"]
        self.side = data["frame"]["reflecting_side_sign"]
        radius = data["surface"]["normalisation_radius_mm"] / 1e3
        self.terms = []
        for i, j, a in data["surface"]["terms"]:
            sign = self.side * (self.side**i)  # the deck's x and z turn with the side
            self.terms.append((i, j, sign * a / 1e3 / radius ** (i + j)))
        self.half = (panels["size_x_mm"] / 2e3, panels["size_y_mm"] / 2e3)
        self.pitch = (panels["pitch_x_mm"] / 1e3, panels["pitch_y_mm"] / 1e3)
        self.gap = panels["gap_mm"] / 1e3
        self.y_offset = panels.get("y_offset_mm", 0.0) / 1e3
        self.per_row, self.cols = panels["panels_per_row"], panels["cols"]
        self.points = {
            (row, col, 3 * k + m + 1): (self.centre(row, col)[0] + x / 1e3, self.centre(row, col)[1] + y / 1e3)
            for row, count in enumerate(self.per_row, 1)
            for col in range((self.cols - count) // 2 + 1, (self.cols + count) // 2 + 1)
            for k, y in enumerate(panels["points_y_mm"])
            for m, x in enumerate(panels["points_x_mm"])
        }
        self.origin = [v / 1e3 for v in data["frame"]["origin_world_mm"]]
        angle = data["frame"]["rotation_about_x_rad"]
        self.cos, self.sin = math.cos(angle), math.sin(angle)
        self.collimators = {
            channel: [v / 1e3 for v in place]
            for channel, place in zip(
                data["collimators"]["channels"], data["collimators"]["positions_world_mm"], strict=True
            )
        }

    def centre(self, row: int, col: int) -> tuple[float, float]:
        x = (col - (self.cols + 1) / 2) * self.pitch[0]
        return x, (row - (len(self.per_row) + 1) / 2) * self.pitch[1] + self.y_offset

    def is_panel(self, x: float, y: float, margin: float = 0.0) -> bool:
        """Whether a panel, widened by ``margin`` on each side, lies under (x, y)."""
        row = round((y - self.y_offset) / self.pitch[1] + (len(self.per_row) + 1) / 2)
        if not 1 <= row <= len(self.per_row):
            return False
        col = round(x / self.pitch[0] + (self.cols + 1) / 2)
        if abs(col - (self.cols + 1) / 2) > (self.per_row[row - 1] - 1) / 2:
            return False
        cx, cy = self.centre(row, col)
        return bool(abs(x - cx) <= self.half[0] + margin and abs(y - cy) <= self.half[1] + margin)

    def height(self, x: float, y: float) -> tuple[float, float, float]:
        """z and its slopes along x and y."""
        z = zx = zy = 0.0
        for i, j, a in self.terms:
            z += a * x**i * y**j
            if i:
                zx += a * i * x ** (i - 1) * y**j
            if j:
                zy += a * j * x**i * y ** (j - 1)
        return z, zx, zy

    def world_from_deck(self, p: Vector) -> Vector:
        x, y, z = self.side * p[0], p[1], self.side * p[2]
        o = self.origin
        return x + o[0], self.cos * y - self.sin * z + o[1], self.sin * y + self.cos * z + o[2]

    def gravity_deck(self) -> Vector:
        """Things fall along world z: telescope at the zenith."""
        return 0.0, self.sin, self.side * self.cos


def unit(a: Vector) -> Vector:
    n = math.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])
    return a[0] / n, a[1] / n, a[2] / n


def cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def along(a: Vector, n: Vector) -> Vector:
    """The unit vector of what of ``a`` lies in the plane with normal ``n``."""
    k = dot(a, n)
    return unit((a[0] - k * n[0], a[1] - k * n[1], a[2] - k * n[2]))


class Body:
    """Two wheels on a curved mirror: servo lag, slip, creep, and sensors at their own rates."""

    SENSORS = ((0.09, 0.09), (0.09, -0.09), (-0.09, 0.09), (-0.09, -0.09))
    PUCK = (0.0, 0.0, 0.05)

    def __init__(self, options: Options, mirror: Mirror) -> None:
        self.o, self.mirror = options, mirror
        self.rng = random.Random(options.seed)
        self.steps = 0
        base, gauss = mirror.data["base"], self.rng.gauss
        cx, cy = mirror.centre(base["row"], base["col"])
        self.x = cx + base["x_mm"] / 1e3 + gauss(0, options.start_sigma_m)
        self.y = cy + base["y_mm"] / 1e3 + gauss(0, options.start_sigma_m)
        heading = base["heading_rad"] + gauss(0, options.start_sigma_rad)
        self.forward: Vector = (math.cos(heading), math.sin(heading), 0.0)
        self.gravity = mirror.gravity_deck()
        self.wheels = [0.0, 0.0]  # right, left, rad/s
        self.angles = [0.0, 0.0]
        self.read_angles = [0.0, 0.0]
        self.slips = [0.0, 0.0]
        self.speed = 0.0
        self.fans = [max(0.5, options.fan_floor)] * 2
        self.bias = (gauss(0, options.gyroscope_bias), gauss(0, options.accelerometer_bias))
        self.samples: dict[str, list[list[float]]] = {"imu": [], "enc": [], "edge": []}
        self.gravity_sample: list[float] | None = None
        self.outside_s, self.fell, self.falls, self.moved_m = 0.0, False, 0, 0.0
        self.recent: deque[tuple[float, float, float]] = deque(maxlen=600)
        self.frame()

    @property
    def t(self) -> float:
        return self.steps * STEP_S

    def frame(self) -> None:
        self.z, zx, zy = self.mirror.height(self.x, self.y)
        self.normal = unit((-zx, -zy, 1.0))
        self.forward = along(self.forward, self.normal)
        self.left = cross(self.normal, self.forward)

    def at(self, point: tuple[float, ...]) -> Vector:
        """Deck position of a point of the robot frame."""
        p, f, s, n = (self.x, self.y, self.z), self.forward, self.left, self.normal
        h = point[2] if len(point) > 2 else 0.0
        a, b, c = (p[i] + point[0] * f[i] + point[1] * s[i] + h * n[i] for i in range(3))
        return a, b, c

    def step(self, wr: float, wl: float) -> None:
        self.steps += 1
        o, gauss, step = self.o, self.rng.gauss, self.steps
        if (wr or wl) and abs(self.wheels[0]) + abs(self.wheels[1]) < 1e-3:
            self.slips = [max(0.0, gauss(o.slip, o.slip_spread)) for _ in range(2)]
        before = self.speed
        lag = STEP_S / o.wheel_lag_s
        for k, target in enumerate((wr, wl)):
            self.wheels[k] += (target - self.wheels[k]) * lag
            if target == 0.0 and abs(self.wheels[k]) < 1e-4:
                self.wheels[k] = 0.0
            self.angles[k] += self.wheels[k] * STEP_S
        right, left = (w * o.wheel_radius_m * (1 - s) for w, s in zip(self.wheels, self.slips, strict=True))
        self.speed, rate = (right + left) / 2, (right - left) / o.wheel_base_m
        if right or left:
            self.move(rate)
        t = self.t
        self.recent.append((t, self.x, self.y))
        self.sample(step, t, rate, (self.speed - before) / STEP_S)

    def move(self, rate: float) -> None:
        f, s, turn, way = self.forward, self.left, rate * STEP_S, self.speed * STEP_S
        down = along(self.gravity, self.normal)
        drift = self.o.creep * abs(way)
        self.moved_m += abs(way)
        self.x += way * f[0] + drift * down[0]
        self.y += way * f[1] + drift * down[1]
        self.forward = (f[0] + turn * s[0], f[1] + turn * s[1], f[2] + turn * s[2])
        self.frame()

    def sample(self, step: int, t: float, rate: float, acceleration: float) -> None:
        o, gauss, rng = self.o, self.rng.gauss, self.rng.random
        now: list[tuple[str, list[float]]] = []
        if step % round(1 / (o.imu_hz * STEP_S)) == 0:
            ax = acceleration + self.bias[1] + gauss(0, o.accelerometer_sigma)
            now.append(("imu", [t, round(ax, 5), round(rate + self.bias[0] + gauss(0, o.gyroscope_sigma), 6)]))
        every = round(1 / (o.encoder_hz * STEP_S))
        if step % every == 0:  # mean rate since the last sample, as counts give it
            rates = [(a - b) / (every * STEP_S) for a, b in zip(self.angles, self.read_angles, strict=True)]
            self.read_angles = self.angles[:]
            now.append(("enc", [t, *(round(w + gauss(0, o.encoder_sigma), 5) for w in rates)]))
        if step % round(1 / (o.edge_hz * STEP_S)) == 0:
            places = [self.at(s) for s in self.SENSORS]
            now.append(("edge", [t, *(int(self.mirror.is_panel(x, y)) for x, y, _ in places)]))
            if not all(self.mirror.is_panel(x, y, self.mirror.gap) for x, y, _ in places):
                self.outside_s += 1 / o.edge_hz
        if step % round(1 / (o.gravity_hz * STEP_S)) == 0:
            g = unit(
                tuple(dot(self.gravity, e) + gauss(0, o.gravity_sigma) for e in (self.forward, self.left, self.normal))
            )
            self.gravity_sample = [t, *(round(v, 6) for v in g)]
        for name, values in now:
            if rng() >= o.lose_samples:
                self.samples[name].append([round(values[0], 6), *values[1:]])
        fell = not self.mirror.is_panel(self.x, self.y, self.mirror.gap)
        self.falls += fell and not self.fell
        self.fell = fell

    def puck(self) -> Vector:
        """World position."""
        return self.mirror.world_from_deck(self.at(self.PUCK))

    def moved_lately(self) -> float:
        """Largest distance in m from where the robot is now to where it was within 0.5 s."""
        since = self.t - 0.5
        return max((math.dist((x, y), (self.x, self.y)) for t, x, y in self.recent if t > since), default=0.0)


class BadLine(ValueError):
    """A line that the contract drops."""


def parse(line: bytes) -> dict[str, Any]:
    """The message of a line; what its fields must be is checked later."""

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        if len({name for name, _ in pairs}) < len(pairs):
            raise BadLine("duplicate key")
        return dict(pairs)

    def finite(text: str) -> float:
        if not math.isfinite(value := float(text)):
            raise BadLine(text)
        return value

    try:
        message = json.loads(line, object_pairs_hook=unique, parse_constant=finite, parse_float=finite)
    except (ValueError, RecursionError) as error:
        raise BadLine(str(error)) from None
    if not isinstance(message, dict) or not isinstance(message.get("type"), str):
        raise BadLine("no message")
    return message


# who may send it, and the fields besides seq
MESSAGES: dict[str, tuple[str, dict[str, type]]] = {
    "drive": ("controller", {"ack": int, "wr": float, "wl": float}),
    "fans": ("controller", {"duty": list}),
    "permit": ("monitor", {"ack": int, "forward": bool, "reverse": bool, "turn": bool}),
}


def is_of(kind: type, value: Any) -> bool:
    """Whether a field is what it must be: counters, set points, permissions, two duties."""
    if kind is list and isinstance(value, list):
        return len(value) == 2 and all(is_of(float, v) and 0 <= float(v) <= 1 for v in value)
    if kind is float:
        return type(value) in {int, float} and abs(value) < 1e300
    return isinstance(value, bool) if kind is bool else type(value) is int and value >= 0


@dataclass(eq=False)
class Session:
    role: str
    number: int
    writer: asyncio.StreamWriter
    last_valid: float
    newest: dict[str, int] = field(default_factory=dict)
    ack: int = -1
    bad: deque[float] = field(default_factory=lambda: deque(maxlen=BAD_LINES + 1))


class RobotServer:
    """The robot link: sessions, motion rules, frames in real time or in lockstep."""

    def __init__(self, options: Options, body: Body) -> None:
        self.o, self.body = options, body
        self.boot, self.session_count = secrets.randbelow(2**31), 0
        self.sessions: dict[str, Session] = {}
        self.drive: tuple[float, float, float] | None = None  # arrived, wr, wl
        self.permit: tuple[float, bool, bool, bool] | None = None
        self.echo: tuple[int, float] | None = None  # newest drive: seq, arrived
        self.monitor_ever = False
        self.frame_seq, self.rng = 0, random.Random(options.seed + 1)
        self.answered = asyncio.Event()
        self.wall, self.clock, self.last_due = time.monotonic(), 0.0, 0.0
        self.counts = {"frames": 0, "bad_lines": 0, "resets": 0, "stalls": 0, "held_s": 0.0, "lost": 0, "restarts": 0}
        self.held = True
        self.booted_s = self.away_until_s = 0.0  # of the body's time
        self.moved_s = math.inf  # the first drive that turns the wheels
        self.last_bad = ""

    # motion rules

    def set_points(self) -> tuple[float, float]:
        now = self.body.t
        self.held = True
        if self.drive is None or now - self.drive[0] > self.o.ttl_s:
            return 0.0, 0.0
        _, wr, wl = self.drive
        if self.monitor_ever:
            if self.permit is None or now - self.permit[0] > self.o.ttl_s:
                return 0.0, 0.0
            _, forward, reverse, turn = self.permit
            if (wr + wl > 0 and not forward) or (wr + wl < 0 and not reverse) or (wr != wl and not turn):
                return 0.0, 0.0
        self.held = False
        most = max(abs(wr), abs(wl))
        scale = min(1.0, 8.0 / most) if most else 1.0
        return wr * scale, wl * scale

    def advance(self, steps: int) -> None:
        for _ in range(steps):
            self.body.step(*self.set_points())
            self.counts["held_s"] += STEP_S * self.held

    # sessions

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        session: Session | None = None
        if self.body.t < self.away_until_s:
            writer.transport.abort()
            return
        try:
            writer.write(encode(self.hello()))
            session = await self.join(reader, writer)
            while session is not None:
                line = await reader.readuntil(b"\n")
                if not self.take(session, line):
                    break
        except (OSError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            pass
        finally:
            if session is not None and self.sessions.get(session.role) is session:
                self.leave(session)
            writer.close()

    @property
    def wheel_base_m(self) -> float:
        """That of the robot that answers now."""
        is_other = self.o.other_base_m > 0.0 and self.counts["restarts"] > 0
        return self.o.other_base_m if is_other else self.o.wheel_base_m

    def hello(self) -> dict[str, Any]:
        return {
            "type": "hello",
            "protocol": PROTOCOL,
            "boot": self.boot,
            "nonce": secrets.token_hex(16),
            "auth": "none",
            "lockstep": self.o.lockstep,
            "frame_hz": self.o.frame_hz,
            "ttl_s": self.o.ttl_s,
            "robot": {
                "wheel_radius_m": self.o.wheel_radius_m,
                "wheel_base_m": self.wheel_base_m,
                "edge_sensors_m": Body.SENSORS,
                "puck_m": Body.PUCK,
                "max_wheel_rad_s": 8.0,
                "fan_floor": self.o.fan_floor,
            },
        }

    async def join(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> Session | None:
        message: dict[str, Any] = {}
        with contextlib.suppress(TimeoutError, BadLine):
            async with asyncio.timeout(2.0):
                message = parse(await reader.readuntil(b"\n"))
        role, reason = str(message.get("role")), ""
        holder = self.sessions.get(role)
        if message.get("type") != "join" or role not in ROLES or not isinstance(message.get("client"), str):
            reason = "bad join"
        elif message.get("protocol", PROTOCOL) != PROTOCOL:
            reason = "bad protocol"
        elif holder is not None and time.monotonic() - holder.last_valid < TAKE_OVER_S:
            reason = "role taken"
        if reason:
            writer.write(encode({"type": "refused", "reason": reason}))
            return None
        if holder is not None:
            self.leave(holder)
        self.session_count += 1
        session = self.sessions[role] = Session(role, self.session_count, writer, time.monotonic())
        self.monitor_ever |= role == "monitor"
        writer.write(encode({"type": "joined", "role": role, "session": session.number}))
        return session

    def leave(self, session: Session) -> None:
        del self.sessions[session.role]
        session.writer.transport.abort()
        if session.role == "controller":
            self.drive = None
        else:
            self.permit = None
        self.counts["lost"] += 1

    def take(self, session: Session, line: bytes) -> bool:
        """Whether the session goes on."""
        self.catch_up()
        now = time.monotonic()
        if len(line) > LINE_LIMIT:
            return False
        try:
            self.obey(session, parse(line))
        except BadLine as error:
            self.last_bad = f"{session.role}: {error}"
            self.counts["bad_lines"] += 1
            session.bad.append(now)
            return len(session.bad) <= BAD_LINES or now - session.bad[0] > 1.0
        session.last_valid = now
        return self.sessions.get(session.role) is session

    def obey(self, session: Session, message: dict[str, Any]) -> None:
        kind, now = message["type"], self.body.t
        if kind not in MESSAGES:
            return
        owner, form = MESSAGES[kind]
        if owner != session.role:
            raise BadLine(f"{session.role} sent {kind}")
        for name in ("seq", *form):
            if not is_of(form.get(name, int), message.get(name)):
                raise BadLine(f"{kind}.{name}")
        seq = message["seq"]
        if seq <= session.newest.get(kind, -1):
            return
        session.newest[kind] = seq
        if kind == "fans":
            self.body.fans = [max(duty, self.o.fan_floor) for duty in message["duty"]]
            return
        if kind == "drive":
            self.drive, self.echo = (now, message["wr"], message["wl"]), (seq, now)
            if message["wr"] or message["wl"]:
                self.moved_s = min(self.moved_s, now)
        else:
            self.permit = (now, message["forward"], message["reverse"], message["turn"])
        session.ack = message["ack"]
        self.answered.set()

    def restart(self) -> None:
        """Begin again without any command; the body stays where it is."""
        for session in list(self.sessions.values()):
            self.leave(session)
        self.drive = self.permit = self.echo = None
        self.monitor_ever, self.frame_seq = False, 0
        self.booted_s = self.away_until_s = self.body.t + self.o.restart_s
        self.counts["restarts"] += 1

    # frames

    def since_boot(self, rows: list[list[float]]) -> list[list[float]]:
        """Samples with the times of the present boot."""
        return [[round(row[0] - self.booted_s, 6), *row[1:]] for row in rows if row[0] >= self.booted_s]

    def frame(self) -> bytes:
        body, now = self.body, self.body.t
        self.frame_seq += 1
        self.counts["frames"] += 1
        seq, arrived = self.echo or (0, now)
        message = {
            "type": "sensors",
            "seq": self.frame_seq,
            "t": round(now - self.booted_s, 6),
            **{name: self.since_boot(rows) for name, rows in body.samples.items()},
            "gravity": next(iter(self.since_boot([body.gravity_sample])), None) if body.gravity_sample else None,
            "fans": body.fans,
            "soc": round(max(0.1, 1 - now / 7200), 4),
            "cmd": {
                "seq": seq,
                "age": round(now - arrived, 6),
                "permit_age": round(now - self.permit[0], 6) if self.permit else 0.0,
                "held": self.held,
            },
            "faults": [],
        }
        body.samples = {"imu": [], "enc": [], "edge": []}
        body.gravity_sample = None
        return encode(message)

    def send_frame(self, line: bytes) -> None:
        for session in list(self.sessions.values()):
            transport = session.writer.transport
            if transport.is_closing() or transport.get_write_buffer_size() > 1_000_000:
                self.leave(session)
            else:
                session.writer.write(line)

    def catch_up(self) -> None:
        """Physics and frames up to now, by the robot's own clock."""
        if self.o.lockstep:
            return
        now = time.monotonic()
        wander = self.o.clock_wander * math.sin(2 * math.pi * now / self.o.clock_wander_period_s)
        self.clock += (now - self.wall) * (1 + self.o.clock_error + wander)
        self.wall = now
        per_frame = round(1 / (self.o.frame_hz * STEP_S))
        while self.body.t + STEP_S <= self.clock:
            self.advance(1)
            if self.body.steps % per_frame == 0 and self.body.t > self.away_until_s:
                self.post(self.frame(), now)

    def post(self, line: bytes, now: float) -> None:
        o, t = self.o, self.body.t
        if self.rng.random() < o.lose_frames:
            return
        due = now + o.age_s + self.rng.uniform(0, o.age_jitter_s)
        if o.stall_every_s and t % o.stall_every_s < o.stall_s:
            due += o.stall_s - t % o.stall_every_s
            self.counts["stalls"] += 1
        self.last_due = max(due, self.last_due + 1e-6)  # a stream keeps its order
        if self.last_due <= now:
            self.send_frame(line)
        else:
            asyncio.get_running_loop().call_at(self.last_due, self.send_frame, line)

    async def run(self) -> None:
        if self.o.lockstep:
            await self.run_lockstep()
        next_drop = self.o.drop_every_s or math.inf
        while True:
            self.catch_up()
            if self.o.restart_at_s and self.body.t > self.moved_s + self.o.restart_at_s and not self.counts["restarts"]:
                self.restart()
            if self.body.t > next_drop:
                next_drop += self.o.drop_every_s
                role = self.rng.choice(ROLES)
                if role in self.sessions:
                    self.counts["resets"] += 1
                    self.leave(self.sessions[role])
            await asyncio.sleep(max(0.001, 1 / self.o.frame_hz - (time.monotonic() - self.wall) - 0.001))

    async def run_lockstep(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            while "controller" not in self.sessions:  # noqa: ASYNC110 - a test's robot may poll
                await asyncio.sleep(0.01)
            self.advance(round(1 / (self.o.frame_hz * STEP_S)))
            line = self.frame()
            while not self.is_answered():
                self.send_frame(line)
                again_s = loop.time() + 1.0
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout_at(again_s):
                        while not self.is_answered():
                            self.answered.clear()
                            await self.answered.wait()

    def is_answered(self) -> bool:
        roles = ROLES if self.monitor_ever else ROLES[:1]
        return all(r in self.sessions and self.sessions[r].ack == self.frame_seq for r in roles)


def encode(message: dict[str, Any]) -> bytes:
    return json.dumps(message, separators=(",", ":")).encode() + b"\n"


class LaserServer:
    """The MultiLine grammar: lengths from each collimator to the true puck."""

    def __init__(self, options: Options, body: Body, catch_up: Callable[[], None]) -> None:
        self.o, self.body, self.catch_up = options, body, catch_up
        self.rng = random.Random(options.seed + 2)
        self.stops: list[tuple[float, float, float, float]] = []  # t, deck x and y of the puck, moved
        self.requests: dict[str, int] = {}
        self.begun = time.monotonic()

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while line := await reader.readline():
                reply = self.answer(line.decode("ascii", "replace").strip())
                if self.rng.random() >= self.o.lose_replies:
                    writer.write(reply.encode() + b"\r\n")
        except (OSError, ValueError):
            pass
        finally:
            writer.close()

    def answer(self, request: str) -> str:
        command, *arguments = request.split(",")
        self.requests[command] = self.requests.get(command, 0) + 1
        ready = time.monotonic() - self.begun >= self.o.laser_ready_after_s
        fixed = {
            "isconnected": "isconnected_1",
            "laserready": f"laserready_{int(ready)}",
            "environmentdata": "environmentdata_12.5,550.25,20.0",
            "startmeasnogui": "measstarted",
            "stopmeasnogui": "measstopped",
        }
        if command in fixed:
            return fixed[command]
        channels = self.body.mirror.collimators
        if command != "latestlengthvalid" or not arguments or not all(a.isdigit() for a in arguments):
            return "unknowncommand"
        self.catch_up()
        puck, moved = self.body.puck(), self.body.moved_lately()
        x, y, _ = self.body.at(Body.PUCK)
        self.stops.append((self.body.t, x, y, moved))
        records = []
        for channel in map(int, arguments):
            length = math.dist(puck, channels[channel]) if channel in channels else 0.0
            length += self.rng.gauss(0, 1e-6 + 2.5e-7 * length)
            beam = channel not in channels or self.rng.random() < self.o.blocked_beams
            flags = [0, int(beam), 0, int(moved > 1e-4), 0, 0, 0, 0, 0, 0]
            records.append(",".join(map(str, [channel, f"{length * 1e3:.5f}", 100, 200, 12.5, 550.25, 20.0, *flags])))
        return "_".join(["channeldata", *records, "0"])


def result(options: Options, robot: RobotServer, laser: LaserServer) -> dict[str, Any]:
    """What truly happened: of the requests at rest, the first and the best near each point."""
    body, mirror = robot.body, robot.body.mirror
    targets = {str(k): target(mirror, k) for k in mirror.points}
    first: dict[str, float] = {}
    best: dict[str, float] = {}
    for _, x, y, moved in laser.stops:
        if moved > 1e-4:
            continue
        name, error = min(((k, math.dist((x, y), p)) for k, p in targets.items()), key=lambda item: item[1])
        if error < 0.015:  # via points are 20 mm away
            first.setdefault(name, error)
            best[name] = min(error, best.get(name, error))
    return {
        "points": len(best),
        "first_max_mm": round(max(first.values(), default=0) * 1e3, 3),
        "best_max_mm": round(max(best.values(), default=0) * 1e3, 3),
        "falls": body.falls,
        "outside_s": round(body.outside_s, 3),
        "moved_m": round(body.moved_m, 3),
        "robot_s": round(body.t, 2),
        "stops": len(laser.stops),
        "measured_moving": sum(moved > 1e-4 for *_, moved in laser.stops),
        "counts": {k: round(v, 3) for k, v in robot.counts.items()},
        "last_bad": robot.last_bad,
        "laser": laser.requests,
        "changed": {k: v for k, v in asdict(options).items() if v != getattr(Options(), k)},
    }


def target(mirror: Mirror, point: tuple[int, int, int]) -> tuple[float, float]:
    """Deck place of the puck over a point, along the normal of its panel's centre."""
    _, zx, zy = mirror.height(*mirror.centre(point[0], point[1]))
    n = unit((-zx, -zy, 1.0))
    x, y = mirror.points[point]
    return x + Body.PUCK[2] * n[0], y + Body.PUCK[2] * n[1]


async def main(options: Options) -> None:
    body = Body(options, Mirror(options.mirror))
    robot = RobotServer(options, body)
    laser = LaserServer(options, body, robot.catch_up)
    servers = [
        await asyncio.start_server(robot.serve, "127.0.0.1", options.port, limit=LINE_LIMIT),
        await asyncio.start_server(laser.serve, "127.0.0.1", options.laser_port),
    ]
    ports = [server.sockets[0].getsockname()[1] for server in servers]
    print(json.dumps({"robot": ports[0], "laser": ports[1]}), flush=True)

    if not options.lockstep:
        with contextlib.suppress(OSError):  # a robot has a processor of its own
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(30))
    try:
        await robot.run()
    finally:
        print(json.dumps(result(options, robot, laser)), flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    for item in fields(Options):
        flag = "--" + item.name.replace("_", "-")
        if item.type is bool:
            parser.add_argument(flag, action="store_true")
        else:
            parser.add_argument(flag, type=type(item.default), default=item.default)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with contextlib.suppress(KeyboardInterrupt):
        asyncio.run(main(Options(**vars(parser.parse_args()))))
