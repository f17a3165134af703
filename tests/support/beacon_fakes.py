"""Devices of a robot among beacons for tests, at the level of bytes and lines.

They are written from the manuals alone: no codec of a driver is imported, so that a mistake on both ends would show.
"""

import errno
import os
from collections import deque
from collections.abc import Callable, Mapping
from math import ceil, pi, tau

from ccatp.beacons.sim.radio import SimDriveCommand
from ccatp.onboard.hardware import HardwareError
from tests.support.onboard_fakes import FakeTime


class FakePort:
    """A serial port and the device behind it.

    corrupt: changes the bytes of one message on their way to the host. is_mute: takes and sends nothing. open_error:
    raised by each attempt to open it. baud: of a line on which bytes take time. latency_s: of an adapter, which hands
    on what it has received so often.
    """

    def __init__(self, time: FakeTime) -> None:
        self._time = time
        self.corrupt: Callable[[bytes], bytes] = bytes
        self.is_mute = self.is_unplugged = False
        self.open_error: Exception | None = None
        self.baud: int | None = None
        self.latency_s = self._request_s = 0.0
        self.opened = self.closed = 0
        self._sent: deque[tuple[float, bytes]] = deque()
        self._free_s = 0.0  # the line to the host
        self._arrived = b""

    def open(self) -> "FakePort":
        if self.open_error is not None:
            raise self.open_error
        self.opened += 1
        self.forget()
        self._arrived = b""
        return self

    def forget(self) -> None:
        """Send nothing of what is not sent yet."""
        self._sent.clear()
        self._free_s = 0.0

    def unplug(self) -> None:
        self.is_unplugged, self.open_error = True, HardwareError("/dev/ttyX: is not there; check the wiring")

    def plug(self) -> None:
        self.is_unplugged, self.open_error = False, None

    def write(self, data: bytes, /) -> int:
        self._check()
        if not self.is_mute:
            self._request_s = self._line_s(data)
            self.take(data)
            self._request_s = 0.0
        return len(data)

    def _line_s(self, data: bytes) -> float:
        return 0.0 if self.baud is None else 10.0 * len(data) / self.baud

    def read(self, size: int, /) -> bytes:
        self._check()
        self.live()
        while self._sent and self._sent[0][0] <= self._time.now_s + 1e-9:
            self._arrived += self._sent.popleft()[1]
        data, self._arrived = self._arrived[:size], self._arrived[size:]
        return data

    def reset_output_buffer(self) -> None:
        self._check()

    def close(self) -> None:
        self.closed += 1

    def send(self, data: bytes, after_s: float = 0.0) -> None:
        """Bytes of one message, which arrive after a delay, in order."""
        data = self.corrupt(data)
        if data and not self.is_mute:
            begin_s = max(self._time.now_s + self._request_s + after_s, self._free_s)
            arrival_s = self._free_s = begin_s + self._line_s(data)
            if self.latency_s:
                arrival_s = ceil(arrival_s / self.latency_s) * self.latency_s
            self._sent.append((arrival_s, data))

    def take(self, data: bytes) -> None:
        """Bytes of the host."""

    def live(self) -> None:
        """What the device does by itself up to now."""

    def _check(self) -> None:
        if self.is_unplugged:
            raise OSError(errno.EIO, os.strerror(errno.EIO))


# -- the radio module --------------------------------------------------------------------------------------------------

ANSWER_S, OWN_S = 0.012, 0.003  # of another module by radio; of the module itself


class FakeXBee(FakePort):
    """The coordinator with Zigbee or 802.15.4 firmware; ``level`` gives the strength of the packet of a radio, or None.

    extra: frames that arrive behind the next answer of a radio, each with the strength of its packet, if it is one.
    has_level, has_parent: of an answer to the node discovery with 802.15.4, which differs among the firmwares.
    """

    OWN = 0x0013A20041AE0001

    def __init__(self, time: FakeTime, names: list[str], level: Callable[[str], float | None]) -> None:
        super().__init__(time)
        self.api_mode = 1
        self.is_zigbee = self.has_level = True
        self.has_parent = False
        self.nodes = {0x0013A20040520000 + k: name for k, name in enumerate(names, 1)}
        self.parents: dict[str, int] = {}  # of end devices
        self.level = level
        self.extra: list[tuple[bytes, int | None]] = []
        self.strength = 0
        self.search = 60  # NT, 0.1 s
        self.answer_s = ANSWER_S
        self._host = b""

    def reset(self) -> None:
        """As by its reset line; it reports it, and forgets what it was asked."""
        self._host, self.strength = b"", 0
        self.forget()
        self.frame(b"\x8a\x00", 0.1)
        self.frame(b"\x8a\x06", 0.2)

    def frame(self, data: bytes, after_s: float = 0.0) -> None:
        body = len(data).to_bytes(2, "big") + data + bytes([(0xFF - sum(data)) & 0xFF])
        if self.api_mode == 2:
            for byte in (0x7D, 0x7E, 0x11, 0x13):
                body = body.replace(bytes([byte]), bytes([0x7D, byte ^ 0x20]))
        self.send(b"\x7e" + body, after_s)

    def take(self, data: bytes) -> None:
        self._host += data
        while b"\x7e" in self._host:
            self._host = self._host[self._host.index(b"\x7e") :]
            plain = self._plain(self._host[1:])
            if len(plain) < 2:
                return
            size = int.from_bytes(plain[:2], "big")
            if size > 100:
                self._host = self._host[1:]
                continue
            if len(plain) < size + 3:
                return
            body = plain[2 : size + 3]
            if sum(body) & 0xFF == 0xFF:
                self._host = self._host[1 + len(self._escaped(plain[: size + 3])) :]
                self._obey(body[:-1])
            else:
                self._host = self._host[1:]

    def _plain(self, data: bytes) -> bytes:
        if self.api_mode == 1:
            return data
        plain, is_flipped = bytearray(), False
        for byte in data:
            if byte == 0x7D:
                is_flipped = True
                continue
            plain.append(byte ^ 0x20 if is_flipped else byte)
            is_flipped = False
        return bytes(plain)

    def _escaped(self, plain: bytes) -> bytes:
        extra = sum(byte in (0x7D, 0x7E, 0x11, 0x13) for byte in plain) if self.api_mode == 2 else 0
        return plain + bytes(extra)

    def _obey(self, body: bytes) -> None:
        if body[0] == 0x08:
            frame_id, command = body[1:2], body[2:4]
            if command == b"ND":
                for address, name in self.nodes.items():
                    self.frame(b"\x88" + frame_id + b"ND\x00" + self._node(address, name), 0.5)
                if not self.is_zigbee:
                    self.frame(b"\x88" + frame_id + b"ND\x00", 2.0)
                return
            serial = self.OWN.to_bytes(8, "big")
            values = {
                b"AP": bytes([self.api_mode]), b"SH": serial[:4], b"SL": serial[4:], b"VR": b"\x40\x60",
                b"NI": b"CRT", b"NT": bytes([self.search]), b"DB": bytes([self.strength]),
            }  # fmt: skip
            known = command in values
            self.frame(b"\x88" + frame_id + command + bytes([0 if known else 2]) + values.get(command, b""), OWN_S)
        elif body[0] == 0x17:
            address = int.from_bytes(body[2:10], "big")
            name = self.nodes.get(address, "")
            level = self.level(name) if name else None
            if level is not None:
                self.strength = round(-level)
                answer = b"\x97" + body[1:2] + body[2:10] + b"\x12\x34" + body[13:15] + b"\x00" + name.encode()
                self.frame(answer, self.answer_s)
                for data, strength in self.extra:
                    self.frame(data, self.answer_s)
                    self.strength = self.strength if strength is None else strength
                self.extra.clear()

    def _node(self, address: int, name: str) -> bytes:
        start = b"\x12\x34" + address.to_bytes(8, "big")
        if not self.is_zigbee:
            level = b"\x2a" if self.has_level else b""
            rest = b"\xff\xfe\x02\x00\xc1\x05\x10\x1e" if self.has_parent else b""
            return start + level + name.encode() + b"\x00" + rest
        is_end = name in self.parents
        parent = self.parents.get(name, 0xFFFE).to_bytes(2, "big")
        return start + name.encode() + b"\x00" + parent + bytes([2 if is_end else 1]) + b"\x00\xc1\x05\x10\x1e"


# -- the dish ----------------------------------------------------------------------------------------------------------


class FakeDish:
    """Stepper motor, reflector, end switch and cable; lines of a GPIO chip, for a driver that counts rising edges.

    turns: of the motor, in steps from straight ahead. lose: swallows a step where it is true. switch: its level,
    None: as the dish closes it.
    """

    def __init__(self, step_line: int, direction_line: int, steps_per_turn: int, start: int = 30) -> None:
        self._step, self._direction, self._per_turn = step_line, direction_line, steps_per_turn
        self._levels = {step_line: False, direction_line: False}
        self.turned = start
        self.lowest = self.highest = start
        self.lose: Callable[[int], bool] = lambda _: False
        self.switch: bool | None = None
        self.error: HardwareError | None = None
        self.opened = 0

    @property
    def direction_rad(self) -> float:
        """Left of the heading."""
        return (self.turned / self._per_turn * tau + pi) % tau - pi

    def open_lines(self, _chip: str, values: Mapping[int, bool]) -> "FakeDish":
        self._raise()
        self.opened += 1
        self._levels.update(values)
        return self

    def open_input(self, _chip: str, _line: int) -> "FakeDish":
        self._raise()
        return self

    def set(self, values: Mapping[int, bool]) -> None:
        self._raise()
        rises = values.get(self._step, False) and not self._levels[self._step]
        self._levels.update(values)
        if rises and not self.lose(self.turned):
            self.turned += 1 if self._levels[self._direction] else -1
            self.lowest, self.highest = min(self.lowest, self.turned), max(self.highest, self.turned)

    def get(self) -> bool:
        self._raise()
        return self.turned <= 0 if self.switch is None else self.switch

    def close(self) -> None:
        pass

    def _raise(self) -> None:
        if self.error is not None:
            raise self.error


# -- the base ----------------------------------------------------------------------------------------------------------

CYCLE_S = 0.1


class FakePioneer(FakePort):
    """A Pioneer base: handshake, watchdog, packets of each cycle; ``move`` drives the wheels for a cycle.

    ``move`` takes travel (m/s) and turn (rad/s), and gives those that the encoders measure. sonar_m: readings, all in
    each cycle; with ``baud`` five, in turn, as of two rings that send a pulse each 40 ms. When its watchdog
    expires it halts, and with the next packet it resumes its motion, as the manuals say.
    """

    def __init__(
        self,
        time: FakeTime,
        move: Callable[[float, float], tuple[float, float]],
        sonars_m: Callable[[], list[float]],
        track_m: float = 0.33,
    ) -> None:
        super().__init__(time)
        self._move, self._sonars_m, self._track_m = move, sonars_m, track_m
        self.counts_per_mm = 128.0
        self.counts = [0.0, 0.0]  # left, right
        self.watchdog_ms = 500
        self.ticks_mm = 128
        self.battery_v = 12.5
        self.stalls, self.bumpers = [False, False], [0, 0]
        self.is_enabled = self.stop_pressed = False
        self.numbers: list[int] | None = None  # of sonars that read; None: all
        self._turn = 0
        self.expired = 0
        self._expires_s: float | None = None
        self.power_on()

    def power_on(self) -> None:
        self._host, self._stage = b"", 0
        self._set_points, self.is_halted = [0.0, 0.0], False  # m/s, rad/s
        self._has_encoders, self.counts = False, [0.0, 0.0]
        self._next_s = self._time.now_s + CYCLE_S
        self._heard_s = self._time.now_s

    @property
    def velocity(self) -> float:
        """Of its motion, m/s."""
        return 0.0 if self.is_halted else self._set_points[0]

    @property
    def turn(self) -> float:
        """Of its motion, rad/s."""
        return 0.0 if self.is_halted else self._set_points[1]

    def packet(self, body: bytes, after_s: float = 0.002) -> None:
        total = 0
        for k in range(0, len(body) - 1, 2):
            total = (total + (body[k] << 8) + body[k + 1]) & 0xFFFF
        if len(body) & 1:
            total ^= body[-1]
        self.send(b"\xfa\xfb" + bytes([len(body) + 2]) + body + bytes([total >> 8, total & 0xFF]), after_s)

    def take(self, data: bytes) -> None:
        self._host += data
        while (start := self._host.find(b"\xfa\xfb")) >= 0 and len(self._host) >= start + 3:
            size = self._host[start + 2]
            if len(self._host) < start + 3 + size:
                return
            body, self._host = self._host[start + 3 : start + 1 + size], self._host[start + 3 + size :]
            self._heard_s, self.is_halted = self._time.now_s, False
            sign = -1 if len(body) > 1 and body[1] == 0x1B else 1
            self._obey(body[0], sign * int.from_bytes(body[2:4], "little") if len(body) >= 4 else None)

    def _obey(self, command: int, value: int | None) -> None:
        if self._stage < 3:
            if command == self._stage:
                names = b"Bradley_1\x00Pioneer\x00p3dx-sh\x00" if command == 2 else b""
                self.packet(bytes([command]) + names)
                self._stage += 1
        elif command == 2:
            self.power_on()
        elif command == 18:
            numbers = b"".join(n.to_bytes(2, "little") for n in (500, 1500, 300, 2000, 500))
            settings = b"\x00\x02\x00" + b"\x00\x00\x01\x00\x00" + (115).to_bytes(2, "little")
            settings += (16570).to_bytes(2, "little") + self.watchdog_ms.to_bytes(2, "little") + bytes(43)
            settings += self.ticks_mm.to_bytes(2, "little") + bytes(20)
            self.packet(b"\x20Pioneer\x00p3dx-sh\x00SN42\x00\x04" + numbers + b"Bradley_1\x00" + settings)
        elif command == 4:
            self.is_enabled = value == 1
        elif command == 11 and value is not None:
            self._set_points[0] = 1e-3 * value
        elif command == 21 and value is not None:
            self._set_points[1] = value * pi / 180.0
        elif command == 29:
            self._set_points = [0.0, 0.0]
        elif command == 19:
            self._has_encoders = bool(value)

    def live(self) -> None:
        while self._next_s <= self._time.now_s + 1e-9:
            at_s, self._next_s = self._next_s, self._next_s + CYCLE_S
            if self._stage < 3:
                continue
            if at_s - self._heard_s > 1e-3 * self.watchdog_ms and (self.velocity or self.turn):
                self.is_halted = True
                self.expired += 1
            if self.stop_pressed:
                self.is_enabled = False
            is_driven = self.is_enabled and not any(self.stalls)
            velocity, turn = self._move(*((self.velocity, self.turn) if is_driven else (0.0, 0.0)))
            for side, sign in ((0, -1.0), (1, 1.0)):
                speed = velocity + sign * 0.5 * self._track_m * turn
                self.counts[side] += 1e3 * speed * CYCLE_S * self.counts_per_mm
            self._standard(velocity, turn)
            if self._has_encoders:
                wrapped = (round(count) & 0xFFFFFFFF for count in self.counts)
                self.packet(b"\x90" + b"".join(count.to_bytes(4, "little") for count in wrapped))

    def _standard(self, velocity: float, turn: float) -> None:
        speeds = [round(1e3 * (velocity + sign * 0.5 * self._track_m * turn)) for sign in (-1, 1)]
        body = bytes([0x33 if velocity or turn else 0x32]) + bytes(6)
        body += b"".join((speed & 0xFFFF).to_bytes(2, "little") for speed in speeds)
        body += bytes([round(10 * self.battery_v)])
        front, rear = self.bumpers
        body += bytes([self.stalls[0] | rear << 1, self.stalls[1] | front << 1])
        body += bytes(2) + (int(self.is_enabled) | 2).to_bytes(2, "little") + b"\x00"
        ranges_m = dict(enumerate(self._sonars_m()))
        if self.baud is not None:
            self.numbers = [(self._turn + k) % len(ranges_m) for k in range(5)]
            self._turn += 5
        shown = {n: r for n, r in ranges_m.items() if self.numbers is None or n in self.numbers}
        body += bytes([len(shown)])
        body += b"".join(bytes([n]) + min(round(1e3 * r), 5000).to_bytes(2, "little") for n, r in shown.items())
        self.packet(body + bytes(12))


# -- motes -------------------------------------------------------------------------------------------------------------


class FakeMote(FakePort):
    """A Cricket mote in listener mode; ``pulse`` writes the line of a received pulse."""

    def __init__(self, time: FakeTime, unique_id: str, temperature_c: float | None = None) -> None:
        super().__init__(time)
        self.unique_id, self.temperature_c = unique_id, temperature_c
        self.mode = "Listener"
        self.started_s = time.now_s
        self.stamp_ms: int | None = None  # a clock that stands
        self._host = b""

    def take(self, data: bytes) -> None:
        self._host = (self._host + data)[-64:]
        if b"G CF" in self._host and self._host.endswith((b"\r", b"\n")):
            self._host = b""
            shown = "disabled" if self.temperature_c is None else f"{self.temperature_c:g}"
            self.send(
                "Cricket configuration:\r\nSoftware version: 2.0\r\n"
                f"Mode: {self.mode}\r\nUnique id: {self.unique_id}\r\nSpace id: \r\nUptime: 00:01:02\r\n"
                f"Local temperature value (Celsius): {shown}\r\n".encode(),
                0.02,
            )

    def pulse(self, sender: str, space: str, delay_s: float) -> None:
        flight_us = round(1e6 * delay_s)
        stamp = round(1e3 * (self._time.now_s - self.started_s)) if self.stamp_ms is None else self.stamp_ms
        distances = f"DB={round(34300.0 * delay_s)},DR={flight_us},TM={flight_us + 358}"
        self.send(f"VR=2.0,ID={sender},SP={space},{distances},TS={stamp}\r\n".encode())


# -- all together ------------------------------------------------------------------------------------------------------


def drive_command(velocity_m_s: float, turn_rad_s: float) -> SimDriveCommand:
    """The command of the simulated vehicle."""
    return SimDriveCommand(velocity_m_s, 0.0, turn_rad_s)
