"""The radio module: which strengths count, discovery, resets, damaged lines, and what else may be on its port."""

from collections.abc import Callable, Sequence

import pytest

from ccatp.beacons.config.onboard_load import load_beacon_onboard_config
from ccatp.beacons.onboard.xbee import Coordinator, Strength
from ccatp.onboard.hardware import HardwareError
from tests.support.beacon_fakes import FakeMote, FakePioneer, FakePort, FakeXBee
from tests.support.onboard_fakes import FakeTime

NAMES = ["beacon1", "beacon2"]
OTHER = 0x0013A200405200FF


class Rig:
    """A module with two radios and its driver; ``ask`` requests strengths."""

    def __init__(
        self, *, api_mode: int = 1, is_zigbee: bool = True, tries: int = 3, names: Sequence[str] = NAMES
    ) -> None:
        cfg = load_beacon_onboard_config(
            None,
            {"devices.radio.names": names, "devices.radio.api_mode": api_mode, "devices.radio.tries": tries},
        ).devices.radio
        self.time = FakeTime()
        self.levels: dict[str, float | None] = dict(zip(names, (-40.0, -62.0), strict=True))
        self.device = FakeXBee(self.time, list(names), lambda name: self.levels.get(name, -80.0))
        self.device.api_mode, self.device.is_zigbee = api_mode, is_zigbee
        self.radio = Coordinator(cfg, lambda *_: self.device.open(), self.time, self.time.sleep)

    def open(self) -> "Rig":
        self.radio.open()
        return self

    def run(self, duration_s: float) -> None:
        end_s = self.time.now_s + duration_s
        while self.time.now_s < end_s:
            self.time.sleep(0.002)
            self.radio.poll(self.time.now_s)

    def ask(self, name: str, before_answer: Callable[[], object] = lambda: None) -> float | None:
        """The strength of a radio."""
        before_answer()
        self.radio.ask(name, self.time.now_s)
        for _ in range(1000):
            self.time.sleep(0.002)
            self.radio.poll(self.time.now_s)
            if (found := self.radio.take()) is not None:
                assert isinstance(found, Strength)
                assert found.name == name
                return found.dbm
        raise AssertionError("no result")


@pytest.mark.parametrize("api_mode", [1, 2])
@pytest.mark.parametrize("is_zigbee", [True, False])
def test_radios_are_found_and_their_strengths_are_their_own(api_mode: int, is_zigbee: bool) -> None:
    rig = Rig(api_mode=api_mode, is_zigbee=is_zigbee).open()
    assert rig.radio.identity == "XBee 0013A20041AE0001 CRT, firmware 4060; receives beacon1, beacon2"
    assert rig.radio.wanted == NAMES
    assert not rig.radio.missing
    for level in (-40.0, -17.0, -19.0, -100.0):  # 11 and 13 in hexadecimal are escaped in mode 2
        rig.levels["beacon1"] = level
        assert [rig.ask(name) for name in NAMES] == [level, -62.0]


@pytest.mark.parametrize("has_level", [True, False])
@pytest.mark.parametrize("has_parent", [True, False])
def test_names_are_right_whatever_the_firmware_writes_beside_them(has_level: bool, has_parent: bool) -> None:
    rig = Rig(is_zigbee=False)
    rig.device.has_level, rig.device.has_parent = has_level, has_parent
    rig.open()
    assert [rig.ask(name) for name in NAMES] == [-40.0, -62.0]


def test_a_slow_line_and_adapter_and_long_names() -> None:
    names = ["twenty-letters-no-1-x", "twenty-letters-no-2-x"]
    rig = Rig(names=names, tries=1)
    rig.device.baud, rig.device.latency_s, rig.device.answer_s = 9600, 0.016, 0.05
    rig.open()
    assert [rig.ask(name) for name in names] == [-40.0, -62.0]


def test_a_name_that_two_radios_have_is_measured_at_no_time() -> None:
    """Also while another one is searched again: the two need not answer at once."""
    rig = Rig()
    rig.device.nodes = dict.fromkeys((0x0013A20040520001, OTHER), "beacon1")
    rig.open()
    assert rig.radio.missing == ["beacon2"]
    for _ in range(90):
        assert rig.radio.twins == {"beacon1"}
        assert rig.ask("beacon1") is None
        rig.run(0.5)
    rig.device.nodes[OTHER] = "beacon2"
    rig.run(30.0)
    assert [rig.ask(name) for name in NAMES] == [-40.0, -62.0] or rig.radio.twins


def test_a_radio_that_has_another_name_now_is_not_measured_under_the_old_one() -> None:
    rig = Rig().open()
    rig.device.nodes[0x0013A20040520001] = "beacon9"
    assert rig.ask("beacon1") is None
    assert rig.radio.missing == ["beacon1"]


def packet_of_another(rig: Rig, kind: int = 0x90) -> Callable[[], None]:
    """A packet of another radio arrives behind the answer; it changes what the module says of strengths."""

    def come() -> None:
        frame = bytes([kind]) + OTHER.to_bytes(8, "big") + b"\x12\x34\x01hello"
        rig.device.extra.append((frame, 99))

    return come


@pytest.mark.parametrize("kind", [0x80, 0x81, 0x90, 0x91, 0x92, 0x95, 0x97, 0xA3])
def test_a_packet_in_between_is_no_measurement(kind: int) -> None:
    rig = Rig(tries=1).open()
    assert rig.ask("beacon1", packet_of_another(rig, kind)) is None
    assert rig.radio.counts["mixed"] == 1
    rig = Rig(tries=2).open()
    assert rig.ask("beacon1", packet_of_another(rig, kind)) == -40.0  # the second request is alone


@pytest.mark.parametrize("api_mode", [1, 2])
def test_damaged_bytes_in_between_may_have_been_a_packet(api_mode: int) -> None:
    """At each place a byte of the other packet is changed, or lost: its strength is never taken for the radio's."""
    rig = Rig(api_mode=api_mode).open()
    damages = [
        lambda data, k=k, byte=byte: data[:k] + byte + data[k + 1 :] for k in range(20) for byte in (b"", b"\x55")
    ]
    for damage in damages:

        def corrupt(data: bytes, damage: Callable[[bytes], bytes] = damage) -> bytes:
            return damage(data) if b"hello" in data else data

        rig.device.corrupt = corrupt
        assert rig.ask("beacon1", packet_of_another(rig)) in {-40.0, None}
    assert rig.radio.counts["mixed"] > 20


def test_an_answer_to_the_discovery_in_between_is_no_measurement() -> None:
    rig = Rig(tries=1).open()
    node = b"\x12\x34" + OTHER.to_bytes(8, "big") + b"x\x00\xff\xfe\x01\x00\xc1\x05\x10\x1e"
    assert rig.ask("beacon1", lambda: rig.device.extra.append((b"\x88\x55ND\x00" + node, 99))) is None


def test_a_transmit_status_in_between_is_no_packet_by_radio() -> None:
    rig = Rig(tries=1).open()
    assert rig.ask("beacon1", lambda: rig.device.extra.append((b"\x8b\x01\x7d\x84\x00\x00\x01", None))) == -40.0


def test_late_answers_belong_to_no_newer_request() -> None:
    rig = Rig(tries=1).open()
    rig.device.frame(b"\x97\x01" + (0x0013A20040520001).to_bytes(8, "big") + b"\x12\x34NI\x00beacon1", 0.001)
    rig.device.frame(b"\x88\x02DB\x00\x11", 0.001)
    assert rig.ask("beacon2") == -62.0


def test_relayed_packets_are_no_measurement() -> None:
    rig = Rig()
    rig.device.parents = {"beacon1": 0x4F21, "beacon2": 0x0000}  # a child of a router, one of the coordinator
    rig.open()
    assert rig.radio.relayed == {"beacon1"}
    assert rig.radio.wanted == ["beacon2"]
    address = (0x0013A20040520002).to_bytes(8, "big")
    rig.device.frame(b"\xa1" + address + b"\x12\x34\x01\x01\xee\xff")
    rig.run(0.1)
    assert rig.radio.wanted == []
    rig.device.frame(b"\xa1" + address + b"\x12\x34\x01\x00")
    rig.run(0.1)
    assert rig.radio.wanted == ["beacon2"]


def test_the_node_discovery_does_not_say_that_the_packets_of_a_router_are_not_relayed() -> None:
    rig = Rig()
    rig.device.nodes.popitem()
    rig.open()  # beacon2 is searched again
    rig.device.frame(b"\xa1" + (0x0013A20040520001).to_bytes(8, "big") + b"\x12\x34\x01\x01\xee\xff")
    rig.run(40.0)
    assert rig.radio.relayed == {"beacon1"}


def test_a_lost_packet_costs_the_tries_and_then_gives_nothing() -> None:
    rig = Rig(tries=3).open()
    rig.levels["beacon1"] = None
    began_s = rig.time.now_s
    assert rig.ask("beacon1") is None
    # Three times answer_timeout_s, and 60 bytes at 9600 baud.
    assert rig.time.now_s - began_s == pytest.approx(3 * (0.1 + 60 * 10 / 9600), abs=0.02)
    assert rig.ask("beacon2") == -62.0


@pytest.mark.parametrize("strength", [0, 121, 255])
def test_impossible_strengths_are_none(strength: int) -> None:
    rig = Rig().open()
    rig.levels["beacon1"] = -float(strength)
    assert rig.ask("beacon1") is None


def test_any_byte_of_an_answer_may_get_lost() -> None:
    rig = Rig().open()
    for k in range(24):
        whole = [True]

        def cut(data: bytes, k: int = k, whole: list[bool] = whole) -> bytes:
            if whole[0] and len(data) > k:
                whole[0] = False
                return data[:k] + data[k + 1 :]
            return data

        rig.device.corrupt = cut
        assert rig.ask("beacon1") == -40.0, k


def test_a_reset_ends_the_request_and_finds_the_radios_again() -> None:
    rig = Rig().open()
    rig.radio.ask("beacon1", rig.time.now_s)
    rig.device.reset()
    rig.run(0.3)
    assert rig.radio.resets == 1
    assert rig.radio.take() == Strength("beacon1", None)
    assert not rig.radio.is_ready
    rig.run(9.0)
    assert rig.radio.is_ready
    assert rig.ask("beacon1") == -40.0


def test_a_radio_that_is_switched_on_later_is_found() -> None:
    rig = Rig()
    late = rig.device.nodes.popitem()
    rig.open()
    assert rig.radio.missing == ["beacon2"]
    assert rig.radio.fault() == "does not receive beacon2"
    rig.device.nodes[late[0]] = late[1]
    rig.run(40.0)
    assert not rig.radio.missing


def test_a_port_that_is_pulled_and_plugged() -> None:
    rig = Rig().open()
    rig.device.unplug()
    rig.run(1.0)
    assert not rig.radio.is_ready
    assert rig.radio.why() == "/dev/ttyX: is not there; check the wiring"
    rig.device.plug()
    rig.run(12.0)
    assert rig.ask("beacon2") == -62.0


def _mute(rig: Rig) -> FakePort:
    rig.device.is_mute = True
    return rig.device


def _garbage(rig: Rig) -> FakePort:
    rig.device.corrupt = lambda data: bytes(len(data) * 20)
    return rig.device


def _other_mode(rig: Rig) -> FakePort:
    rig.device.api_mode = 2
    return rig.device


def _long_search(rig: Rig) -> FakePort:
    rig.device.search = 130  # as an XBee 3 with 802.15.4
    return rig.device


def _base(rig: Rig) -> FakePort:
    return FakePioneer(rig.time, lambda *_: (0.0, 0.0), lambda: [1.0])


def _mote(rig: Rig) -> FakePort:
    return FakeMote(rig.time, "1:2:3:4:5:6:7:8")


@pytest.mark.parametrize(
    ("other", "message"),
    [
        (_mute, "^radio: it does not answer; check its supply, devices.radio.device and devices.radio.baud$"),
        (_garbage, "^radio: garbage at 9600 baud; check devices.radio.baud$"),
        (_other_mode, "^radio: it is in API mode 02; set devices.radio.api_mode, or AP of the module$"),
        (
            _long_search,
            r"^radio: it searches radios for 13 s \(NT\); set devices.radio.discovery_s above, or NT lower$",
        ),
        (_base, "^radio: a Pioneer base answers on its port; exchange the ports, or correct devices.radio.device$"),
        (_mote, "^radio: a Cricket mote answers on its port; exchange the ports, or correct devices.radio.device$"),
    ],
)
def test_what_is_wrong_with_the_port(other: Callable[[Rig], FakePort], message: str) -> None:
    rig = Rig()
    device = other(rig)
    rig.radio._line._open_port = lambda *_: device.open()
    with pytest.raises(HardwareError, match=message):
        rig.open()
