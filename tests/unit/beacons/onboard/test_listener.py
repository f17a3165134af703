"""A listening mote on its serial line."""

from collections.abc import Callable

import pytest

from ccatp.beacons.config.onboard_load import load_beacon_onboard_config
from ccatp.beacons.links.cricket_lines import Senders
from ccatp.beacons.onboard.listener import CricketListener
from ccatp.onboard.hardware import HardwareError
from tests.support.beacon_fakes import FakeMote, FakePort, FakeXBee
from tests.support.onboard_fakes import FakeTime

ID = "1:25:61:61:b:0:0:42"


class Rig:
    """A mote and its driver."""

    def __init__(self, temperature_c: float | None = 23.0) -> None:
        settings = {"devices.listeners.is_used": True, "devices.base.is_used": False}
        cfg = load_beacon_onboard_config(None, settings).devices.listeners
        self.time = FakeTime()
        self.device = FakeMote(self.time, "1:c8:6a:b3:a:0:0:dc", temperature_c)
        self.port: FakePort = self.device
        self.listener = CricketListener(
            "robot", cfg, Senders(), lambda *_: self.port.open(), self.time, self.time.sleep
        )

    def open(self) -> "Rig":
        self.listener.open()
        return self

    def run(self, duration_s: float) -> None:
        end_s = self.time.now_s + duration_s
        while self.time.now_s < end_s:
            self.time.sleep(0.05)
            self.listener.poll(self.time.now_s)


@pytest.mark.parametrize(("measured_c", "used_c"), [(23.0, 23.0), (None, 20.0)])
def test_pulses_with_the_temperature_of_the_mote_or_of_the_configuration(
    measured_c: float | None, used_c: float
) -> None:
    rig = Rig(measured_c).open()
    rig.run(0.2)
    assert "01:c8:6a:b3:0a:00:00:dc" in rig.listener.identity
    rig.device.pulse(ID, "N1-1", 0.006)
    rig.run(0.1)
    (burst,) = rig.listener.take()
    assert burst[1:] == ("N1-1", "robot", used_c, [0.006])
    assert not rig.listener.take()


def test_a_mote_that_repeats_its_time_stamp_counts_once() -> None:
    rig = Rig().open()
    rig.device.stamp_ms = 5131680
    for _ in range(5):
        rig.device.pulse(ID, "ship", 0.002)
        rig.run(0.1)
    assert len(rig.listener.take()) == 1
    assert rig.listener.reader.counts["duplicates"] == 4


def test_lines_that_lack_a_field_and_motes_with_one_name() -> None:
    rig = Rig().open()
    other = "1:4c:61:61:b:0:0:1f"
    for sender, space in ((ID, "ship"), (ID, ""), (ID, "shi")):
        rig.device.pulse(sender, space, 0.002)
        rig.run(0.1)
    assert [burst.sender for burst in rig.listener.take()] == ["ship", "ship"]
    for _ in range(5):
        rig.device.pulse(ID, "ship", 0.002)
        rig.device.pulse(other, "ship", 0.009)
        rig.run(0.1)
    rig.listener.take()
    rig.device.pulse(other, "ship", 0.009)
    rig.run(0.1)
    assert not rig.listener.take()
    assert rig.listener.fault(rig.time.now_s) == "several motes have the space id ship; give each another one (P SP)"


def test_silence_is_a_fault_but_a_mote_that_hears_nothing_is_not() -> None:
    rig = Rig().open()
    rig.run(30.0)  # it is asked for its report now and then
    assert not rig.listener.fault(rig.time.now_s)
    assert rig.device.opened == 1
    rig.device.is_mute = True
    rig.run(8.0)
    assert "it does not answer" in rig.listener.fault(rig.time.now_s)
    rig.device.is_mute = False
    rig.run(5.0)
    assert not rig.listener.fault(rig.time.now_s)


def test_pulled_and_plugged() -> None:
    rig = Rig().open()
    rig.device.unplug()
    rig.run(1.0)
    assert rig.listener.fault(rig.time.now_s) == "/dev/ttyX: is not there; check the wiring"
    rig.device.plug()
    rig.run(5.0)
    rig.device.pulse(ID, "ship", 0.002)
    rig.run(0.1)
    assert len(rig.listener.take()) == 1


def _beacon(rig: Rig) -> None:
    rig.device.mode = "Beacon"


def _xbee(rig: Rig) -> None:
    rig.port = FakeXBee(rig.time, [], lambda _: None)


def _garbage(rig: Rig) -> None:
    rig.device.corrupt = lambda data: b"\xff\xfe" * 100


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_beacon, r"^listener robot: the mote is in beacon mode; set it to listener mode \(MD\)$"),
        (
            _xbee,
            "^listener robot: an XBee answers on its port; exchange the ports, or correct devices.listeners.device",
        ),
        (_garbage, "^listener robot: garbage at 115200 baud; check devices.listeners.baud$"),
    ],
)
def test_what_is_wrong_with_the_port(change: Callable[[Rig], None], message: str) -> None:
    rig = Rig()
    change(rig)
    with pytest.raises(HardwareError, match=message):
        rig.open()
