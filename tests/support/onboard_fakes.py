"""Devices of a robot for tests: inertial unit by registers, data acquisition by bytes, PWM and GPIO as the kernel's."""

import errno
import math
import os
import struct
from collections.abc import Callable, Mapping
from pathlib import Path

import pytest

from ccatp.config.onboard_models import MotorConfig
from ccatp.onboard.devices.bno055 import BURST_START
from ccatp.onboard.devices.daq import IDENTIFY, IDENTITY, SAMPLE, SAMPLES, START, STOP, Decoder, format_frame
from ccatp.onboard.hardware import HardwareError

POWER_ON_S, TO_CONFIG_S, FROM_CONFIG_S = 0.4, 0.019, 0.007


class FakeTime:
    """A clock that only ``sleep`` moves."""

    def __init__(self, now_s: float = 100.0) -> None:
        self.now_s = now_s

    def __call__(self) -> float:
        return self.now_s

    def sleep(self, wait_s: float) -> None:
        self.now_s += wait_s


class FakeBno055:
    """The registers of the unit, and the bus that it is on; it switches modes as slowly as the data sheet says.

    error: raised by each transfer, until it is None, or until ``errors`` transfers have failed, or, if ``is_locked``,
    until the bus is opened again.
    stuck: registers that keep their value whatever is written. tamper: changes the bytes of a burst.
    """

    def __init__(self, time: FakeTime, address: int = 0x28) -> None:
        self._time, self._address = time, address
        self.chip_id, self.self_test = 0xA0, 0x0F
        self.gravity_m_s2, self.ax_m_s2, self.ay_m_s2, self.wz_rad_s = (0.0, 0.0, 9.81), 0.0, 0.0, 0.0
        self.stuck: dict[int, int] = {}
        self.error: OSError | None = None
        self.errors: float = math.inf
        self.tamper: Callable[[bytes], bytes] = bytes
        self.is_locked = False
        self.opened = self.closed = self.resets = self.readings = 0
        self.power_on()

    def open(self) -> "FakeBno055":
        self.opened += 1
        if self.is_locked:
            self.error, self.is_locked = None, False
        return self

    def close(self) -> None:
        self.closed += 1

    def power_on(self, deaf_s: float = 0.0) -> None:
        """As after the supply has come."""
        self.is_frozen = False
        self.registers = bytearray(128)
        self.registers[0x04:0x07] = bytes((0x11, 0x03, 0x15))
        self.registers[0x41] = 0x24
        self.registers[0x3B] = 0x80
        self.page = 0
        self._deaf_until_s = self._time.now_s + deaf_s
        self._switching_until_s = 0.0

    @property
    def mode(self) -> int:
        return self.registers[0x3D] & 0x0F

    def write(self, address: int, data: bytes) -> None:
        self._transfer(address)
        register, value = data
        if register == 0x07:
            self.page = value
        elif self._is_switching():
            return
        elif register == 0x3F and value & 0x20:
            self.resets += 1
            self.power_on(POWER_ON_S)
        elif register == 0x3D:
            if value != self.mode:
                wait_s = FROM_CONFIG_S if self.mode == 0 else TO_CONFIG_S
                self._switching_until_s = self._time.now_s + wait_s
            self.registers[0x3D] = self.stuck.get(register, value)
        elif self.mode == 0:
            self.registers[register] = self.stuck.get(register, value)

    def write_read(self, address: int, data: bytes, count: int) -> bytes:
        self._transfer(address)
        if self._is_switching():
            raise OSError(errno.EREMOTEIO, os.strerror(errno.EREMOTEIO))
        if self.page:
            return bytes(count)
        self.registers[0x00], self.registers[0x36] = self.chip_id, self.self_test
        if self.mode and not self.is_frozen:
            self._fuse()
        start = data[0]
        answer = bytes(self.registers[start : start + count])
        return self.tamper(answer) if start == BURST_START else answer

    def _fuse(self) -> None:
        """New data, with the last bit of the rate about x changing from one to the next."""
        self.readings += 1
        axes = [self.registers[0x41] >> shift & 3 for shift in (0, 2, 4)]
        signs = [-1 if self.registers[0x42] >> bit & 1 else 1 for bit in (2, 1, 0)]
        per_rad_s = 900 if self.registers[0x3B] & 2 else 16 * 180 / math.pi
        per_m_s2 = 1000 / 9.80665 if self.registers[0x3B] & 1 else 100

        def turned(vector: tuple[float, float, float], scale: float) -> list[int]:
            return [round(sign * vector[axis] * scale) for axis, sign in zip(axes, signs, strict=True)]

        rate = turned((0.0, 0.0, self.wz_rad_s), per_rad_s)
        rate[0] += self.readings % 2
        acceleration = turned((self.ax_m_s2, self.ay_m_s2, 0.0), per_m_s2)
        gravity = turned(self.gravity_m_s2, per_m_s2)
        data = struct.pack("<16h2B", *rate, 0, 0, 0, 16384, 0, 0, 0, *acceleration, *gravity, 21, 0x30)
        self.registers[BURST_START : BURST_START + len(data)] = data
        self.registers[0x39] = self.registers[0x39] or 5

    def _transfer(self, address: int) -> None:
        if self.error is not None:
            self.errors -= 1
            error = self.error
            if self.errors <= 0:
                self.error, self.errors = None, math.inf
            raise error
        if address != self._address or self._time.now_s < self._deaf_until_s:
            raise OSError(errno.EREMOTEIO, os.strerror(errno.EREMOTEIO))

    def _is_switching(self) -> bool:
        return self._time.now_s < self._switching_until_s


class FakeDaq:
    """The device behind a serial port, and the port. Its time, its clock's rate and its counts can be set.

    corrupt: changes the bytes on their way to the host. is_mute: takes and sends nothing.
    """

    def __init__(self, time: FakeTime, packed: int = 5) -> None:
        self._time, self._packed = time, packed
        self.identity = b"ccatp-daq\x001.2\x00SN7\x00"
        self.fastest_hz = 2000
        self.version = 1
        self.corrupt: Callable[[bytes], bytes] = bytes
        self.is_mute = self.is_unplugged = False
        self.rate = 1.0  # device seconds per second
        self.start_us = 0
        self.counts, self.step = [0.0, 0.0], [0.0, 0.0]
        self.adc = [60000, 60000, 60000, 60000, 57000]
        self.open_error: Exception | None = None
        self.opened = self.closed = self.unsent = 0
        self.latency_s: Callable[[], float] = float
        self._sent: list[tuple[float, bytes]] = []
        self._arrived = b""
        self.boot()

    def open(self, _device: str, _baud: int, _key: str) -> "FakeDaq":
        if self.open_error is not None:
            raise self.open_error
        self.opened += 1
        self._sent.clear()
        self._arrived = b""
        return self

    def boot(self) -> None:
        """Power on: sequence numbers, time and counts begin again."""
        self._decoder = Decoder()
        self._seq, self.device_us, self._waiting = 0, float(self.start_us), b""
        self._sample_hz, self._next_s, self._count = 0, math.inf, 0
        self.counts = [0.0, 0.0]
        self._identify()

    def write(self, data: bytes, /) -> int:
        if self.is_unplugged:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        if self.is_mute:
            self.unsent += len(data)
            return len(data)
        for kind, payload in self._decoder.feed(data):
            if kind == IDENTIFY:
                self._identify()
            elif kind == START:
                self._sample_hz, self._next_s = int.from_bytes(payload, "little"), self._time.now_s
            elif kind == STOP:
                self._sample_hz, self._next_s = 0, math.inf
        return len(data)

    def read(self, size: int, /) -> bytes:
        if self.is_unplugged:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        self._sample()
        now_s = self._time.now_s
        self._arrived += b"".join(data for arrival_s, data in self._sent if arrival_s <= now_s)
        self._sent = [(arrival_s, data) for arrival_s, data in self._sent if arrival_s > now_s]
        data, self._arrived = self._arrived[:size], self._arrived[size:]
        return data

    def reset_output_buffer(self) -> None:
        self.unsent = 0

    def close(self) -> None:
        assert not self.unsent, "closing would wait for the device"
        self.closed += 1

    def send(self, kind: int, payload: bytes) -> None:
        """A frame, as it leaves the device."""
        frame = format_frame(kind, self._seq, payload, self.version)
        self._seq += 1
        data = self.corrupt(frame)
        if data and not self.is_mute:
            self._sent.append((self._time.now_s + self.latency_s(), data))

    def _identify(self) -> None:
        self.send(IDENTITY, self.fastest_hz.to_bytes(2, "little") + self.identity)

    def _sample(self) -> None:
        now_s = self._time.now_s
        while self._next_s <= now_s + 1e-9:
            self.device_us += 1e6 * self.rate / self._sample_hz
            self.counts = [count + step for count, step in zip(self.counts, self.step, strict=True)]
            right, left = ((round(count) + 0x80000000) % 0x100000000 - 0x80000000 for count in self.counts)
            self._waiting += SAMPLE.pack(round(self.device_us) & 0xFFFFFFFF, right, left, *self.adc)
            self._next_s += 1.0 / self._sample_hz
            if len(self._waiting) == self._packed * SAMPLE.size:
                # It leaves when its newest sample is taken, also where the host was late to ask.
                self._time.now_s, self._waiting, payload = self._next_s - 1.0 / self._sample_hz, b"", self._waiting
                self.send(SAMPLES, payload)
                self._time.now_s = now_s


class FakeBridge:
    """Lines of GPIO chips: levels, and each change of them."""

    def __init__(self) -> None:
        self.levels: dict[int, bool] = {}
        self.changes: list[dict[int, bool]] = []
        self.error: HardwareError | None = None
        self.closed = 0

    def open(self, _chip: str, values: Mapping[int, bool]) -> "FakeBridge":
        self.set(values)
        return self

    def set(self, values: Mapping[int, bool]) -> None:
        if self.error is not None:
            raise self.error
        self.levels |= values
        self.changes.append(dict(values))

    def close(self) -> None:
        self.closed += 1


class FakePwm:
    """A tree of files as in /sys/class/pwm, with the kernel's rules for what may be written when.

    refusals: error numbers of writes, by the last two parts of the file's name. denials: opens that fail once more.
    """

    def __init__(self, root: Path, monkeypatch: pytest.MonkeyPatch, chips: Mapping[int, int]) -> None:
        self.root, self._chips = root, chips
        self.writes: list[tuple[str, int]] = []
        self.refusals: dict[str, int] = {}
        self.denials: dict[str, int] = {}
        for chip in chips:
            (root / f"pwmchip{chip}").mkdir()
            (root / f"pwmchip{chip}" / "export").write_text("")
        self._open, self._pwrite = os.open, os.pwrite
        monkeypatch.setattr(os, "open", self.open)
        monkeypatch.setattr(os, "pwrite", self.pwrite)

    def value(self, name: str) -> int:
        fd = self._open(f"{self.root}/{name}", os.O_RDONLY)  # a control loop of a thousand steps a second asks
        try:
            return int(os.read(fd, 64).split()[0])
        finally:
            os.close(fd)

    def duty(self, chip: int, channel: int) -> float:
        """Of a channel, 0 to 1; 0 where it is off."""
        folder = f"pwmchip{chip}/pwm{channel}"
        if not self.value(f"{folder}/enable"):
            return 0.0
        return self.value(f"{folder}/duty_cycle") / self.value(f"{folder}/period")

    def export(self, chip: int, channel: int, period: int = 0, duty: int = 0, enable: int = 0) -> None:
        folder = self.root / f"pwmchip{chip}" / f"pwm{channel}"
        folder.mkdir()
        for name, value in (("period", period), ("duty_cycle", duty), ("enable", enable)):
            (folder / name).write_text(f"{value}\n")

    def open(self, path: str | Path, flags: int, *args: int, **kwargs: int) -> int:
        name = str(path).removeprefix(f"{self.root}/")
        if self.denials.get(name, 0) > 0:
            self.denials[name] -= 1
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
        return self._open(path, flags, *args, **kwargs)

    def pwrite(self, fd: int, data: bytes, offset: int) -> int:
        path = os.readlink(f"/proc/self/fd/{fd}")  # noqa: PTH115 - a control loop writes two thousand times a second
        if not path.startswith(f"{self.root}/"):
            return self._pwrite(fd, data, offset)
        name, value = path.removeprefix(f"{self.root}/"), int(data)
        folder, _, file = name.rpartition("/")
        code = self.refusals.get(name, 0)
        if file == "export":
            chip = int(folder.removeprefix("pwmchip"))
            code = code or (errno.ENODEV if value >= self._chips[chip] else 0)
            if not code:
                self.export(chip, value)
        else:
            period, duty = self.value(f"{folder}/period"), self.value(f"{folder}/duty_cycle")
            is_refused = {
                "period": value < duty or not value,
                "duty_cycle": not period or value > period,
                "enable": value not in (0, 1) or (value == 1 and not period),
            }[file]
            code = code or (errno.EINVAL if is_refused else 0)
        if code:
            raise OSError(code, os.strerror(code))
        self.writes.append((name, value))
        return self._pwrite(fd, data, offset)


def voltage_of(motor: MotorConfig, supply_v: float, bridge: FakeBridge, pwm: FakePwm) -> float:
    """Of a motor, from its lines and its duty; 0 where it brakes."""
    forward, reverse = bridge.levels[motor.forward_line], bridge.levels[motor.reverse_line]
    return (forward - reverse) * supply_v * pwm.duty(motor.chip, motor.channel)
