"""The data acquisition device by its bytes: frames, clocks, counts, and what breaks on the line and in the device."""

import binascii
import contextlib
import errno
import itertools
import os
import pty
import random
import re
import struct
import time
import tty
from collections.abc import Callable
from pathlib import Path

import pytest

from ccatp.config.load import load_onboard_config
from ccatp.config.onboard_models import DaqConfig
from ccatp.onboard.devices.daq import IDENTITY, SAMPLES, Daq, DaqSample, Decoder, DeviceClock, format_frame
from ccatp.onboard.devices.linux import open_serial
from ccatp.onboard.hardware import HardwareError
from tests.support.onboard_fakes import FakeDaq, FakeTime

CONFIG = load_onboard_config().devices.daq
FRAMES = [format_frame(SAMPLES, seq, bytes(range(22))) for seq in range(40)]


class Rig:
    """The device behind a simulated port, and its host side, polled each 2 ms."""

    def __init__(self, config: DaqConfig = CONFIG, packed: int = 5) -> None:
        self.time = FakeTime()
        self.device = FakeDaq(self.time, packed)
        self.daq = Daq(config, self.device.open, self.time, self.time.sleep)
        self.samples: list[DaqSample] = []
        self.faults: list[str] = []  # after each poll

    def run(self, duration_s: float, step_s: float = 0.002) -> None:
        end_s = self.time.now_s + duration_s
        while self.time.now_s < end_s:
            self.time.sleep(step_s)
            self.daq.poll(self.time.now_s)
            self.samples += self.daq.take()
            self.faults.append(self.daq.fault(self.time.now_s))


@pytest.fixture
def rig() -> Rig:
    rig = Rig()
    rig.daq.open()
    rig.run(0.2)
    assert not rig.faults[-1]
    rig.samples.clear()
    rig.faults.clear()
    return rig


# -- frames -----------------------------------------------------------------------------------------------------------


def test_a_frame_is_the_documented_bytes() -> None:
    assert binascii.crc_hqx(b"123456789", 0xFFFF) == 0x29B1
    assert format_frame(0x02, 0x0102, struct.pack("<H", 1000)) == bytes.fromhex("a55a 01 02 02 0201 e803 4cf5")


def _flipped(data: bytes, place: int) -> bytes:
    return data[:place] + bytes((data[place] ^ 0x40,)) + data[place + 1 :]


LONG = format_frame(SAMPLES, 7, b"\xa5\x5a\x01\x82\xff" * 40)
# What happens to the bytes, those that come, frames that are read, counts.
LINES: dict[str, tuple[bytes, int, dict[str, int]]] = {
    "noise before a frame": (b"\x00\xff\xa5\x13" + FRAMES[0], 1, {"noise": 4}),
    "noise between frames": (FRAMES[0] + b"hello" + FRAMES[1], 2, {"noise": 5}),
    "half a sync before a frame": (b"\xa5" + FRAMES[0], 1, {"noise": 1}),
    "a sync in noise": (b"\xa5\x5a\x01\x02\x03" + FRAMES[0] + FRAMES[1], 2, {"bad_sums": 1, "noise": 5}),
    "sync bytes in a payload": (LONG + FRAMES[8], 2, {}),
    "a flipped bit": (FRAMES[0] + _flipped(FRAMES[1], 12) + FRAMES[2], 2, {"bad_sums": 1, "lost": 1, "noise": 31}),
    "a flipped length": (
        FRAMES[0] + _flipped(FRAMES[1], 4) + b"".join(FRAMES[2:10]), 9, {"bad_sums": 1, "lost": 1, "noise": 31},
    ),
    "a lost byte": (FRAMES[0] + FRAMES[1][:9] + FRAMES[1][10:] + FRAMES[2], 2, {"lost": 1, "noise": 30}),
    "a lost frame": (FRAMES[0] + FRAMES[3], 2, {"lost": 2}),
    "a frame twice": (FRAMES[0] + FRAMES[0] + FRAMES[1], 3, {}),
    "sequence numbers wrap": (format_frame(SAMPLES, 0xFFFF) + format_frame(SAMPLES, 0), 2, {}),
    "the device began again": (FRAMES[30] + FRAMES[0] + FRAMES[1], 3, {}),
    "another version": (format_frame(SAMPLES, 0, b"", version=2) + FRAMES[1], 1, {"frames": 2}),
}  # fmt: skip


@pytest.mark.parametrize(("data", "frames", "counts"), LINES.values(), ids=LINES)
@pytest.mark.parametrize("piece", [1, 1000])
def test_the_line(data: bytes, frames: int, counts: dict[str, int], piece: int) -> None:
    decoder = Decoder()
    found = [frame for start in range(0, len(data), piece) for frame in decoder.feed(data[start : start + piece])]
    assert len(found) == frames
    expected = {"frames": frames, "bad_sums": 0, "lost": 0, "noise": 0} | counts
    if counts.get("lost") and "bad_sums" not in counts:
        del expected["bad_sums"]  # as many as there are sync bytes in what is left
    assert {name: decoder.counts[name] for name in expected} == expected


def test_what_the_decoder_keeps_is_bounded() -> None:
    decoder, rng = Decoder(), random.Random(1)
    for _ in range(200):
        decoder.feed(rng.randbytes(1000) + b"\xa5\x5a")
    kept = 200 * 1002 - decoder.counts["noise"]
    assert 0 <= kept <= 264
    assert not decoder.counts["frames"]


# -- times ------------------------------------------------------------------------------------------------------------


def _steady(_rng: random.Random) -> float:
    return 0.002


def _jitter(rng: random.Random) -> float:
    return 0.0005 + rng.expovariate(1.0 / 0.002)


def _stalls(rng: random.Random) -> float:
    return 0.001 + (0.03 if rng.random() < 0.2 else 0.0)


@pytest.mark.parametrize("rate", [0.99, 0.9999, 1.0, 1.0001, 1.01])
@pytest.mark.parametrize("delay", [_steady, _jitter, _stalls])
def test_times_of_the_device_are_those_of_the_robot(rate: float, delay: Callable[[random.Random], float]) -> None:
    clock, rng, start_us = DeviceClock(), random.Random(3), 0xFFFFFFFF - 3_000_000  # wraps after 3 s
    errors, times, arrival_s = [], [], 0.0
    for packet in range(1000):
        taken_s = 0.01 * packet
        arrival_s = max(arrival_s, taken_s + delay(rng))
        device_s = clock.unwrap(round(start_us + taken_s * rate * 1e6) & 0xFFFFFFFF)
        assert device_s is not None
        if clock.arrive(arrival_s):
            times.append(clock.time_s(device_s, arrival_s))
            assert times[-1] <= arrival_s
            errors.append(times[-1] - taken_s)
    assert len(times) > 985
    # A clock that is 1 % fast gets 2 ms ahead while no packet is prompt for 0.2 s, and is then set back at once.
    tolerance = 0.03 if abs(rate - 1.0) < 1e-3 else 0.2
    assert all(abs((after - before) / 0.01 - 1.0) < tolerance for before, after in itertools.pairwise(times))
    # Not late by more than the least delay of a window; early by what a clock 1 % too slow gains within two windows.
    assert min(errors[50:]) > -0.005
    assert max(errors[50:]) < 0.004


def test_a_clock_that_goes_backwards_or_jumps_is_noticed() -> None:
    clock = DeviceClock()
    assert clock.unwrap(5_000_000) == 0.0
    assert clock.unwrap(4_000_000) is None
    for k in range(100):
        clock.unwrap(5_000_000 + 11_000 * k)
        assert clock.arrive(10.0 + 0.011 * k) == (k >= 10)
    clock.unwrap(7_000_000)
    assert not clock.arrive(11.0)


# -- samples ----------------------------------------------------------------------------------------------------------


def test_the_device_is_started_and_read() -> None:
    rig = Rig()
    rig.device.adc = [65535, 0, 32768, 13107, 57000]
    rig.daq.open()
    rig.run(1.0)
    assert rig.daq.identity == "ccatp-daq 1.2 SN7"
    assert len(rig.samples) == pytest.approx(1000, abs=10)  # one packet
    assert rig.samples[-1].edges_v == pytest.approx((3.3, 0.0, 1.65, 0.66), abs=1e-4)
    assert rig.daq.battery_v == pytest.approx(57000 / 65535 * 3.3 * 4.0)
    assert rig.time.now_s - rig.samples[-1].t_s < 0.008
    assert not any(rig.faults)
    rig.daq.close()
    assert rig.device.read(4096) == rig.device.read(4096) == b""  # it has stopped


@pytest.mark.parametrize(("start", "step"), [(0x7FFFFFFF - 300, 1), (-0x80000000 + 300, -1), (0, 7), (-5, -1000)])
def test_counts_wrap_and_begin_at_zero(start: int, step: int) -> None:
    rig = Rig()
    rig.device.step, rig.device.counts = [step, -step], [start, -start]
    rig.daq.open()
    rig.run(1.0)
    rights, lefts = ([getattr(sample, side) for sample in rig.samples] for side in ("right", "left"))
    assert {b - a for a, b in itertools.pairwise(rights)} == {step}
    assert [-right for right in rights] == lefts
    assert abs(rights[0]) <= 200 * abs(step)


@pytest.mark.parametrize(("adc", "soc"), [(65535, 1.0), (56000, 0.560), (48000, 0.022), (47000, 0.0), (0, 0.0)])
def test_state_of_charge(adc: int, soc: float) -> None:
    rig = Rig()
    rig.device.adc[4] = adc
    rig.daq.open()
    assert rig.daq.soc() == pytest.approx(soc, abs=1e-3)


def test_the_battery_does_not_follow_the_current_of_a_start(rig: Rig) -> None:
    rig.device.adc[4] = 48000
    rig.run(0.05)
    assert rig.daq.soc() > 0.5
    rig.run(8.0)
    assert rig.daq.soc() == pytest.approx(0.022, abs=1e-3)


# -- what breaks ------------------------------------------------------------------------------------------------------

Break = Callable[[FakeDaq], object]


def _set(**values: object) -> Break:
    return lambda device: device.__dict__.update(values)


def _each(count: int, change: Callable[[bytes], bytes]) -> Break:
    """Change every n-th frame."""
    frames = itertools.count(1)
    return _set(corrupt=lambda frame: change(frame) if next(frames) % count == 0 else frame)


def _unplug(device: FakeDaq) -> None:
    device.is_unplugged, device.open_error = True, HardwareError("/dev/ttyACM0: is not there; check the wiring")


def _plug(device: FakeDaq) -> None:
    device.is_unplugged, device.open_error = False, None
    device.boot()


def _slow(device: FakeDaq) -> None:
    device.fastest_hz = 500
    device.boot()


def _reset(device: FakeDaq, *, is_reported: bool = True) -> None:
    device.is_mute = not is_reported
    device.boot()
    device.is_mute = False


def _refuse(error: Exception) -> Break:
    return lambda device: device.__dict__.update(is_unplugged=True, open_error=error)


NOISE = random.Random(2)
WHOLE = _set(corrupt=bytes, is_mute=False, is_unplugged=False, open_error=None, version=1, fastest_hz=2000)
# What breaks, reason while it lasts (empty: no fault), what repairs it (None: it is not needed), ports opened by it.
BREAKS: dict[str, tuple[Break, str, Break | None, int]] = {
    "noise between frames": (_each(3, lambda frame: frame + NOISE.randbytes(40)), "", WHOLE, 0),
    "each fifth frame flipped": (_each(5, lambda frame: _flipped(frame, 30)), "", WHOLE, 0),
    "each fifth frame without a byte": (_each(5, lambda frame: frame[:50] + frame[51:]), "", WHOLE, 0),
    "each fifth frame lost": (_each(5, lambda _: b""), "", WHOLE, 0),
    "frames of unknown types": (_each(2, lambda _: format_frame(0x99, 0)), "", WHOLE, 0),
    "a line that is cut": (_set(is_mute=True), r"^no sample for \d\.\d\d s: it sends no samples", WHOLE, 0),
    "half a sample in a frame": (
        _set(corrupt=lambda _: format_frame(SAMPLES, 0, bytes(30))), "it sends no samples", WHOLE, 0,
    ),
    "another speed": (
        _set(corrupt=lambda frame: NOISE.randbytes(len(frame) // 2)),
        "garbage at 921600 baud; check devices.daq.baud", WHOLE, 0,
    ),
    "another version of the protocol": (
        _set(version=2), "speaks version 2 of the protocol instead of 1; install the firmware", WHOLE, 0,
    ),
    "unplugged": (_unplug, "is not there; check the wiring", _plug, 1),
    "permission lost": (_refuse(HardwareError("permission denied; add the user")), "permission denied", _plug, 1),
    "in use by another program": (_refuse(HardwareError("in use by another")), "in use by another", _plug, 1),
    "speed refused": (_refuse(ValueError("Invalid baud rate: 921600")), "Invalid baud rate: 921600", _plug, 1),
    "reset": (_reset, "it sends no samples, or has just started", None, 0),
    "reset, and its identity got lost": (
        lambda d: _reset(d, is_reported=False), "it sends no samples, or has just started", None, 0,
    ),
    "time backwards": (lambda d: setattr(d, "device_us", d.device_us - 500_000), "has just started", None, 0),
    "time jumps ahead": (lambda d: setattr(d, "device_us", d.device_us + 1e9), "has just started", None, 0),
    "firmware too slow": (
        _slow, "ccatp-daq 1.2 SN7 delivers 500 samples/s at most; lower devices.daq.sample_hz", WHOLE, 4,
    ),
}  # fmt: skip


@pytest.mark.parametrize(("broken", "reason", "repair", "opened"), BREAKS.values(), ids=BREAKS)
def test_what_breaks(rig: Rig, broken: Break, reason: str, repair: Break | None, opened: int) -> None:
    rig.device.step, opened_before = [1, -2], rig.device.opened
    broken(rig.device)
    rig.run(1.5)
    if repair is not None:
        repair(rig.device)
    rig.run(8.0)
    assert any(re.search(reason, fault) for fault in rig.faults) if reason else not any(rig.faults)
    assert not rig.faults[-1]
    assert rig.device.opened - opened_before == opened == rig.device.closed
    for before, after in itertools.pairwise(rig.samples):
        dt_s = after.t_s - before.t_s
        assert dt_s > 0.0
        assert 0 <= after.right - before.right <= 1000.0 * dt_s * 1.05 + 1
        assert after.left - before.left == -2 * (after.right - before.right)


def test_what_is_unknown_is_counted_and_samples_count_after_the_identity(rig: Rig) -> None:
    rig.device.send(0x99, b"?")
    rig.device.send(SAMPLES, bytes(23))
    rig.run(0.1)
    assert rig.daq.decoder.counts["unknown"] == 2
    second = Daq(CONFIG, rig.device.open, rig.time, rig.time.sleep)
    rig.device.corrupt = lambda frame: b"" if frame[3] == IDENTITY else frame
    for _ in range(200):  # it still runs from before, and does not say what it is
        rig.time.sleep(0.002)
        second.poll(rig.time.now_s)
    assert not second.take()
    assert "it does not answer" in second.fault(rig.time.now_s)


def test_a_device_that_reports_nothing_gets_its_port_opened_again_each_5_s(rig: Rig) -> None:
    rig.device.is_mute = True
    rig.run(60.0)
    assert 8 <= rig.device.opened <= 13
    assert "it does not answer; check its firmware" in rig.faults[-1]


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        (_refuse(HardwareError("/dev/ttyACM0: is not there")), "^data acquisition device: /dev/ttyACM0: is not there$"),
        (_set(is_mute=True), "it does not answer; check its firmware, devices.daq.device and devices.daq.baud"),
        (_set(corrupt=lambda _: b"\x00" * 99), "garbage at 921600 baud"),
        (_set(version=3), "speaks version 3"),
        (_set(fastest_hz=500), "500 samples/s at most"),
    ],
)
def test_a_device_that_is_not_right_is_refused(broken: Break, message: str) -> None:
    rig = Rig()
    broken(rig.device)
    with pytest.raises(HardwareError, match=message):
        rig.daq.open()


# -- a serial port of the kernel --------------------------------------------------------------------------------------


class Terminal:
    """A pseudo-terminal with the device at its other end, at a path that stays the same."""

    def __init__(self, rig: Rig, link: Path) -> None:
        self._rig, self._link = rig, link
        self.master = self.slave = -1
        self.daq = Daq(CONFIG.model_copy(update={"device": str(link)}), open_serial, rig.time, rig.time.sleep)

    def plug(self) -> None:
        self.master, self.slave = pty.openpty()
        tty.setraw(self.slave)
        os.set_blocking(self.master, False)
        self._link.symlink_to(os.ttyname(self.slave))
        self._rig.device.boot()

    def unplug(self) -> None:
        self._link.unlink()
        os.close(self.master)
        os.close(self.slave)

    def run_until(self, is_done: Callable[[], bool]) -> list[DaqSample]:
        """Pass bytes on and poll, until it is done; the kernel may take its time."""
        device, samples, until_s = self._rig.device, list[DaqSample](), time.monotonic() + 60.0
        while not is_done():
            assert time.monotonic() < until_s
            self._rig.time.sleep(0.002)
            with contextlib.suppress(OSError):  # nothing there, or unplugged
                device.write(os.read(self.master, 4096))
            with contextlib.suppress(OSError):
                os.write(self.master, device.read(4096))
            self.daq.poll(self._rig.time.now_s)
            samples += self.daq.take()
            time.sleep(0.0005)
        return samples

    def fault(self) -> str:
        return self.daq.fault(self._rig.time.now_s)


def test_unplug_and_replug_of_a_terminal(tmp_path: Path) -> None:
    rig = Rig()
    terminal = Terminal(rig, tmp_path / "ttyACM0")
    terminal.run_until(lambda: "is not there" in terminal.fault())
    terminal.plug()
    rig.device.step = [3, 3]
    samples = terminal.run_until(lambda: not terminal.fault())
    samples += terminal.run_until(lambda: len(samples) > 0 and rig.device.counts[0] > 3000)
    terminal.unplug()
    samples += terminal.run_until(lambda: "is not there" in terminal.fault())
    last = samples[-1]
    terminal.plug()
    samples = terminal.run_until(lambda: not terminal.fault())
    assert 0 <= samples[0].right - last.right <= 3 * 300  # what was counted while its clock was learnt
    garbage = random.Random(5)
    rig.device.corrupt = lambda frame: garbage.randbytes(len(frame))
    terminal.run_until(lambda: "garbage at 921600 baud" in terminal.fault())
    rig.device.corrupt = bytes
    terminal.run_until(lambda: not terminal.fault())
    terminal.daq.close()
    terminal.unplug()


def test_a_terminal_that_cannot_be_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig()
    terminal, path = Terminal(rig, tmp_path / "ttyACM0"), str(tmp_path / "ttyACM0")
    with pytest.raises(HardwareError, match="ttyACM0: is not there; check the wiring, the device tree"):
        open_serial(path, 921600, "devices.daq")
    (tmp_path / "file").write_text("")
    with pytest.raises(HardwareError, match=r"Could not configure port.*; check devices.daq"):
        open_serial(str(tmp_path / "file"), 921600, "devices.daq")
    terminal.plug()
    port = open_serial(path, 921600, "devices.daq")
    with pytest.raises(HardwareError, match="in use by another program"):
        open_serial(path, 921600, "devices.daq")
    port.close()
    monkeypatch.setattr(os, "open", _deny)
    with pytest.raises(HardwareError, match="permission denied; add the user of this program to the group dialout"):
        open_serial(path, 921600, "devices.daq")
    monkeypatch.undo()
    terminal.unplug()


def _deny(path: str, _flags: int) -> int:
    raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), path)
