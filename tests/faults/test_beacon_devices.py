"""Devices of a robot among beacons that break by bytes and lines: what the robot does by itself, and how fast.

The on-board program drives its wheels and scans over fake devices, in a time of its own.
"""

import itertools
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from ccatp.beacons.config.models import RadioConfig
from ccatp.beacons.onboard.hardware import BeaconAccess, BeaconHardware
from ccatp.onboard.hardware import HardwareError
from tests.faults.linking import Measured
from tests.support.beacon_fakes import CYCLE_S
from tests.support.beacon_rig import BeaconRig, DrivenRobot, onboard_config, pioneer_config

CFG = pioneer_config("zigbee")
STEP_S = 0.01
SPEED = 1.0  # rad/s
WATCHED_S = 3.0


class Driving:
    """A robot whose clients answer each frame, in steps of its control loop."""

    def __init__(self, cfg: RadioConfig = CFG, **settings: Any) -> None:
        self.rig = BeaconRig(cfg, onboard_config(cfg, **({"scan__every_s": 0.0} | settings)))
        self.robot = DrivenRobot(self.rig)
        self.robot.join("controller")
        self.robot.join("monitor")
        self.rate, self.steer = SPEED, 0.0
        self._due_s = self.rig.time.now_s
        self.answers = True
        self.run(1.5)
        assert not self.robot.faults

    def step(self) -> None:
        """One step of the control loop; each 0.1 s a drive and a permit."""
        time, robot = self.rig.time, self.robot
        time.now_s = round(time.now_s + STEP_S, 6)
        if time.now_s >= self._due_s:
            self._due_s = round(self._due_s + CYCLE_S, 6)
            robot.seq += 1
            robot._close_frame(time.now_s)
            if self.answers:
                robot.permit(robot.seq, True, True, True)
                robot.drive(robot.seq, self.rate, self.rate, time.now_s, self.steer)
        robot.control(time.now_s)

    def run(self, duration_s: float) -> None:
        for _ in range(round(duration_s / STEP_S)):
            self.step()

    def until(self, is_there: Callable[[], bool], most_s: float = 40.0) -> float:
        """Time until then, s."""
        start_s = self.rig.time.now_s
        while not is_there():
            assert self.rig.time.now_s - start_s < most_s
            self.step()
        return self.rig.time.now_s - start_s

    @property
    def is_held(self) -> bool:
        return self.robot.rules.is_held

    @property
    def goes_on(self) -> bool:
        return not self.is_held and self.rig.base.velocity > 0.0

    def holds(self, duration_s: float) -> int:
        """Steps in which the wheels are held."""
        count = 0
        for _ in range(round(duration_s / STEP_S)):
            self.step()
            count += self.is_held
        return count


Change = Callable[[Driving], object]


def each(count: int, change: Callable[[bytes], bytes]) -> Callable[[bytes], bytes]:
    """Change every n-th message."""
    messages = itertools.count(1)
    return lambda data: change(data) if next(messages) % count == 0 else data


def cut_anywhere() -> Callable[[bytes], bytes]:
    """Each fifth message lacks a byte, each time the next one."""
    places: Iterator[int] = itertools.count()

    def cut(data: bytes) -> bytes:
        k = next(places) % len(data)
        return data[:k] + data[k + 1 :]

    return each(5, cut)


def stall_flipped(data: bytes) -> bytes:
    """A standard packet in which a bit says that the left wheel is stalled."""
    return data[:15] + bytes([data[15] ^ 1]) + data[16:] if len(data) > 20 else data


def level_changed(data: bytes) -> bytes:
    """A frame whose last byte of data, of a strength -99 dBm, was changed."""
    return data[:-2] + b"\x63" + data[-1:]


def base(**values: object) -> Change:
    return lambda d: d.rig.base.__dict__.update(values)


def radio(**values: object) -> Change:
    return lambda d: d.rig.radio.__dict__.update(values)


NOTHING: Change = lambda _: None  # noqa: E731
WHOLE = base(is_mute=False, corrupt=bytes, stalls=[False, False], bumpers=[0, 0], stop_pressed=False, is_enabled=True,
             numbers=None)  # fmt: skip


def stop_and_go(driving: Driving) -> None:
    """What a client does after a stall: a drive of zero, then the next."""
    WHOLE(driving)
    driving.run(0.3)
    driving.rate = 0.0
    driving.run(0.3)
    driving.rate = SPEED


# What holds the wheels, and what lets them go on.
HOLDS: dict[str, tuple[Change, Change]] = {
    "B1": (lambda d: d.rig.base.unplug(), lambda d: d.rig.base.plug()),
    "B2": (base(is_mute=True), WHOLE),
    "B3": (lambda d: d.rig.base.power_on(), NOTHING),
    "B4": (base(corrupt=lambda data: bytes(len(data))), WHOLE),
    "B5": (base(stalls=[True, False]), stop_and_go),
    "B6": (base(stalls=[False, True]), stop_and_go),
    "B7": (base(bumpers=[1, 0]), stop_and_go),
    "B8": (base(bumpers=[0, 1]), stop_and_go),
    "B9": (base(stop_pressed=True), stop_and_go),
    "B10": (base(numbers=[0, 1, 2, 3, 4, 5, 6]), WHOLE),
    "B11": (base(numbers=[]), WHOLE),
}


def rows(names: Any) -> list[Any]:
    return [pytest.param(row, marks=pytest.mark.fault(row)) for row in names]


@pytest.mark.parametrize("row", rows(HOLDS))
def test_what_holds_the_wheels(row: str, measured: Measured) -> None:
    broken, repair = HOLDS[row]
    driving = Driving()
    broken(driving)
    measured(row, 1e3 * driving.until(lambda: driving.is_held), "ms")
    # Also a base that is not reached any more stands, by its own watchdog.
    driving.until(lambda: driving.rig.base.velocity == 0.0 or driving.rig.base.is_unplugged, 1.0)
    driving.run(0.5)
    assert driving.is_held
    repair(driving)
    driving.until(lambda: driving.goes_on)
    assert not driving.robot.faults


@pytest.mark.fault("B12")
def test_encoders_that_contradict_the_base_hold_it_for_good(measured: Measured) -> None:
    driving = Driving()
    driving.rig.base.counts_per_mm = 12.8
    measured("B12", 1e3 * driving.until(lambda: driving.is_held), "ms")
    driving.run(2.0)
    assert driving.is_held


def wrap(driving: Driving) -> None:
    driving.rig.base.counts = [2.0**31 - 3000.0, 2.0**31 - 9000.0]
    driving.until(lambda: not driving.is_held)  # the jump itself is no wheel's


CONTINUES: dict[str, Change] = {
    "B13": lambda d: setattr(d.rig, "_sonars_m", lambda: [5.0] * 16),
    "B14": wrap,
    "B15": lambda d: setattr(d.rig.base, "corrupt", cut_anywhere()),
    "B16": lambda d: setattr(d.rig.base, "corrupt", each(5, stall_flipped)),
    "B17": lambda d: setattr(d.rig.base, "corrupt", each(4, lambda _: b"")),
}


@pytest.mark.parametrize("row", rows(CONTINUES))
def test_what_holds_nothing(row: str, measured: Measured) -> None:
    driving = Driving()
    CONTINUES[row](driving)
    measured(row, driving.holds(WATCHED_S), "holds")
    assert all(abs((rate or 0.0) - SPEED) < 0.6 for _, rate, _ in driving.robot._enc[-5:])  # noise of the wheels


@pytest.mark.fault("B18")
def test_a_low_battery_is_on_the_link(measured: Measured) -> None:
    driving = Driving()
    driving.rig.base.battery_v = 11.1
    measured("B18", 1e3 * driving.until(lambda: "battery_low" in driving.robot.faults), "ms")
    assert not driving.is_held


@pytest.mark.fault("B19")
def test_the_base_stops_by_itself_after_the_end_of_the_program(measured: Measured) -> None:
    driving = Driving()
    time, device = driving.rig.time, driving.rig.base
    killed_s = time.now_s
    while device.velocity:
        time.sleep(STEP_S)
        device.live()
        assert time.now_s - killed_s < 2.0
    measured("B19", 1e3 * (time.now_s - killed_s), "ms")
    assert device.expired == 1


@pytest.mark.fault("B20")
def test_a_loop_that_stood_longer_than_the_watchdog_is_held(measured: Measured) -> None:
    driving = Driving()
    time, device, robot = driving.rig.time, driving.rig.base, driving.robot
    stopped_s = time.now_s
    while device.velocity:
        time.sleep(STEP_S)
        device.live()
        assert time.now_s - stopped_s < 2.0
    measured("B20", 1e3 * (time.now_s - stopped_s), "ms")
    robot.permit(robot.seq + 1, True, True, True, time.now_s)
    robot.drive(robot.seq + 1, SPEED, SPEED, time.now_s)
    driving.step()
    measured("B20", device.velocity != 0.0, "commands")
    assert robot.late_steps == 1
    driving.step()
    assert driving.goes_on


@pytest.mark.fault("B41")
def test_a_base_that_halted_resumes_nothing_when_the_program_is_started_again(measured: Measured) -> None:
    driving = Driving()
    time, device = driving.rig.time, driving.rig.base
    while device.velocity:
        time.sleep(STEP_S)
        device.live()
    moved, move = [0], device._move

    def watched(velocity_m_s: float, turn_rad_s: float) -> tuple[float, float]:
        moved[0] += bool(velocity_m_s or turn_rad_s)
        return move(velocity_m_s, turn_rad_s)

    device._move = watched
    access = BeaconAccess(lambda name, _baud, _key: driving.rig.ports[name].open(), driving.rig.dish.open_lines,
                          driving.rig.dish.open_input, time.sleep)  # fmt: skip
    BeaconHardware(driving.rig.onboard, time, access).start()
    measured("B41", moved[0], "cycles")
    assert device.is_enabled


@pytest.mark.fault("B21")
def test_a_drive_with_a_steering_angle_is_not_followed(measured: Measured) -> None:
    driving = Driving()
    driving.steer = 0.2
    measured("B21", 1e3 * driving.until(lambda: driving.is_held), "ms")
    driving.steer = 0.0
    driving.until(lambda: driving.goes_on)


# -- scans ------------------------------------------------------------------------------------------------------------


def in_scan(**settings: Any) -> Driving:
    """In the middle of a scan."""
    driving = Driving(scan__every_s=2.0, **settings)
    driving.until(lambda: driving.rig.dish.turned > 60)
    return driving


def scanned(driving: Driving) -> dict[str, list[float | None]]:
    """The levels of the next scan."""
    driving.until(lambda: driving.robot._scanned.scan is not None, 60.0)
    found = driving.robot._scanned.scan
    assert found is not None
    return found.levels


def lose_steps(driving: Driving) -> None:
    left = itertools.count()
    driving.rig.dish.lose = lambda _: next(left) < 4


INTERRUPTED: dict[str, tuple[Change, Change]] = {
    "B22": (lambda d: d.rig.radio.reset(), NOTHING),
    "B23": (lambda d: d.rig.radio.unplug(), lambda d: d.rig.radio.plug()),
    "B24": (radio(is_mute=True), radio(is_mute=False)),
    "B25": (radio(corrupt=lambda data: bytes(len(data))), radio(corrupt=bytes)),
    "B26": (lose_steps, NOTHING),
    "B27": (lambda d: setattr(d.rig.dish, "switch", False), lambda d: setattr(d.rig.dish, "switch", None)),
    "B28": (lambda d: setattr(d.rig.dish, "switch", True), lambda d: setattr(d.rig.dish, "switch", None)),
    "B29": (lambda d: setattr(d.rig.dish, "error", HardwareError("/dev/gpiochip1: in use by another program")),
            lambda d: setattr(d.rig.dish, "error", None)),
    "B30": (lambda d: d.rig.base.counts.__setitem__(0, d.rig.base.counts[0] + 5000.0), NOTHING),
}  # fmt: skip


@pytest.mark.parametrize("row", rows(INTERRUPTED))
def test_what_ends_a_scan(row: str, measured: Measured) -> None:
    broken, repair = INTERRUPTED[row]
    driving = in_scan()
    dish = driving.rig.dish
    broken(driving)
    # No bearing, and the robot drives on; the danger loop holds it when no radio was received for too long.
    measured(row, driving.until(lambda: driving.goes_on), "s")
    assert driving.robot._scanned.scan is None
    driving.run(1.0)
    repair(driving)
    assert len(scanned(driving)) == 4
    assert dish.lowest >= -220  # the search of the switch
    assert dish.highest <= 220


def share_of(levels: dict[str, list[float | None]]) -> float:
    """Of the directions with a level, percent."""
    row = [level is not None for one in levels.values() for level in one]
    return 100.0 * sum(row) / len(row)


OTHER = (0x0013A200405200FF).to_bytes(8, "big")


def strangers(driving: Driving) -> None:
    """Behind each fourth answer a packet of another radio, which the module then calls the last."""
    device = driving.rig.radio
    answers, frame = itertools.count(1), device.frame

    def sent(data: bytes, after_s: float = 0.0) -> None:
        if data[0] == 0x97 and next(answers) % 4 == 0:
            device.extra.append((b"\x90" + OTHER + b"\x12\x34\x01hi", 99))
        frame(data, after_s)

    device.frame = sent  # type: ignore[method-assign]


IN_SCANS: dict[str, Change] = {
    "B31": lambda d: setattr(d.rig.radio, "corrupt", cut_anywhere()),
    "B32": lambda d: setattr(d.rig.radio, "corrupt", each(5, level_changed)),
    "B33": strangers,
    "B34": lambda d: setattr(
        d.rig.radio, "corrupt", each(3, lambda data: data + b"\x7e\x00\x07\x8b\x01\x7d\x84\x00\x00\x01\x71")
    ),
}


@pytest.mark.parametrize("row", rows(IN_SCANS))
def test_a_scan_in_spite_of_damaged_frames(row: str, measured: Measured) -> None:
    driving = Driving(scan__every_s=2.0)
    IN_SCANS[row](driving)
    levels = scanned(driving)
    assert len(levels) == 4
    assert not {-99.0} & {level for one in levels.values() for level in one}
    measured(row, share_of(levels), "percent")


@pytest.mark.fault("B35")
def test_a_radio_whose_packets_are_relayed_is_left_out(measured: Measured) -> None:
    driving = Driving(scan__every_s=2.0)
    address = next(number for number, name in driving.rig.radio.nodes.items() if name == "beacon1")
    driving.rig.radio.frame(b"\xa1" + address.to_bytes(8, "big") + b"\x12\x34\x01\x01\xee\xff")
    levels = scanned(driving)
    measured("B35", "beacon1" in levels, "levels")
    assert len(levels) == 3


@pytest.mark.fault("B36")
def test_a_radio_that_is_off_is_left_out_and_named(measured: Measured) -> None:
    driving = Driving(scan__every_s=2.0)
    level = driving.rig.radio.level
    driving.rig.radio.level = lambda name: None if name == "beacon2" else level(name)
    began_s = driving.rig.time.now_s
    assert set(scanned(driving)) == {"beacon1", "beacon3", "beacon4"}
    measured("B36", driving.rig.time.now_s - began_s, "s")


# -- listeners --------------------------------------------------------------------------------------------------------

MOTES = pioneer_config("cricket")
ID = "1:25:61:61:b:0:0:42"


def listening() -> Driving:
    """A robot with one listening mote, which the motes of the field do not reach."""
    driving = Driving(MOTES, devices__listeners__devices={"robot": "/dev/mote"}, robot__loop_hz=100.0)
    driving.rig._listener = None
    driving.robot._motes.clear()
    return driving


@pytest.mark.fault("B37")
def test_a_mote_that_is_pulled_is_named_and_works_again(measured: Measured) -> None:
    driving = listening()
    mote = driving.rig.listeners["robot"]
    mote.unplug()
    measured("B37", driving.until(lambda: "listener robot" in driving.robot.faults), "s")
    assert not driving.is_held
    mote.plug()
    driving.until(lambda: not driving.robot.faults)
    mote.pulse(ID, "X", 0.005)
    driving.until(lambda: len(driving.robot._motes) == 1, 0.1)


@pytest.mark.fault("B38")
def test_a_mote_that_repeats_its_time_stamp_counts_once(measured: Measured) -> None:
    driving = listening()
    mote = driving.rig.listeners["robot"]
    mote.stamp_ms = 5131680
    for _ in range(4):
        mote.pulse(ID, "X", 0.005)
        driving.run(0.02)
    measured("B38", len(driving.robot._motes), "pulses")


@pytest.mark.fault("B39")
def test_lines_that_lack_a_byte_give_no_wrong_delay(measured: Measured) -> None:
    driving = listening()
    mote = driving.rig.listeners["robot"]
    wrong = 0
    for k in range(70):
        mote.corrupt = lambda data, k=k: data[:k] + data[k + 1 :]  # type: ignore[misc]
        mote.pulse(ID, "X", 0.012345)
        driving.run(0.02)
        wrong += any(abs(burst.delays_s[0] - 0.012345) > 3e-4 for burst in driving.robot._motes)
        driving.robot._motes.clear()
    measured("B39", wrong, "pulses")


@pytest.mark.fault("B40")
def test_a_mote_that_became_a_beacon_is_named(measured: Measured) -> None:
    driving = listening()
    mote = driving.rig.listeners["robot"]
    mote.mode = "Beacon"
    measured("B40", driving.until(lambda: "listener robot" in driving.robot.faults, 90.0), "s")
    assert "beacon mode" in driving.robot.faults["listener robot"]
