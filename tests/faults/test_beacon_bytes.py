"""Forty attacks on the indoor robot's devices at the level of bytes: each is handled or reported, none is silent.

Handled: speeds, levels and delays in the frames are right, and no fault. Reported: a fault names it, and what is in the
frames is right all the same. Every frame is one that a client can read.
"""

import itertools
import random
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from ccatp.beacons.links.messages import decode_beacon_frame
from ccatp.links.robot_codec import MAX_LINE_BYTES, decode_from_robot
from ccatp.links.robot_messages import Sensors
from tests.faults.test_beacon_devices import CFG, ID, OTHER, SPEED, Driving, each, listening
from tests.support.beacon_fakes import FakePort

Attack = Callable[[Driving], object]
HANDLED = ""
LEVELS = {"beacon1": -41.0, "beacon2": -52.0, "beacon3": -63.0, "beacon4": -74.0}
DELAY_S = 0.012345


class Seen:
    """What the frames of some seconds show."""

    def __init__(self, driving: Driving, duration_s: float) -> None:
        self.rates: list[float] = []
        self.levels: dict[str, set[float | None]] = {}
        self.delays_s: set[float] = set()
        self.faults: set[str] = set()
        robot, seq = driving.robot, driving.robot.seq
        for _ in range(round(duration_s / 0.01)):
            driving.step()
            self.faults |= set(robot.faults.values())
            if robot.seq != seq:
                seq = robot.seq
                self._read(robot.delivered_line)

    def _read(self, line: bytes) -> None:
        assert len(line) <= MAX_LINE_BYTES
        frame, extras = decode_from_robot(line.rstrip()), decode_beacon_frame(line.rstrip())
        assert isinstance(frame, Sensors)
        self.rates += [rate for _, *rates in frame.enc for rate in rates if rate is not None]
        for name, row in extras.scan.levels.items() if extras.scan is not None else ():
            self.levels.setdefault(name, set()).update(row)
        self.delays_s |= {delay_s for burst in extras.motes for delay_s in burst.delays_s}

    def judge(self, report: str) -> None:
        """A report names the attack; without one nothing is a fault."""
        assert any(report in fault for fault in self.faults) if report else not self.faults, self.faults
        # The wheels have the noise of the simulated odometry, also while they are being stopped.
        assert all(-0.6 < rate < SPEED + 0.6 for rate in self.rates)
        for name, row in self.levels.items():
            assert row <= {LEVELS[name], None}
        assert all(abs(delay_s - DELAY_S) < 3e-4 for delay_s in self.delays_s)


RNG = random.Random(11)


def corrupt(device: str, change: Callable[[bytes], bytes]) -> Attack:
    return lambda d: setattr(getattr(d.rig, device), "corrupt", change)


def also(device: str, make: Callable[[], bytes]) -> Attack:
    """Bytes between the messages of a device, each time that it is read."""

    def change(driving: Driving) -> None:
        port: FakePort = getattr(driving.rig, device)
        live = port.live

        def send() -> None:
            port.send(make())
            live()

        port.live = send  # type: ignore[method-assign]

    return change


def every_place(change: Callable[[bytes, int], bytes], count: int) -> Callable[[bytes], bytes]:
    """Change each n-th message, each time at the next byte."""
    places: Iterator[int] = itertools.count()
    return each(count, lambda data: change(data, next(places) % len(data)))


def flip(data: bytes, k: int) -> bytes:
    return data[:k] + bytes([data[k] ^ 0x10]) + data[k + 1 :]


# -- the base ----------------------------------------------------------------------------------------------------------


def never(*kinds: int) -> Attack:
    """A base that begins again and never sends these packets."""

    def change(driving: Driving) -> None:
        driving.rig.base.power_on()
        driving.rig.base.corrupt = lambda data: b"" if data[3] in kinds else data

    return change


def packets(kind: int, change: Callable[[bytes], bytes]) -> Attack:
    """Change the bodies of packets, with right check sums."""

    def begin(driving: Driving) -> None:
        device = driving.rig.base
        send = device.packet
        device.packet = lambda body, after_s=0.002: send(  # type: ignore[method-assign]
            change(body) if body[0] == kind else body, after_s
        )

    return begin


def stuck() -> Callable[[bytes], bytes]:
    first: list[bytes] = []

    def repeat(body: bytes) -> bytes:
        first.append(body)
        return first[0]

    return repeat


def watchdog_of_zero(driving: Driving) -> None:
    driving.rig.base.power_on()
    driving.rig.base.watchdog_ms = 0


def base(**values: object) -> Attack:
    return lambda d: d.rig.base.__dict__.update(values)


SILENT = "it does not answer; check its supply, devices.base.device and devices.base.baud"
BASE: dict[str, tuple[Attack, str]] = {
    "garbage between packets": (also("base", lambda: RNG.randbytes(20)), HANDLED),
    "much garbage": (also("base", lambda: RNG.randbytes(500)), HANDLED),
    "headers between packets": (also("base", lambda: b"\xfa\xfb\xc8" * 10), HANDLED),
    "a flood of unknown packets": (also("base", lambda: b"\xfa\xfb\x03\xa0\x00\xa0" * 50), HANDLED),
    "half packets": (corrupt("base", lambda data: data[: len(data) // 2]), "no packet for"),
    "each fifth packet halved": (corrupt("base", each(5, lambda data: data[: len(data) // 2])), HANDLED),
    "a wrong bit at every place": (corrupt("base", every_place(flip, 5)), HANDLED),
    "each fifth check sum wrong": (corrupt("base", each(5, lambda data: data[:-1] + bytes([data[-1] ^ 1]))), HANDLED),
    "never SYNC0": (never(0), SILENT),
    "never SYNC1": (never(1), SILENT),
    "never SYNC2": (never(2), SILENT),
    "never its configuration": (never(0x20), SILENT),
    "never its encoders": (never(0x90), "no packet for"),
    "never its standard packet": (never(0x32, 0x33), "no packet for"),
    "encoders that stand": (packets(0x90, stuck()), "the encoders contradict the speeds of the base"),
    "counters that wrap": (base(counts=[2.0**31 - 3000.0, 2.0**31 - 9000.0]), HANDLED),
    "a count that jumps once": (
        lambda d: setattr(d.rig.base, "counts", [count + 65536.0 for count in d.rig.base.counts]), HANDLED,
    ),
    "a bit of a count that is wrong again and again": (
        packets(0x90, each(5, lambda body: body[:3] + bytes([body[3] ^ 0x20]) + body[4:])),
        "the encoders show impossible speeds",
    ),
    "a stalled motor": (base(stalls=[True, False]), "left wheel stalled"),
    "a low battery": (base(battery_v=11.1), "battery at 6 %; charge it"),
    "a watchdog of zero": (
        watchdog_of_zero, "its watchdog is 0 s; set WatchDog of the base",
    ),
    "a port that is gone": (lambda d: d.rig.base.unplug(), "its port is gone: Input/output error"),
}  # fmt: skip


@pytest.mark.parametrize(("attack", "report"), BASE.values(), ids=BASE)
def test_attacks_on_the_base(attack: Attack, report: str) -> None:
    driving = Driving()
    attack(driving)
    Seen(driving, 4.0).judge(report)


# -- the radio module --------------------------------------------------------------------------------------------------


def answers(kind: int, change: Callable[[bytes], list[bytes]]) -> Attack:
    """Change the frames of a type, with right check sums."""

    def begin(driving: Driving) -> None:
        device = driving.rig.radio
        send = device.frame

        def frame(data: bytes, after_s: float = 0.0) -> None:
            for one in change(data) if data[0] == kind else [data]:
                send(one, after_s)

        device.frame = frame  # type: ignore[method-assign]

    return begin


def strength(value: bytes) -> Attack:
    return answers(0x88, lambda data: [data[:5] + value if data[2:4] == b"DB" else data])


def packet_of_another(kind: bytes) -> Attack:
    def change(driving: Driving) -> None:
        device = driving.rig.radio
        live = device.live

        def come() -> None:
            device.frame(kind)
            live()

        device.live = come  # type: ignore[method-assign]

    return change


def twins(driving: Driving) -> None:
    driving.rig.radio.nodes[0x0013A20040529999] = "beacon1"
    driving.rig.radio.reset()


def lose_steps(driving: Driving) -> None:
    driving.rig.dish.lose = lambda _: RNG.random() < 0.1


ALL = "no level of beacon1, beacon2, beacon3, beacon4: "
RADIO: dict[str, tuple[Attack, str]] = {
    "garbage between frames": (also("radio", lambda: RNG.randbytes(30)), "or damaged bytes, behind them"),
    "long lengths between frames": (also("radio", lambda: b"\x7e\x01\x00"), ALL + "60 requests without an answer"),
    "half frames": (corrupt("radio", lambda data: data[: len(data) // 2]), "garbage at 9600 baud"),
    "a wrong bit at every place": (corrupt("radio", every_place(flip, 5)), HANDLED),
    "a flood of packets of another radio": (
        packet_of_another(b"\x90" + OTHER + b"\x12\x34\x01hi"), "answers with another packet",
    ),
    "a flood of transmit status": (packet_of_another(b"\x8b\x01\x7d\x84\x00\x00\x01"), HANDLED),
    "each answer twice": (answers(0x97, lambda data: [data, data]), "answers with another packet"),
    "answers of a wrong radio": (
        answers(0x97, lambda data: [data[:2] + OTHER + data[10:]]), ALL + "60 requests without an answer",
    ),
    "requests that are not delivered": (answers(0x97, lambda data: [data[:14] + b"\x04"]), "requests not delivered"),
    "no strength": (strength(b"\x00"), "answers without a possible strength"),
    "an impossible strength": (strength(b"\xff"), "answers without a possible strength"),
    "an empty strength": (strength(b""), "answers without a possible strength"),
    "two radios with one name": (twins, "several radios have the name beacon1; set NI of each to another one"),
    "a dish that loses steps": (lose_steps, "the newest scan gave nothing: the dish has lost"),
}  # fmt: skip


@pytest.mark.parametrize(("attack", "report"), RADIO.values(), ids=RADIO)
def test_attacks_on_the_radio_module(attack: Attack, report: str) -> None:
    driving = Driving(CFG, scan__every_s=2.0)
    driving.rig.radio.level = LEVELS.__getitem__
    attack(driving)
    Seen(driving, 30.0).judge(report)


# -- motes -------------------------------------------------------------------------------------------------------------


def line(stamp_ms: int, delay_us: int = round(1e6 * DELAY_S), space: str = "X", distance: int | None = None) -> bytes:
    cm = round(0.0344 * delay_us) if distance is None else distance
    return f"VR=2.0,ID={ID},SP={space},DB={cm},DR={delay_us},TM={delay_us + 358},TS={stamp_ms}\r\n".encode()


DAMAGED = "its lines are damaged or repeated"
# The line of the k-th tenth of a second, and the report.
MOTE: dict[str, tuple[Callable[[int], bytes], str]] = {
    "garbage before lines": (lambda k: RNG.randbytes(50) + b"\n" + line(k), HANDLED),
    "a time stamp that wraps": (lambda k: line((2**32 - 5 + k) % 2**32), HANDLED),
    "a time stamp that stands": (lambda _: line(7), DAMAGED),
    "half lines": (lambda k: line(k)[:30] + b"\n", DAMAGED),
    "a delay that is too long": (lambda k: line(k, 60_000), DAMAGED),
    "a distance that contradicts the delay": (lambda k: line(k, distance=34), DAMAGED),
    "a name of a hundred letters": (lambda k: line(k, space="x" * 100), DAMAGED),
    "a broken thermometer": (
        lambda k: b"Local temperature value (Celsius): 999\r\n" + line(k), "its thermometer shows 999 degrees",
    ),
    "no line end": (lambda _: b"x" * 5000, DAMAGED),
}  # fmt: skip


@pytest.mark.parametrize(("make", "report"), MOTE.values(), ids=MOTE)
def test_attacks_on_a_mote(make: Callable[[int], bytes], report: str) -> None:
    driving = listening()
    mote, counted = driving.rig.listeners["robot"], itertools.count()
    driving.rig.hardware.listeners[0].take()
    seen: list[Any] = []
    for _ in range(40):
        mote.send(make(next(counted)))
        seen.append(Seen(driving, 0.1))
    seen[-1].faults |= {fault for one in seen for fault in one.faults}
    seen[-1].judge(report)
    assert any(one.delays_s for one in seen) or report
    assert all(abs(delay_s - DELAY_S) < 3e-4 for one in seen[5:] for delay_s in one.delays_s)
