"""Damaged files: refused in their own words, never misread. ``CCATP_FUZZ_INPUTS`` and ``CCATP_FUZZ_SEED`` as for the
decoders; a file costs a hundred times as much as a line, so that the slow tests take a tenth of the inputs."""

import os
import random
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import pytest

from ccatp.config.load import load_config
from ccatp.config.messages import format_toml
from ccatp.errors import ConfigError
from ccatp.records.store import StoreError
from tests.fuzz.files import (
    check_store,
    config_target,
    dumped_config,
    recording_target,
    scratch,
    sound_store,
    store_target,
)
from tests.fuzz.fuzzer import Target, fuzz

MANY = int(os.environ.get("CCATP_FUZZ_INPUTS", "1000000")) // 10
SEED = int(os.environ.get("CCATP_FUZZ_SEED", "1"))
MAKERS = [
    pytest.param(config_target, 150, id="configuration"),
    pytest.param(store_target, 400, id="mission database"),
    pytest.param(recording_target, 300, id="recording"),
]


@pytest.fixture
def folder() -> Iterator[Path]:
    with scratch() as path:
        yield path


def check(target: Target, inputs: int, seed: int) -> None:
    report = fuzz(target, inputs, seed)
    print(report.line)
    assert not report.failures, "\n".join(report.failures)[:4000]
    assert len(report.outcomes) >= 3


@pytest.mark.parametrize(("make", "few"), MAKERS)
def test_some_damaged_files(make: Callable[[Path], Target], few: int, folder: Path) -> None:
    check(make(folder), few, 0)


@pytest.mark.slow
@pytest.mark.parametrize(("make", "few"), MAKERS)
def test_many_damaged_files(make: Callable[[Path], Target], few: int, folder: Path) -> None:
    check(make(folder), max(MANY, few), SEED)


# -- P20: every key of the configuration, wrong in every way that can be told -----------------------------------------

Key = tuple[str, ...]


# What looks wrong and means the same: Python's True is 1.
EQUIVALENT = ((("mirror", "frame", "reflecting_side_sign"), "reflecting_side_sign", True),)


def leaves(tree: object, key: Key = ()) -> Iterator[tuple[Key, object]]:
    if isinstance(tree, dict):
        for name, value in tree.items():
            yield from leaves(value, (*key, name))
    else:
        yield key, tree


def with_leaf(tree: object, key: Key, name: str, value: object) -> dict[str, object]:
    """A copy in which a leaf has another name and value."""
    assert isinstance(tree, dict)
    if len(key) == 1:
        return {name if k == key[0] else k: value if k == key[0] else v for k, v in tree.items()}
    return {k: with_leaf(v, key[1:], name, value) if k == key[0] else v for k, v in tree.items()}


def wrong(key: Key, value: object) -> list[tuple[str, object]]:
    """Names and values that no leaf may have."""
    found: list[tuple[str, object]] = [(key[-1] + "x", value)]
    if isinstance(value, bool):
        found += [(key[-1], 1), (key[-1], "true")]
    elif isinstance(value, int | float):
        found += [
            (key[-1], bad) for bad in (float("nan"), float("inf"), -float("inf"), str(value), True, [value], 1e300)
        ]
    elif isinstance(value, str):
        found += [(key[-1], bad) for bad in (1, 0.5, True, [value])]
    else:
        found += [(key[-1], bad) for bad in ("x", 1, [["x"]])]
    return [
        one for one in found if (key, *one) not in EQUIVALENT and not (key[-2] == "adjusters_mm" and one[1] == value)
    ]


def mistakes() -> list[tuple[Key, str, object]]:
    return [(key, name, bad) for key, value in leaves(dumped_config()) for name, bad in wrong(key, value)]


def refused(folder: Path, key: Key, name: str, bad: object) -> str:
    """What the loader says to a mistake; empty where it takes it."""
    file = folder / "user.toml"
    file.write_text(format_toml(with_leaf(dumped_config(), key, name, bad)))
    try:
        load_config(file)
    except ConfigError as error:
        found = error.problems
    else:
        return ""
    assert all(problem.startswith(f"{file}:") for problem in found), found
    return found[0]


def check_mistakes(folder: Path, chosen: list[tuple[Key, str, object]], measured: Callable[[str, float], None]) -> None:
    taken = [mistake for mistake in chosen if not refused(folder, *mistake)]
    print(f"{len(chosen)} mistakes, {len(taken)} taken")
    measured("P20", 100.0 * (1.0 - len(taken) / len(chosen)))
    assert not taken


@pytest.mark.fault("P20")
def test_some_mistakes_in_the_configuration(folder: Path, measured: Callable[[str, float], None]) -> None:
    check_mistakes(folder, random.Random(20).sample(mistakes(), 40), measured)


@pytest.mark.slow
@pytest.mark.fault("P20")
def test_every_mistake_in_the_configuration(folder: Path, measured: Callable[[str, float], None]) -> None:
    chosen = mistakes()
    assert len(chosen) > 1000
    check_mistakes(folder, chosen, measured)


# -- P16: the whole database, bit by bit ------------------------------------------------------------------------------


def check_damage(
    folder: Path, cuts: Iterable[int], flips: Iterable[int], sound: bytes, measured: Callable[[str, float], None]
) -> None:
    """Each cut is refused; each flipped bit is found, or nothing that was measured has changed."""
    path = folder / "mission.sqlite"
    count = missed = refusals = named = 0
    for size in cuts:
        count += 1
        path.write_bytes(sound[:size])
        missed += not is_refused(path)
    for flip in flips:
        at, bit = divmod(flip, 8)
        count += 1
        path.with_name("mission.sqlite-journal").unlink(missing_ok=True)
        path.write_bytes(sound[:at] + bytes((sound[at] ^ (1 << bit),)) + sound[at + 1 :])
        try:
            named += bool(check_store(path))
        except StoreError:
            refusals += 1
        except AssertionError:
            missed += 1
    print(f"{count} cuts and flips: {refusals} flips refused, {named} with damaged fixes named, {missed} missed")
    measured("P16", 100.0 * (1.0 - missed / count))
    assert not missed


def is_refused(path: Path) -> bool:
    try:
        check_store(path)
    except StoreError:
        return True
    return False


@pytest.mark.fault("P16")
def test_some_cuts_and_flipped_bits_of_the_database(folder: Path, measured: Callable[[str, float], None]) -> None:
    sound = sound_store(folder)
    flips = random.Random(16).sample(range(8 * len(sound)), 800)
    check_damage(folder, range(0, len(sound), 211), flips, sound, measured)


@pytest.mark.slow
@pytest.mark.fault("P16")
def test_every_cut_and_every_flipped_bit_of_the_database(folder: Path, measured: Callable[[str, float], None]) -> None:
    sound = sound_store(folder)
    check_damage(folder, range(len(sound)), range(8 * len(sound)), sound, measured)
