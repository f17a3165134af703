"""The inertial unit by its registers: set-up, frame, and what breaks on the bus and in the unit."""

import contextlib
import errno
import itertools
import math
import os
import re
import threading
import time
from collections.abc import Callable

import pytest

from ccatp.config.load import load_onboard_config
from ccatp.config.onboard_models import Bno055Config
from ccatp.onboard.devices.bno055 import BURST_START, Bno055, Bno055Sample, axis_registers
from ccatp.onboard.hardware import HardwareError
from tests.support.onboard_fakes import FakeBno055, FakeTime

CONFIG = load_onboard_config().devices.bno055
NACK, EIO, TIMEOUT = (OSError(code, os.strerror(code)) for code in (errno.EREMOTEIO, errno.EIO, errno.ETIMEDOUT))

Break = Callable[[FakeBno055], object]


class Rig:
    """The unit and its reader, called without the thread."""

    def __init__(self, config: Bno055Config = CONFIG) -> None:
        self.time = FakeTime()
        self.faults: list[str] = []  # at each moment that the reader waits for
        self.unit = FakeBno055(self.time)
        self.reader = Bno055(config, self.unit.open, self.time, self.sleep)

    def sleep(self, wait_s: float) -> None:
        self.time.sleep(wait_s)
        self.faults.append(self.fault())

    def run(self, duration_s: float) -> None:
        end_s = self.time.now_s + duration_s
        while self.time.now_s < end_s:
            self.sleep(self.reader.step())

    def take(self) -> list[Bno055Sample]:
        return self.reader.take(self.time.now_s)

    def fault(self) -> str:
        return self.reader.fault(self.time.now_s)


@pytest.fixture(autouse=True)
def no_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    """The tests call the reader themselves."""
    monkeypatch.setattr(threading.Thread, "start", lambda _thread: None)


@pytest.fixture
def rig() -> Rig:
    rig = Rig()
    rig.reader.open()
    rig.run(0.1)
    assert not rig.fault()
    rig.take()
    rig.faults.clear()
    return rig


# -- set-up -----------------------------------------------------------------------------------------------------------

STARTS: dict[str, Break] = {
    "fresh": lambda unit: unit.power_on(),
    "its supply came a moment ago": lambda unit: unit.power_on(deaf_s=0.4),
    "left in another mode by another program": lambda unit: unit.registers.__setitem__(0x3D, 0x0C),
    "left on page 1 by another program": lambda unit: setattr(unit, "page", 1),
    "resets before it acknowledges": lambda unit: _fail_once(unit, 0x3F),
}


def _fail_once(unit: FakeBno055, register: int) -> None:
    write = unit.write

    def failing(address: int, data: bytes) -> None:
        write(address, data)
        if data[0] == register:
            raise NACK

    unit.write = failing  # type: ignore[method-assign]


@pytest.mark.parametrize("before", STARTS.values(), ids=STARTS)
def test_set_up(before: Break) -> None:
    rig = Rig()
    before(rig.unit)
    rig.reader.open()
    assert (rig.unit.mode, rig.unit.page, rig.unit.registers[0x3B]) == (0x08, 0, 0x02)
    rig.run(0.1)
    assert rig.reader.identity == "BNO055 software 3.11 boot loader 15, gyroscope calibrated 3 of 3"
    assert len(rig.take()) == 10


REFUSED: dict[str, tuple[Break, str]] = {
    "nothing there": (lambda u: setattr(u, "error", NACK), "Remote I/O error; check the wiring of the I2C bus"),
    "bus held down": (lambda u: setattr(u, "error", TIMEOUT), "Connection timed out; check the wiring"),
    "another device": (lambda u: setattr(u, "chip_id", 0xFB), "at 0x28: chip id 0xfb instead of 0xa0: another device"),
    "units refused": (lambda u: u.stuck.update({0x3B: 0x80}), "unit selection reads back 0x80 after 0x02"),
    "axes refused": (lambda u: u.stuck.update({0x41: 0x21}), "axis map reads back 0x21 after 0x24"),
    "signs refused": (lambda u: u.stuck.update({0x42: 0x07}), "axis signs reads back 0x07 after 0x00"),
    "mode refused": (lambda u: u.stuck.update({0x3D: 0x00}), "operation mode reads back 0x00 after 0x08"),
    "gyroscope broken": (lambda u: setattr(u, "self_test", 0x0B), "self test failed: gyroscope; replace"),
    "all but the magnetometer broken": (
        lambda u: setattr(u, "self_test", 0x02), "self test failed: accelerometer, gyroscope, controller",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("broken", "message"), REFUSED.values(), ids=REFUSED)
def test_a_unit_that_is_not_right_is_refused(broken: Break, message: str) -> None:
    rig = Rig()
    broken(rig.unit)
    with pytest.raises(HardwareError, match=message):
        rig.reader.open()


@pytest.mark.parametrize(
    ("axes", "registers"),
    [
        (("x", "y", "z"), (0x24, 0)),
        (("-y", "x", "z"), (0x21, 0x04)),  # P0 of the data sheet's table of placements
        (("-x", "-y", "z"), (0x24, 0x06)),
        (("y", "x", "-z"), (0x21, 0x01)),
        (("z", "x", "y"), (0x12, 0)),
        (("y", "z", "x"), (0x09, 0)),
    ],
)
def test_axes(axes: tuple[str, str, str], registers: tuple[int, int]) -> None:
    assert axis_registers(axes) == registers


def test_there_are_24_ways_to_mount_a_unit() -> None:
    registers = []
    for axes in itertools.product(("x", "-x", "y", "-y", "z", "-z"), repeat=3):
        with contextlib.suppress(HardwareError):
            registers.append(axis_registers(axes))
    assert len(registers) == len(set(registers)) == 24


@pytest.mark.parametrize("axes", [("x", "x", "z"), ("x", "y", "-z"), ("y", "x", "z"), ("-x", "-y", "-z")])
def test_axes_of_a_mirror_image_are_refused(axes: tuple[str, str, str]) -> None:
    rig = Rig(CONFIG.model_copy(update={"axes": axes}))
    with pytest.raises(HardwareError, match="not those of a turned unit"):
        rig.reader.open()


# -- readings ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("axes", "unit_gravity", "falls"),
    [
        (("x", "y", "z"), (0.0, 0.0, 9.81), (0.0, 0.0, -1.0)),  # flat: an accelerometer shows up, things fall down
        (("x", "y", "z"), (6.0, 0.0, 7.76), (-0.612, 0.0, -0.791)),  # front raised: things fall to the rear
        (("-y", "x", "z"), (6.0, 0.0, 7.76), (0.0, -0.612, -0.791)),
        (("x", "-y", "-z"), (0.0, 0.0, -9.81), (0.0, 0.0, -1.0)),  # mounted upside down
    ],
)
def test_gravity_is_where_things_fall_in_the_robots_frame(
    axes: tuple[str, str, str], unit_gravity: tuple[float, float, float], falls: tuple[float, float, float]
) -> None:
    rig = Rig(CONFIG.model_copy(update={"axes": axes}))
    rig.unit.gravity_m_s2 = unit_gravity
    rig.reader.open()
    rig.run(0.03)
    sample = rig.take()[-1]
    assert sample.gravity == pytest.approx(falls, abs=2e-3)  # a bit is 1e-3 of g
    assert math.hypot(*sample.gravity) == pytest.approx(1.0)


def test_rate_and_acceleration(rig: Rig) -> None:
    rig.unit.ax_m_s2, rig.unit.ay_m_s2, rig.unit.wz_rad_s = -0.37, 0.21, 1.25
    rig.run(0.02)
    sample = rig.take()[-1]
    assert (sample.ax_m_s2, sample.ay_m_s2, sample.wz_rad_s) == (-0.37, 0.21, 1.25)
    assert sample.t_s == pytest.approx(rig.time.now_s - 0.01)


def test_a_sample_that_is_newer_than_the_frame_waits_for_the_next_one(rig: Rig) -> None:
    frame_s = rig.time.now_s
    rig.run(0.02)
    assert [sample.t_s for sample in rig.reader.take(frame_s)] == [frame_s]
    assert len(rig.take()) == 1


def test_samples_that_nobody_takes_are_bounded(rig: Rig) -> None:
    rig.run(10.0)
    samples = rig.take()
    assert len(samples) == 64
    assert samples[-1].t_s == pytest.approx(rig.time.now_s - 0.01)


# -- what breaks ------------------------------------------------------------------------------------------------------


def _torn(burst: bytes) -> bytes:
    """Gravity z with the high byte of another reading."""
    return burst[:31] + b"\x04" + burst[32:]


def _once(unit: FakeBno055, tamper: Callable[[bytes], bytes]) -> Callable[[bytes], bytes]:
    def changed(burst: bytes) -> bytes:
        unit.tamper = bytes
        return tamper(burst)

    return changed


def _high(place: int) -> Callable[[bytes], bytes]:
    """A controller that does not wait for the stretched clock."""
    return lambda burst: burst[:place] + bytes((burst[place] ^ 0x80,)) + burst[place + 1 :]


def _flip_once(place: int) -> Break:
    return lambda unit: setattr(unit, "tamper", _once(unit, _high(place)))


def _set(**values: object) -> Break:
    return lambda unit: unit.__dict__.update(values)


WHOLE = _set(error=None, tamper=bytes, chip_id=0xA0)
# What breaks, reason while it lasts (empty: no fault), what repairs it (None: it is not needed), resets it takes.
BREAKS: dict[str, tuple[Break, str, Break | None, int]] = {
    "one transfer not acknowledged": (_set(error=NACK, errors=1), "", None, 0),
    "two transfers fail": (_set(error=EIO, errors=2), "", None, 0),
    "one reading torn": (lambda u: setattr(u, "tamper", _once(u, _torn)), "", None, 0),
    "highest bit of the rate wrong once": (_flip_once(5), "", None, 0),
    "highest bit of the quaternion wrong once": (_flip_once(15), "", None, 0),
    "highest bit of the acceleration wrong once": (_flip_once(21), "", None, 0),
    "highest bit of gravity wrong once": (_flip_once(31), "", None, 0),
    "bus locked until it is opened again": (_set(error=TIMEOUT, is_locked=True), "", None, 0),
    "no acknowledge": (
        _set(error=NACK), r"^no reading for 0\.\d\d s: \[Errno 121\] Remote I/O error; check the wiring",
        WHOLE, 0,
    ),
    "input/output error": (_set(error=EIO), r"\[Errno 5\] Input/output error; check the wiring", WHOLE, 0),
    "bus held down": (_set(error=TIMEOUT), r"\[Errno 110\] Connection timed out; check the wiring", WHOLE, 0),
    "data line stuck at one": (
        _set(tamper=lambda burst: b"\xff" * len(burst)), "the bus reads ones only; check its wiring", WHOLE, 0,
    ),
    "every reading torn": (_set(tamper=_torn), r"wrong bits \(gravity 12.\d\d m/s\^2\)", WHOLE, 0),
    "no fusion": (_set(tamper=lambda burst: bytes(32) + burst[32:]), "wrong bits", WHOLE, 0),
    "readings frozen": (_set(is_frozen=True), "the readings do not change", None, 1),
    "reset while running": (lambda u: u.power_on(), r"was reset \(mode 0x00, units 0x80\); check its supply", None, 1),
    "brown-out": (lambda u: u.power_on(deaf_s=0.5), "Remote I/O error", None, 1),
    "units lost": (lambda u: u.registers.__setitem__(0x3B, 0), r"was reset \(mode 0x08, units 0x00\)", None, 1),
    "another mode": (lambda u: u.registers.__setitem__(0x3D, 0x0C), r"was reset \(mode 0x0c", None, 1),
    "system error": (
        lambda u: u.registers.__setitem__(slice(0x39, 0x3B), b"\x01\x09"), "reports system error 9; check", None, 1,
    ),
    "another device on its address": (
        _set(chip_id=0xFB, registers=bytearray(128)), "chip id 0xfb instead of 0xa0", WHOLE, 1,
    ),
}  # fmt: skip


@pytest.mark.parametrize(("broken", "reason", "repair", "resets"), BREAKS.values(), ids=BREAKS)
def test_what_breaks(rig: Rig, broken: Break, reason: str, repair: Break | None, resets: int) -> None:
    rig.unit.resets = 0
    rig.unit.wz_rad_s = 0.5
    broken(rig.unit)
    rig.run(0.15)
    if repair is not None:
        repair(rig.unit)
    rig.run(6.0)
    assert rig.reader.errors > 0
    assert any(re.search(reason, fault) for fault in rig.faults) if reason else not any(rig.faults)
    assert not rig.faults[-1]
    assert rig.unit.resets == resets
    assert {sample.wz_rad_s for sample in rig.take()} == {0.5}


@pytest.mark.parametrize("register", [0x3B, 0x3D])
def test_a_wrong_bit_that_means_nothing_does_not_reset_the_unit(rig: Rig, register: int) -> None:
    rig.unit.tamper = _high(register - BURST_START)
    rig.run(1.0)
    assert not any(rig.faults)
    assert rig.unit.resets == 1  # at the start


def test_attempts_at_a_unit_that_is_gone_come_further_and_further_apart(rig: Rig) -> None:
    rig.unit.error = NACK
    rig.run(60.0)
    assert rig.unit.opened < 80  # once a second
    assert "Remote I/O error" in rig.fault()


def test_each_attempt_without_a_sample_counts_and_each_bus_is_closed_once(rig: Rig) -> None:
    rig.unit.error, rig.unit.errors = NACK, 5
    rig.run(1.0)
    assert rig.reader.errors == 5
    assert rig.unit.opened == rig.unit.closed + 1 == 4  # opened again before each attempt after the third failure


def test_a_transfer_that_hangs_is_a_fault_and_does_not_keep_the_program_from_its_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.undo()
    rig, hanging, release = Rig(), threading.Event(), threading.Event()
    config = CONFIG.model_copy(update={"rate_hz": 1000.0})
    reader = Bno055(config, rig.unit.open, rig.time, rig.time.sleep)

    def hang(burst: bytes) -> bytes:
        hanging.set()
        release.wait(60.0)
        return burst

    rig.unit.tamper = hang
    reader.open()
    try:
        assert hanging.wait(60.0)
        rig.time.sleep(0.06)
        assert reader.fault(rig.time.now_s) == (
            "no reading for 0.06 s: a transfer hangs; check the wiring of the I2C bus"
        )
        reader.close()  # returns
    finally:
        release.set()


def test_the_thread_reads_and_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    rig = Rig()
    config = CONFIG.model_copy(update={"rate_hz": 1000.0})
    reader = Bno055(config, rig.unit.open, rig.time, rig.time.sleep)
    reader.open()
    until_s = time.monotonic() + 60.0
    samples = reader.take(rig.time.now_s)
    while len(samples) < 5 and time.monotonic() < until_s:
        time.sleep(0.001)
        samples += reader.take(rig.time.now_s)
    reader.close()
    assert len(samples) >= 5
    assert not any(thread.name == "bno055" for thread in threading.enumerate())
