"""Lines that come again and again."""

import pytest

from ccatp.links.liveness import RateLimitedLog, kind_of


@pytest.mark.parametrize(
    ("one", "other", "is_same"),
    [
        ("a frame was served 145 ms late", "a frame was served 59 ms late", True),
        ("at 1.25 s", "at 300 s", True),
        ("late by 12.5.", "late by 3.", True),
        ("measurement of 1-2-7 failed", "measurement of 1-2-8 failed", False),
        ("panel 1/2", "panel 1/3", False),
        ("robot at 127.0.0.1:7010", "robot at 127.0.0.2:7010", False),
        ("held", "going on", False),
    ],
)
def test_kinds(one: str, other: str, is_same: bool) -> None:
    assert (kind_of(one) == kind_of(other)) is is_same


def test_a_few_of_each_kind_are_told_and_errors_all() -> None:
    sparing = RateLimitedLog(2, 10.0)
    told = [sparing.take("warning", f"held: {k} ms late", 0.1 * k) for k in range(50)]
    assert told == ["held: 0 ms late", "held: 1 ms late", *[None] * 48]
    assert sparing.take("warning", "going on: turning", 5.0) == "going on: turning"
    assert sparing.take("info", "held: 9 ms late", 5.0) == "held: 9 ms late"
    assert sparing.take("warning", "held: 7 ms late", 10.5) == "held: 7 ms late (48 more times)"
    assert [sparing.take("error", "broken", 0.0) for _ in range(9)] == ["broken"] * 9
