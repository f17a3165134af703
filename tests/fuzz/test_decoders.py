"""No input makes a decoder raise anything but what its protocol says. ``CCATP_FUZZ_INPUTS`` sets how many the slow
tests try per decoder (1,000,000), ``CCATP_FUZZ_SEED`` which."""

import os
from collections.abc import Callable

import pytest

from tests.fuzz.decoders import targets
from tests.fuzz.fuzzer import Target, fuzz

FEW = 3000
GRAMMAR = "MultiLine, replies"
MANY = int(os.environ.get("CCATP_FUZZ_INPUTS", "1000000"))
SEED = int(os.environ.get("CCATP_FUZZ_SEED", "1"))
TARGETS = [
    pytest.param(target, id=target.name, marks=[pytest.mark.fault("E7")] if target.name == GRAMMAR else [])
    for target in targets()
]
Measured = Callable[[str, float], None]


def check(target: Target, inputs: int, seed: int, measured: Measured) -> None:
    report = fuzz(target, inputs, seed)
    print(report.line)
    if target.name == GRAMMAR:
        measured("E7", len(report.failures))
    assert not report.failures, "\n".join(report.failures)
    assert len(report.outcomes) > 3


@pytest.mark.parametrize("target", TARGETS)
def test_a_few_thousand_inputs(target: Target, measured: Measured) -> None:
    check(target, FEW if target.name != "fault plan" else FEW // 3, 0, measured)


@pytest.mark.slow
@pytest.mark.parametrize("target", TARGETS)
def test_a_million_inputs(target: Target, measured: Measured) -> None:
    check(target, MANY, SEED, measured)


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
