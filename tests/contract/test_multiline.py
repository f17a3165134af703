"""The MultiLine grammar to the byte, both directions."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ccatp.links.multiline import (
    FLAGS,
    BadMultilineRequest,
    BadReply,
    ChannelData,
    ChannelRecord,
    Command,
    Connected,
    Environment,
    LaserReady,
    MultilineRequest,
    Notice,
    Remark,
    Reply,
    format_reply,
    format_request,
    parse_reply,
    parse_request,
    valid_lengths,
)

# The example lines of the published driver from which the grammar is known.
EXAMPLE = (
    b"channeldata_1,1234.5678,100,200,22.5,1013.25,45.0,0,0,0,0,0,0,0,0,0,0"
    b"_2,1234.6789,150,250,22.5,1013.25,45.0,0,0,0,0,0,0,0,0,0,0_0"
)
EXAMPLE_ENVIRONMENT = b"environmentdata_22.5,1013.25,45.0"
FIRST = ChannelRecord(1, 1234.5678, 100, 200, 22.5, 1013.25, 45.0)
SECOND = ChannelRecord(2, 1234.6789, 150, 250, 22.5, 1013.25, 45.0)

REQUESTS = [
    (MultilineRequest(Command.IS_CONNECTED), b"isconnected\r\n"),
    (MultilineRequest(Command.LASER_READY), b"laserready\r\n"),
    (MultilineRequest(Command.ENVIRONMENT_DATA), b"environmentdata\r\n"),
    (MultilineRequest(Command.LATEST_LENGTH_VALID, (3,)), b"latestlengthvalid,3\r\n"),
    (MultilineRequest(Command.LATEST_LENGTH_VALID, (1, 2, 32)), b"latestlengthvalid,1,2,32\r\n"),
    (MultilineRequest(Command.START_MEASUREMENT), b"startmeasnogui\r\n"),
    (MultilineRequest(Command.STOP_MEASUREMENT), b"stopmeasnogui\r\n"),
]

REPLIES: list[tuple[Reply, bytes]] = [
    (Connected(True), b"isconnected_1\r\n"),
    (Connected(False), b"isconnected_0\r\n"),
    (LaserReady(True), b"laserready_1\r\n"),
    (LaserReady(False), b"laserready_0\r\n"),
    (Environment(22.5, 1013.25, 45.0), EXAMPLE_ENVIRONMENT + b"\r\n"),
    (ChannelData((FIRST, SECOND)), EXAMPLE + b"\r\n"),
    (ChannelData((FIRST._replace(beam_break=1, daq_error=3),), 7),
     b"channeldata_1,1234.5678,100,200,22.5,1013.25,45.0,0,1,0,0,0,0,0,0,0,3_7\r\n"),
    (ChannelData((), 1), b"channeldata_1\r\n"),
    (Notice.STARTED, b"measstarted\r\n"),
    (Notice.STOPPED, b"measstopped\r\n"),
    (Notice.FINISHED, b"measurementfinished\r\n"),
    (Remark("defanadata", "1,2,3_0"), b"defanadata_1,2,3_0\r\n"),
    (Remark("error", "unknown-request"), b"error_unknown-request\r\n"),
]  # fmt: skip

BAD_REQUESTS = {
    "unknown-request": (
        b'|isconnected |ISCONNECTED|measurelengthwithrawdata,1|{"type":"join"}|\x00\xff\xfe|'
        + "isconnect\u00e9d".encode()
    ),
    "bad-arguments": b"isconnected,1|stopmeasnogui,|latestlengthvalid",
    "bad-channel": (
        b"latestlengthvalid,|latestlengthvalid,0|latestlengthvalid,33|latestlengthvalid,-1|latestlengthvalid,1,1|"
        b"latestlengthvalid,1,01|latestlengthvalid,1.0|latestlengthvalid, 1|latestlengthvalid,1,|"
        b"latestlengthvalid,1,two|latestlengthvalid," + b"9" * 5000 + "|latestlengthvalid,\u0661".encode()
    ),
}

BAD_WORDS = (
    b"|hello|hello_1|channeldata|channeldata_|channeldata_x|channeldata_1,1234.5678_0|isconnected|isconnected_|isconnected_2|"
    b"isconnected_true|laserready_01|environmentdata|environmentdata_22.5,1013.25|environmentdata_22.5,1013.25,45.0,1|"
    b"environmentdata_22.5,nan,45.0|environmentdata_22.5,1e999,45.0|measstarted_|measstarted |\x00\x01\xff"
).split(b"|")
# What stands in the example, and what may not stand there: a decimal comma, another number, channel 2 twice, 18 fields.
BAD_FIELDS = {
    b"_0": (b"_0.5",),
    b"1234.5678": (b"1234,5678", b"long", b""),
    b"100": (b"1e2", b" 100", b"9" * 5000),
    b"data_1,": (b"data_0,", b"data_33,", b"data_2,"),
    b"_2,": (b",0_2,",),
}
BAD_REPLIES = [
    *BAD_WORDS,
    EXAMPLE[:-2],  # the server error is cut off
    EXAMPLE[:-20],  # cut within a record
    b"y" * 4000,
    *(EXAMPLE.replace(good, bad) for good, bads in BAD_FIELDS.items() for bad in bads),
]


@pytest.mark.parametrize(("request_", "line"), REQUESTS)
def test_requests_to_the_byte(request_: MultilineRequest, line: bytes) -> None:
    assert format_request(request_) == line
    assert parse_request(line.rstrip(b"\r\n")) == request_


@pytest.mark.parametrize(("reply", "line"), REPLIES)
def test_replies_to_the_byte(reply: Reply, line: bytes) -> None:
    assert format_reply(reply) == line
    assert parse_reply(line.rstrip(b"\r\n")) == reply


@pytest.mark.parametrize("reason", BAD_REQUESTS)
def test_a_line_that_is_no_request_is_refused_with_a_reason(reason: str) -> None:
    for line in BAD_REQUESTS[reason].split(b"|"):
        with pytest.raises(BadMultilineRequest, match=f"not a MultiLine request: {reason}") as caught:
            parse_request(line)
        assert caught.value.reason == reason


@pytest.mark.parametrize("line", BAD_REPLIES)
def test_a_line_that_is_no_reply_is_refused(line: bytes) -> None:
    with pytest.raises(BadReply, match=r"^bad reply '") as caught:
        parse_reply(line)
    assert len(str(caught.value)) < 200  # an operator reads it, however long the line was


FINITE = st.floats(allow_nan=False, allow_infinity=False)
INTEGER = st.integers(-(10**9), 10**9)
RECORD = st.builds(
    ChannelRecord,
    st.integers(1, 32),
    FINITE | st.just(math.inf),
    INTEGER,
    INTEGER,
    FINITE,
    FINITE,
    FINITE,
    *([INTEGER] * len(FLAGS)),
)


@given(st.lists(RECORD, max_size=32, unique_by=lambda record: record.channel), INTEGER)
def test_channel_data_survive_the_wire_exactly(records: list[ChannelRecord], server_error: int) -> None:
    data = ChannelData(tuple(records), server_error)
    assert parse_reply(format_reply(data).rstrip(b"\r\n")) == data


def test_a_channel_is_valid_when_present_unflagged_finite_and_positive() -> None:
    records = (
        FIRST,
        SECOND._replace(usb_error=1, dll_error=2),
        FIRST._replace(channel=3, length_mm=math.nan),
        FIRST._replace(channel=4, length_mm=math.inf),
        FIRST._replace(channel=5, length_mm=0.0),
        FIRST._replace(channel=6, length_mm=-1.0),
        FIRST._replace(channel=8, temperature_c=math.nan),
        FIRST._replace(channel=9),
    )
    lengths_m, reasons = valid_lengths(ChannelData(records), (8, 1, 2, 3, 4, 5, 6, 7))
    assert list(lengths_m) == [8, 1]
    assert list(lengths_m.values()) == pytest.approx([1.2345678, 1.2345678], rel=1e-15)  # one rounding of mm to m
    assert reasons == {
        2: "usb_error+dll_error",
        3: "length nan mm",
        4: "length inf mm",
        5: "length 0.0 mm",
        6: "length -1.0 mm",
        7: "absent",
    }


@pytest.mark.parametrize("flag", FLAGS)
@pytest.mark.parametrize("value", [1, -1, 250])
def test_any_flag_that_is_not_zero_makes_a_length_invalid(flag: str, value: int) -> None:
    lengths_m, reasons = valid_lengths(ChannelData((FIRST._replace(**{flag: value}), SECOND)), (1, 2))
    assert (list(lengths_m), reasons) == ([2], {1: flag})
