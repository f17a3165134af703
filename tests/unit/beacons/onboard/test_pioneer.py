"""The Pioneer base: handshake, speeds, odometry, sonars, its watchdog, and what breaks."""

import itertools
import random
from collections.abc import Callable
from math import inf, radians

import pytest

from ccatp.beacons.config.onboard_load import load_beacon_onboard_config
from ccatp.beacons.config.onboard_models import BeaconOnboardConfig
from ccatp.beacons.links.arcos_packets import format_command
from ccatp.beacons.onboard.pioneer import PioneerBase
from ccatp.onboard.hardware import HardwareError
from tests.support.beacon_fakes import FakePioneer, FakePort, FakeXBee
from tests.support.onboard_fakes import FakeTime

RADIUS_M, TRACK_M = 0.0975, 0.33


class Rig:
    """A base whose wheels follow at once, and its driver."""

    def __init__(self, **settings: object) -> None:
        overrides = {f"devices.base.{key}": value for key, value in settings.items()}
        cfg = load_beacon_onboard_config(None, overrides)
        self.time = FakeTime()
        self.ranges_m = [0.5 + 0.1 * k for k in range(16)]
        self.driven: list[tuple[float, float]] = []
        self.device = FakePioneer(self.time, self._move, lambda: self.ranges_m, TRACK_M)
        self.base = self.driver(cfg)
        self.samples: list[tuple[float, float | None, float | None]] = []

    def driver(self, cfg: BeaconOnboardConfig) -> PioneerBase:
        return PioneerBase(cfg.devices.base, cfg.robot, lambda *_: self.device.open(), self.time, self.time.sleep)

    def _move(self, velocity_m_s: float, turn_rad_s: float) -> tuple[float, float]:
        self.driven.append((velocity_m_s, turn_rad_s))
        return velocity_m_s, turn_rad_s

    def open(self) -> "Rig":
        self.base.open()
        return self

    def run(self, duration_s: float, right: float | None = None, left: float = 0.0) -> None:
        end_s = self.time.now_s + duration_s
        while self.time.now_s < end_s:
            self.time.sleep(0.01)
            self.base.poll(self.time.now_s)
            self.samples += self.base.take()
            if right is not None:
                self.base.drive(right, left, self.time.now_s)


@pytest.fixture
def rig() -> Rig:
    return Rig().open()


def test_the_handshake_and_what_the_base_says_of_itself(rig: Rig) -> None:
    assert rig.base.identity == "Pioneer p3dx-sh Bradley_1, watchdog 0.5 s"
    assert rig.base.soc == pytest.approx((12.5 - 11.0) / 1.7, abs=0.01)
    assert rig.device.is_enabled
    rig.run(0.2)
    assert not rig.base.fault(rig.time.now_s)


@pytest.mark.parametrize(("right", "left"), [(2.0, 2.0), (-1.0, -1.0), (1.0, -1.0), (1.503, 0.4071), (0.11, 0.13)])
def test_wheels_turn_as_commanded_in_the_mean_and_encoders_show_it(rig: Rig, right: float, left: float) -> None:
    rig.run(0.3, right, left)
    rig.samples.clear()
    first = len(rig.driven)
    rig.run(20.0, right, left)
    velocity = sum(v for v, _ in rig.driven[first:]) / len(rig.driven[first:])
    turn = sum(w for _, w in rig.driven[first:]) / len(rig.driven[first:])
    # Rounded to 1 mm/s and 1 degree/s, the rest is carried over. The fake base takes every second command.
    assert velocity == pytest.approx(0.5 * RADIUS_M * (right + left), abs=0.51e-3)
    assert turn == pytest.approx(RADIUS_M * (right - left) / TRACK_M, abs=radians(0.51))
    rights, lefts = ([sample[side] or 0.0 for sample in rig.samples] for side in (1, 2))
    assert sum(rights) / len(rights) == pytest.approx(right, abs=0.01)
    assert sum(lefts) / len(lefts) == pytest.approx(left, abs=0.01)
    assert not rig.base.fault(rig.time.now_s)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_counts_wrap(rig: Rig, sign: float) -> None:
    rig.device.counts = [-sign * (2.0**31 - 20_000), sign * (2.0**31 - 20_000)]
    rig.run(0.6, 0.0)
    rig.samples.clear()
    rig.run(1.0, 0.0)
    rig.run(4.0, sign, -sign)
    assert max(map(abs, rig.device.counts)) > 2.0**31 + 20_000
    assert [sample[1:] for sample in rig.samples[-30:]] == [pytest.approx((sign, -sign), abs=0.1)] * 30


def test_zero_is_sent_at_once_and_nothing_is_carried_over(rig: Rig) -> None:
    rig.run(1.0, 1.003, 0.4)
    rig.base.drive(0.0, 0.0, rig.time.now_s)
    assert (rig.device.velocity, rig.device.turn) == (0.0, 0.0)


def test_the_line_is_not_flooded(rig: Rig) -> None:
    written: list[bytes] = []
    rig.device.take = written.append  # type: ignore[assignment, method-assign]
    rig.run(1.0, 1.0, 0.5)
    assert 15 <= len(written) <= 21  # each 0.05 s; at 9600 baud a command of 18 bytes takes 19 ms


def test_the_watchdog_of_the_base_is_the_second_barrier(rig: Rig) -> None:
    rig.run(1.0, 2.0, 2.0)
    moving_s = rig.time.now_s
    while rig.device.velocity:  # nothing is sent any more, as after the end of the program
        rig.time.sleep(0.01)
        rig.device.live()
        assert rig.time.now_s - moving_s < 1.0
    assert rig.device.expired == 1
    assert rig.time.now_s - moving_s <= 0.5 + 0.1 + 0.05  # watchdog, a cycle, the last command's age


def test_settings_are_sent_one_in_each_step_and_before_any_speed() -> None:
    rig, written = Rig(), list[tuple[float, bytes]]()
    take = rig.device.take

    def taken(data: bytes) -> None:
        written.append((rig.time.now_s, data))
        take(data)

    rig.device.take = taken  # type: ignore[method-assign]
    rig.open().run(0.5, 1.0, 1.0)
    numbers = [[part[1] for part in data.split(b"\xfa\xfb")[1:]] for _, data in written]
    first = numbers.index([5])
    assert numbers[first : first + 8] == [[5], [5], [23], [23], [28], [19], [4], [11, 21]]
    times_s = [at_s for at_s, _ in written[first : first + 8]]
    assert min(later - before for before, later in itertools.pairwise(times_s)) >= 0.005 - 1e-9


@pytest.mark.parametrize("is_opened_again", [False, True], ids=["the cable was pulled", "the program was killed"])
def test_a_base_that_halted_does_not_resume_its_motion_when_it_is_reached_again(is_opened_again: bool) -> None:
    rig = Rig().open()
    rig.run(1.0, 2.0, 1.0)
    if not is_opened_again:
        rig.device.unplug()
        rig.base.poll(rig.time.now_s)
    while rig.device.velocity:
        rig.time.sleep(0.01)
        rig.device.live()
    rig.driven.clear()
    rig.device.plug()
    if is_opened_again:
        rig.base = rig.driver(load_beacon_onboard_config(None, {}))
        rig.base.open()
    rig.run(5.0)
    assert rig.base.is_ready
    assert rig.driven
    assert set(rig.driven) == {(0.0, 0.0)}


def test_a_base_that_waits_too_long_is_refused() -> None:
    rig = Rig()
    rig.device.watchdog_ms = 2000
    with pytest.raises(HardwareError, match=r"its watchdog is 2 s; set WatchDog of the base to at most 500 ms$"):
        rig.open()


def test_a_base_with_another_scale_is_refused() -> None:
    assert Rig(counts_per_mm=133.0).open().base.is_ready  # as the user has measured it
    with pytest.raises(HardwareError, match=r"TicksMM is 128; correct devices.base.counts_per_mm, which is 100$"):
        Rig(counts_per_mm=100.0).open()


def test_sonars_in_the_order_of_the_configuration(rig: Rig) -> None:
    rig.run(0.3)
    assert rig.base.distances_m(rig.time.now_s) == pytest.approx([0.5 + 0.1 * k for k in (7, 6, 5, 4, 3, 2, 1, 0)])
    rig.ranges_m[3] = 9.0
    rig.run(0.3)
    found = rig.base.distances_m(rig.time.now_s)
    assert found is not None
    assert found[4] == 5.0  # without an echo
    rig.device.numbers = [0, 1, 2]
    rig.run(1.5)
    assert rig.base.distances_m(rig.time.now_s) is None


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"stalls": [True, False]}, "left wheel stalled"),
        ({"stalls": [False, True]}, "right wheel stalled"),
        ({"bumpers": [4, 0]}, "front bumper pressed"),
        ({"bumpers": [0, 1]}, "rear bumper pressed"),
        ({"stop_pressed": True}, "its motors are off; press MOTORS on the base"),
    ],
)
def test_stalls_bumpers_and_the_stop_button(rig: Rig, change: dict[str, object], reason: str) -> None:
    rig.run(1.2)
    assert not rig.base.stall
    rig.device.__dict__.update(change)
    rig.run(0.3)
    assert rig.base.stall == reason
    rig.device.__dict__.update(stalls=[False, False], bumpers=[0, 0], stop_pressed=False, is_enabled=True)
    rig.run(0.3)
    assert not rig.base.stall


def test_the_motors_stay_off_after_the_stop_button(rig: Rig) -> None:
    rig.device.stop_pressed = True
    rig.run(5.0, 1.0, 1.0)
    rig.device.stop_pressed = False
    rig.run(5.0, 1.0, 1.0)
    assert not rig.device.is_enabled


def test_the_session_of_a_program_that_died_is_closed_first() -> None:
    rig = Rig().open()
    rig.run(0.5, 1.0, 1.0)
    rig.base = rig.driver(load_beacon_onboard_config())
    rig.open()
    assert rig.device.velocity == 0.0
    rig.run(0.3)
    assert not rig.base.fault(rig.time.now_s)


@pytest.mark.parametrize("stage", [1, 2])
def test_a_handshake_that_was_broken_off_goes_on(stage: int) -> None:
    """A program was killed in it, or a driver of another device asked who is there."""
    rig = Rig()
    for number in range(stage):
        rig.device.take(format_command(number))
    rig.open().run(0.5, 1.0, 1.0)
    assert rig.base.is_ready
    assert rig.base.identity == "Pioneer p3dx-sh Bradley_1, watchdog 0.5 s"


def test_a_base_that_is_switched_off_and_on(rig: Rig) -> None:
    rig.run(1.0, 1.0, 1.0)
    rig.device.is_mute = True
    rig.run(0.5)
    assert "no packet for" in rig.base.fault(rig.time.now_s)
    rig.device.is_mute = False
    rig.device.power_on()
    rig.samples.clear()
    rig.run(4.0)
    assert not rig.base.fault(rig.time.now_s)
    assert all(abs(sample[1] or 0.0) < 0.1 for sample in rig.samples)  # the counts began again at zero


def test_any_byte_of_a_packet_may_get_lost(rig: Rig) -> None:
    for k in range(60):
        packets = itertools.count()
        rig.device.corrupt = (
            lambda data, k=k, packets=packets: (  # type: ignore[misc]
                data[:k] + data[k + 1 :] if next(packets) % 5 == 0 else data
            )
        )
        rig.samples.clear()
        rig.run(1.0, 1.0, 1.0)
        assert all(0.5 < (sample[1] or 0.0) < 1.5 for sample in rig.samples), k
        assert len(rig.samples) >= 4


def test_encoders_that_contradict_the_base_are_a_fault() -> None:
    rig = Rig(counts_per_mm=60.0)
    rig.device.ticks_mm = 0  # it does not tell
    rig.open()
    rig.run(3.0, 2.0, 2.0)
    assert "contradict the speeds of the base; correct devices.base.counts_per_mm" in rig.base.fault(rig.time.now_s)
    rig = Rig(counts_per_mm=12.8)
    rig.device.ticks_mm = 0
    rig.open()
    rig.run(3.0, 2.0, 2.0)
    assert rig.base.fault(rig.time.now_s).startswith("the encoders show impossible speeds; check their cables")


@pytest.mark.parametrize("longest_s", [0.09, 0.3, 1.0])
def test_no_way_is_lost_when_packets_are_late_and_arrive_together(rig: Rig, longest_s: float) -> None:
    rng, send = random.Random(3), rig.device.packet

    def late(body: bytes, after_s: float = 0.0) -> None:
        send(body, after_s + rng.uniform(0.0, longest_s))

    rig.device.packet = late  # type: ignore[method-assign]
    begun_s, begun = rig.time.now_s, list(rig.device.counts)
    for right, left in ((3.0, 2.0), (0.5, 3.5), (0.0, 0.0), (-2.0, 2.0), (0.0, 0.0)):
        rig.run(8.0, right, left)
    del rig.device.packet
    rig.run(2.0, 0.0)
    times_s = [begun_s, *(sample[0] for sample in rig.samples)]
    for side, number in ((1, 1), (2, 0)):
        shown_rad = sum((sample[side] or 0.0) * (sample[0] - before_s)
                        for sample, before_s in zip(rig.samples, times_s[:-1], strict=True))  # fmt: skip
        true_rad = (rig.device.counts[number] - begun[number]) / (1e3 * RADIUS_M * rig.device.counts_per_mm)
        assert shown_rad == pytest.approx(true_rad, abs=0.002)


def test_packets_that_come_at_once_after_a_stall_of_the_program_contradict_nothing(rig: Rig) -> None:
    def stall(duration_s: float) -> None:
        end_s = rig.time.now_s + duration_s
        while rig.time.now_s < end_s:
            rig.time.sleep(0.01)
            rig.device.live()

    rig.run(1.0, 2.0, 2.0)
    rig.samples.clear()
    while not rig.samples:
        rig.run(0.01, 2.0, 2.0)
    stall(0.14)  # a packet is read late, so that the wheels seem to turn too fast until the next one
    rig.run(0.07, 2.0, 2.0)
    assert abs((rig.samples[-1][1] or 0.0) - 2.0) > 1.0
    stall(0.6)
    for _ in range(20):
        rig.run(0.01, 2.0, 2.0)
        assert "contradict" not in rig.base.fault(
            rig.time.now_s
        )  # for good, because a robot that is held shows no speed


def _set(**values: object) -> Callable[[Rig], FakePort]:
    def change(rig: Rig) -> FakePort:
        rig.device.__dict__.update(values)
        return rig.device

    return change


def _xbee(rig: Rig) -> FakePort:
    return FakeXBee(rig.time, ["beacon1"], lambda _: -40.0)


@pytest.mark.parametrize(
    ("other", "message"),
    [
        (_set(is_mute=True), "^base: it does not answer; check its supply, devices.base.device and devices.base.baud$"),
        (_set(corrupt=lambda data: bytes(200)), "^base: garbage at 9600 baud; check devices.base.baud$"),
        (_xbee, "^base: an XBee answers on its port; exchange the ports, or correct devices.base.device$"),
        (_set(open_error=HardwareError("/dev/ttyUSB0: permission denied")), "^base: /dev/ttyUSB0: permission denied$"),
    ],
)
def test_what_is_wrong_with_the_port(other: Callable[[Rig], FakePort], message: str) -> None:
    rig = Rig()
    device = other(rig)
    rig.base._line._open_port = lambda *_: device.open()
    with pytest.raises(HardwareError, match=message):
        rig.open()


def test_closing_stops_the_wheels_and_ends_the_session(rig: Rig) -> None:
    rig.run(0.5, 1.0, 1.0)
    rig.base.close()
    assert (rig.device.velocity, rig.device.is_enabled) == (0.0, True)
    assert rig.device.closed == 1
    assert rig.base.distances_m(inf) is None
