"""No input makes a decoder raise anything but what its protocol says. ``CCATP_FUZZ_INPUTS`` sets how many the slow
tests try per decoder (1,000,000), ``CCATP_FUZZ_SEED`` which."""

import os

import pytest

from tests.fuzz.decoders import targets
from tests.fuzz.fuzzer import Target, fuzz

FEW = 3000
MANY = int(os.environ.get("CCATP_FUZZ_INPUTS", "1000000"))
SEED = int(os.environ.get("CCATP_FUZZ_SEED", "1"))
ROWS = {"robot link, from the robot": ("S15", "L7"), "robot link, lines": ("L7",), "MultiLine, replies": ("E7",)}
TARGETS = [
    pytest.param(target, id=target.name, marks=[pytest.mark.fault(*ROWS[target.name])] if target.name in ROWS else [])
    for target in targets()
]


def check(target: Target, inputs: int, seed: int) -> None:
    report = fuzz(target, inputs, seed)
    print(report.line)
    assert not report.failures, "\n".join(report.failures)
    assert len(report.outcomes) > 3


@pytest.mark.parametrize("target", TARGETS)
def test_a_few_thousand_inputs(target: Target) -> None:
    check(target, FEW if target.name != "fault plan" else FEW // 3, 0)


@pytest.mark.slow
@pytest.mark.parametrize("target", TARGETS)
def test_a_million_inputs(target: Target) -> None:
    check(target, MANY, SEED)


def test_the_same_seed_gives_the_same_run() -> None:
    target = targets()[0]
    one, two, other = fuzz(target, 300, 5), fuzz(target, 300, 5), fuzz(target, 300, 6)
    assert one.outcomes == two.outcomes
    assert one.accepted == two.accepted
    assert other.outcomes != one.outcomes


def test_a_surprise_is_a_failure() -> None:
    def fragile(data: bytes) -> int:
        return 1 // (len(data) - 3)

    report = fuzz(Target("fragile", [b"ab"], fragile, (ValueError,)), 1000, 0)
    assert report.failures
    assert "ZeroDivisionError" in report.failures[0]
