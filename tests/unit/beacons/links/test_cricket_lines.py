"""Lines of Cricket motes as others recorded them: whole, without fields, cut, joined, damaged."""

import pytest

from ccatp.beacons.links.cricket_lines import LineReader, MoteReport, Pulse, Senders, full_id, parse_pulse

SHIP_ID, DOCK_ID = "01:25:61:61:0b:00:00:42", "01:4c:61:61:0b:00:00:1f"
SHIP, DOCK = f"ID={SHIP_ID},SP=ship", f"ID={DOCK_ID},SP=dock"
# From the Cricket v2 manual (output formats 1 to 3), and from a public log of two motes (pharoslabut, FakeSerialM).
PUBLISHED = {
    "manual, format 3": ("VR=2.0,ID=1:5e:3c:3c:a:0:0:ba,SP=MIT-0,DB=14,DR=423,TM=1045,TS=207040",
                         Pulse("01:5e:3c:3c:0a:00:00:ba", "MIT-0", 423 / 1e6, 207040)),
    "manual, format 1": ("$Cricket2,ver=3.0,id=45,dist=17,duration=1435,time=1195", Pulse("45", "", 1435 / 1e6, None)),
    "manual, format 2": ("$Cricket2,ver=3.0,space=MIT-0,id=45,dist=11,duration=1435",
                         Pulse("45", "MIT-0", 1435 / 1e6, None)),
    "log": (f"VR=2.0,{SHIP},DB=55,DR=1676,TM=2034,TS=22528", Pulse(SHIP_ID, "ship", 1676 / 1e6, 22528)),
    "log, spaces": (f"VR=2.0,{DOCK},DB=67,DR=2017,TM=2519,TS=5139296 ", Pulse(DOCK_ID, "dock", 2017 / 1e6, 5139296)),
    "log, no stamp": (f"VR=2.0,{DOCK},DB=88,DR=2651,TM=2865,           ", Pulse(DOCK_ID, "dock", 2651 / 1e6, None)),
    "log, cut in the time": (f"VR=2.0,{SHIP},DB=110,DR=3306,TM=371", Pulse(SHIP_ID, "ship", 3306 / 1e6, None)),
    "log, no pulse": (f"VR=2.0,{DOCK},TS=5132096", None),
    "log, cut in the space": ("VR=2.0,ID=01:9f:61:61:0b:00:00:04,SP=mobilab0", None),
    "log, cut in a name": ("VR=2.0,ID=01:a6:61:61:0b:00:00:77,S", None),
    "log, empty fields": ("VR=2.0,ID=01:a6:61:61:0b:00:00:77,SP=,DB=", None),
    "log, nothing": ("VR=2.0,       ", None),
}  # fmt: skip


@pytest.mark.parametrize(("line", "pulse"), PUBLISHED.values(), ids=PUBLISHED)
def test_published_lines(line: str, pulse: Pulse | None) -> None:
    assert parse_pulse(line) == pulse
    reader = LineReader()
    found = [one for byte in f"{line}\r\n".encode() for one in reader.feed(bytes([byte]))]
    assert found == ([] if pulse is None else [pulse])
    assert reader.counts["pulses"] == len(found)


@pytest.mark.parametrize(
    "line",
    [
        f"VR=2.0,{SHIP},DB=55,DR=16",  # the time of flight may be cut
        f"VR=2.0,{SHIP},DB=55,DR=7676,TM=8034,TS=1",  # a damaged digit: 2.6 m or 0.55 m
        f"VR=2.0,{SHIP},DB=155,DR=1676,TM=2034,TS=1",
        f"VR=2.0,{SHIP},DB=55,DR=0,TM=2034,TS=1",
        f"VR=2.0,{SHIP},DB=1655,DR=50000,TM=52034,TS=1",  # longer than a mote waits
        "VR=2.0,ID=01:25:61:61:0b:00:42,SP=ship,DB=55,DR=1676,TM=2034,TS=1",  # a byte of the id is missing
    ],
)
def test_samples_that_may_be_wrong_are_not_used(line: str) -> None:
    assert parse_pulse(line) is None


def test_a_number_that_is_none_is_garbled() -> None:
    reader = LineReader()
    assert not reader.feed(f"VR=2.0,{SHIP},DB=55,DR=16x6,TM=2034,TS=1\nVR=2.0,{SHIP},DB=?,DR=1676,TM=1,TS=2\n".encode())
    assert reader.counts["garbled"] == 2


def test_inches_and_a_mote_without_a_name() -> None:
    assert parse_pulse("VR=2.0,ID=1:5e:3c:3c:a:0:0:ba,SP=,DB=22,DR=1676,TM=2034,TS=5") == Pulse(
        "01:5e:3c:3c:0a:00:00:ba", "", 1676 / 1e6, 5
    )
    assert full_id("1:5E:3c:3c:a:0:0:ba") == "01:5e:3c:3c:0a:00:00:ba"


def test_two_samples_on_one_line_a_repeated_stamp_and_the_end_of_a_file() -> None:
    reader = LineReader()
    first, second = f"VR=2.0,{SHIP},DB=69,DR=2079,TM=2581,TS=5131680", f"VR=2.0,{DOCK},TS=5132096"
    again = f"VR=2.0,{SHIP},DB=69,DR=2079,TM=2581,TS=5131680"
    found = reader.feed(f"{first}{second}\n{again}\n{SHIP}\n".encode())
    assert found == [Pulse(SHIP_ID, "ship", 2079 / 1e6, 5131680)]
    assert dict(reader.counts) == {"pulses": 1, "silent": 1, "garbled": 0, "duplicates": 1, "reports": 0, "other": 1}
    assert not reader.feed(f"VR=2.0,{DOCK},DB=45,DR=1350,TM=1612,TS=5133472".encode())
    assert reader.finish() == [Pulse(DOCK_ID, "dock", 1350 / 1e6, 5133472)]


def test_the_report_of_a_mote() -> None:
    reader = LineReader()
    lines = ("Mode: Listener   ", "Unique id: 1:c8:6a:b3:a:0:0:dc  // Unique Cricket ID", "Space id: MIT-6",
             "Local temperature value (Celsius): 23 ")  # fmt: skip
    assert reader.feed("\r\n".join((*lines, "")).encode()) == []
    assert reader.report == MoteReport("Listener", "01:c8:6a:b3:0a:00:00:dc", "MIT-6", 23.0)
    reader.feed(b"Local temperature value (Celsius): disabled\n")
    assert reader.report.temperature_c is None


def test_endless_lines_are_bounded() -> None:
    reader = LineReader()
    for _ in range(100):
        reader.feed(b"x" * 1000)
    assert reader.counts["garbled"] == 100
    assert reader.feed(b"\nVR=2.0,ID=1:5e:3c:3c:a:0:0:ba,SP=MIT-0,DB=14,DR=423,TM=1045,TS=207040\n")


def named(senders: Senders, unique_id: str, space: str, times: int = 1) -> list[str | None]:
    """The names of a mote, line by line."""
    found = []
    for _ in range(times):
        pulse = Pulse(unique_id, space, 0.002, None)
        senders.count(pulse)
        found.append(senders.name_of(pulse))
    return found


def test_the_name_of_a_mote_is_that_of_most_of_its_lines() -> None:
    senders = Senders()
    assert named(senders, SHIP_ID, "ship", 40) == ["ship"] * 40
    assert named(senders, SHIP_ID, "") == ["ship"]  # a line without the field is of the same mote
    assert named(senders, SHIP_ID, "shi", 2) == [None] * 2  # a letter is missing
    assert named(senders, "01:25:61:61:0b:00:00:43", "ship") == [None]
    assert named(senders, DOCK_ID, "dock", 3) == ["dock"] * 3
    assert named(senders, "01:a6:61:61:0b:00:00:77", "") == ["01:a6:61:61:0b:00:00:77"]
    assert not senders.twins
    assert named(senders, SHIP_ID, "boat", 5)[2:] == ["boat"] * 3  # it was given another name
    senders.listeners[DOCK_ID] = "N1"
    assert named(senders, DOCK_ID, "dock") == ["N1"]


def test_a_name_that_two_motes_have_is_of_neither() -> None:
    senders = Senders()
    named(senders, SHIP_ID, "ship", 5)
    assert named(senders, DOCK_ID, "ship", 20) == [None] * 20
    assert senders.twins == {"ship"}
    assert named(senders, SHIP_ID, "ship") == [None]
