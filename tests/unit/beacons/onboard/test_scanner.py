"""Dish and scan: homing, positions, unwinding, lost steps, and what makes a scan give nothing."""

from collections.abc import Callable
from math import tau

import pytest

from ccatp.beacons.config.onboard_load import load_beacon_onboard_config
from ccatp.beacons.onboard.dish import Dish
from ccatp.beacons.onboard.scanner import Scanner, ScanResult
from ccatp.beacons.onboard.xbee import Coordinator
from ccatp.onboard.hardware import HardwareError
from tests.support.beacon_fakes import FakeDish, FakeXBee
from tests.support.onboard_fakes import FakeTime

NAMES = ["beacon1", "beacon2"]
POSITIONS = 8


class Rig:
    """A dish with a module and two radios; the strength of a radio is the number of the position."""

    def __init__(self, *, has_dish: bool = True, **settings: object) -> None:
        overrides = {f"devices.dish.{key}": value for key, value in settings.items()}
        fixed = {"devices.radio.names": NAMES, "devices.dish.steps_per_turn": 40, "devices.dish.positions": POSITIONS}
        cfg = load_beacon_onboard_config(None, {**fixed, **overrides}).devices
        self.config, self.time = cfg.dish, FakeTime()
        self.fake = FakeDish(cfg.dish.step_line, cfg.dish.direction_line, cfg.dish.steps_per_turn, start=7)
        self.lost: set[str] = set()
        self.asked: list[tuple[str, int]] = []
        self.device = FakeXBee(self.time, NAMES, self._level)
        self.radio = Coordinator(cfg.radio, lambda *_: self.device.open(), self.time, self.time.sleep)
        self.dish = Dish(cfg.dish, self.fake.open_lines, self.fake.open_input) if has_dish else None
        self.scanner = Scanner(cfg.dish, self.radio, self.dish, self.time, self.time.sleep)
        self.radio.open()
        if self.dish is not None:
            self.scanner.open()

    def _level(self, name: str) -> float | None:
        self.asked.append((name, self.fake.turned))
        return None if name in self.lost else -(self.fake.turned / 5.0 + 30.0)

    def run(self, duration_s: float, until: Callable[[], bool] = lambda: False) -> None:
        end_s = self.time.now_s + duration_s
        while self.time.now_s < end_s and not until():
            self.time.sleep(0.005)
            self.radio.poll(self.time.now_s)
            self.scanner.poll(self.time.now_s)

    def scan(self, change: Callable[[], object] = lambda: None, at_turned: int = 17) -> ScanResult | None:
        """A scan, with a change in the middle."""
        self.scanner.begin()
        self.run(20.0, lambda: self.fake.turned == at_turned)
        change()
        self.run(20.0, lambda: not self.scanner.is_scanning)
        return self.scanner.take()


def test_a_scan_has_a_level_of_each_radio_in_each_direction() -> None:
    rig = Rig()
    assert rig.scanner.is_ready
    assert rig.fake.turned == 0
    rig.asked.clear()
    began_s = rig.time.now_s
    result = rig.scan()
    assert result is not None
    assert result.scan is not None
    assert result.scan.step == pytest.approx(tau / POSITIONS)
    assert result.scan.levels == {name: [-30.0 - k for k in range(POSITIONS)] for name in NAMES}
    assert result.scan.t == pytest.approx(rig.time.now_s, abs=0.01)
    assert {turned for _, turned in rig.asked} == set(range(0, 40, 5))  # it stood while radios were asked
    assert (rig.fake.lowest, rig.fake.highest, rig.fake.turned) == (0, 35, 0)  # the cable was unwound
    assert rig.time.now_s - began_s > 70 * rig.config.step_s + POSITIONS * rig.config.settle_s
    assert rig.scanner.is_ready
    again = rig.scan()
    assert again is not None
    assert not rig.scanner.silence


def test_a_radio_that_is_lost_now_and_then_or_always() -> None:
    rig = Rig()
    result = rig.scan(lambda: rig.lost.add("beacon2"))
    assert result is not None
    assert result.scan is not None
    assert result.scan.levels["beacon2"][-1] is None
    rig.lost = set(NAMES)
    assert rig.scan() is None


def test_without_a_dish_strengths_have_no_direction() -> None:
    rig = Rig(has_dish=False)
    rig.scanner.begin()
    rig.run(1.0, lambda: not rig.scanner.is_scanning)
    result = rig.scanner.take()
    assert result is not None
    assert result.scan is None
    assert [(one.beacon, one.rssi_dbm, one.bearing_rad) for one in result.radio] == [
        ("beacon1", -31.0, None), ("beacon2", -31.0, None),
    ]  # fmt: skip


def _lose(count: int, from_turned: int) -> Callable[[Rig], None]:
    """So many steps are swallowed on the way out."""

    def change(rig: Rig) -> None:
        left = [count]

        def lose(turned: int) -> bool:
            left[0] -= turned >= from_turned
            return turned >= from_turned and left[0] >= 0

        rig.fake.lose = lose

    return change


def _reset(rig: Rig) -> None:
    rig.device.reset()


def _unplug(rig: Rig) -> None:
    rig.device.unplug()


def _move(rig: Rig) -> None:
    rig.scanner.interrupt("the robot moved")


def _lines(rig: Rig) -> None:
    rig.fake.error = HardwareError("/dev/gpiochip1: in use by another program")


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (_lose(3, 10), "the dish has lost 3 steps"),
        (_reset, "the radio module restarted"),
        (_unplug, "radio: its port is gone: Input/output error"),
        (_move, "the robot moved"),
        (_lines, "/dev/gpiochip1: in use by another program"),
    ],
)
def test_an_interrupted_scan_gives_nothing(change: Callable[[Rig], None], reason: str) -> None:
    rig = Rig()
    assert rig.scan(lambda: change(rig)) is None
    assert rig.scanner.silence == f"the newest scan gave nothing: {reason}"


def test_a_step_within_the_tolerance_is_forgiven() -> None:
    rig = Rig(tolerance_steps=3)
    assert rig.scan(lambda: _lose(3, 10)(rig)) is not None


def test_after_lost_steps_the_dish_is_homed_and_the_next_scan_is_right() -> None:
    rig = Rig()
    assert rig.scan(lambda: _lose(3, 10)(rig)) is None
    rig.fake.lose = lambda _: False
    rig.run(3.0, lambda: rig.scanner.is_ready)
    result = rig.scan()
    assert result is not None
    assert result.scan is not None
    assert result.scan.levels["beacon1"] == [-30.0 - k for k in range(POSITIONS)]


@pytest.mark.parametrize(
    ("switch", "message"),
    [(False, "dish: no end switch in a turn; check devices.dish.switch_line, motor and supply"),
     (True, "dish: its end switch does not open; check devices.dish.switch_line, motor and supply")],
)  # fmt: skip
def test_a_switch_that_does_not_change(switch: bool, message: str) -> None:
    rig = Rig()
    rig.fake.switch = switch
    rig.scanner.close()
    with pytest.raises(HardwareError, match=message):
        rig.scanner.open()
    rig.run(2.0)
    assert rig.scanner.fault == message
    assert not rig.scanner.is_ready
    turned = rig.fake.turned
    rig.run(2.0)
    assert rig.fake.turned == turned  # the cable is not wound any further


def test_a_switch_that_breaks_in_a_scan_does_not_wind_the_cable() -> None:
    rig = Rig()
    assert rig.scan(lambda: setattr(rig.fake, "switch", False)) is None
    assert rig.fake.lowest >= -11  # a quarter of a turn
    assert rig.scanner.fault == "dish: its end switch does not close any more; check devices.dish.switch_line"


def test_homing_by_hand_takes_the_dish_as_it_stands() -> None:
    rig = Rig(homing="hand")
    assert rig.fake.turned == 7
    assert rig.scan(at_turned=24) is not None
    assert (rig.fake.lowest, rig.fake.highest, rig.fake.turned) == (7, 42, 7)


def test_a_turn_to_the_right_with_the_other_level() -> None:
    rig = Rig(left_is_high=False, homing="hand")
    rig.scanner.begin()
    rig.run(1.0)
    assert rig.fake.turned < 7  # the fake turns left at a high level
