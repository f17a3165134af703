"""The topic table and its codec."""

import json

import msgspec
import pytest

from ccatp.core import EventCode, Verdict
from ccatp.links.topics import (
    BY_NAME,
    ESTIMATE_FRAMES,
    TOPICS,
    BadMessage,
    EstimateMessage,
    SensorLines,
    decode_recorded,
    is_estimate_due,
    last_estimate_before,
    pack,
    schema_of,
    unpack,
)

ESTIMATE = EstimateMessage(seq=5, t_s=0.05, x_m=1.0, y_m=-2.0, heading_rad=0.5, sigma_m=1e-3, state="driving")


def test_golden_frame() -> None:
    assert pack("estimate", ESTIMATE) == (
        b'estimate {"x_m":1.0,"y_m":-2.0,"heading_rad":0.5,"sigma_m":0.001,"state":"driving","commanded":null,'
        b'"drive_seq":-1,"seq":5,"t_s":0.05}'
    )


def test_round_trip_with_the_text_in_the_middle() -> None:
    name, body, message = unpack(pack("estimate", ESTIMATE))
    assert (name, message) == ("estimate", ESTIMATE)
    assert json.loads(body)["seq"] == 5


def test_a_batch_of_lines_holds_them_as_they_came() -> None:
    line = b'{"type":"sensors","seq":1}'
    body = unpack(pack("sensors", SensorLines(seq=1, t_s=0.0, lines=[msgspec.Raw(line)])))[1]
    assert line in body


@pytest.mark.parametrize(
    ("frame", "why"),
    [
        (b"", "unknown topic"),
        (b"estimate", "topic estimate"),
        (b"rumour {}", "unknown topic b'rumour'"),
        (b"\xff\xfe {}", "unknown topic"),
        (b'estimate {"seq":1}', "missing required field"),
        (b'estimate {"seq":1.5,"t_s":0}', "Expected `int`"),
        (b"estimate {", "topic estimate"),
    ],
)
def test_what_is_not_of_the_table_is_refused(frame: bytes, why: str) -> None:
    with pytest.raises(BadMessage, match=why):
        unpack(frame)


def test_names_are_unique_and_levels_have_an_age() -> None:
    assert len(BY_NAME) == len(TOPICS)
    for topic in TOPICS:
        is_level = topic.rate_hz > 1.0
        assert (topic.stale_after_s > 0.0) == is_level, topic.name
        assert topic.stale_after_s == 0.0 or topic.stale_after_s >= 2.0 / topic.rate_hz  # one may be late


def test_every_recorded_topic_has_a_schema() -> None:
    for topic in TOPICS:
        if topic.recorded:
            assert "$ref" in schema_of(topic.name) or "properties" in schema_of(topic.name)


def test_verdicts_survive_the_bus() -> None:
    verdict = Verdict(
        7, 0.07, EventCode.NEAR_EDGE, "rim", "front_left", 0.01, 0.005, False, True, False, (True, False, False, False)
    )
    name, _, message = unpack(pack("verdict", verdict))
    assert name == "verdict"
    assert message == verdict
    assert isinstance(message, Verdict)
    assert message.code is EventCode.NEAR_EDGE


@pytest.mark.parametrize("seq", range(1, 30))
def test_danger_waits_for_an_estimate_that_main_publishes(seq: int) -> None:
    wanted = last_estimate_before(seq)
    assert is_estimate_due(wanted)
    assert 0 < seq - wanted <= ESTIMATE_FRAMES
    assert last_estimate_before(0) < 0


@pytest.mark.parametrize(
    ("topic", "payload", "field", "value"),
    [
        ("treatment", b'{"seq":1,"t_s":0.1,"kind":"deaf","values":[]}', "kind", "odometry_off"),
        ("treatment", b'{"seq":1,"t_s":0.1,"kind":"hearing"}', "kind", "odometry_on"),
        ("treatment", b'{"seq":1,"t_s":0.1,"kind":"odometry_on"}', "kind", "odometry_on"),
        ("mission", b'{"seq":1,"t_s":0.1,"state":"idle","slips":3,"lag_ms":21.5}', "missed_deadlines", 3),
        ("mission", b'{"seq":1,"t_s":0.1,"state":"idle","slips":3,"lag_ms":21.5}', "worst_lateness_ms", 21.5),
    ],
)
def test_recordings_of_older_formats_are_read(topic: str, payload: bytes, field: str, value: object) -> None:
    assert getattr(decode_recorded(topic, payload), field) == value


def test_a_recorded_message_of_no_format_is_refused() -> None:
    with pytest.raises(BadMessage, match="topic treatment"):
        decode_recorded("treatment", b'{"seq":1,"t_s":0.1,"kind":"numb"}')
