"""The rim of all four mirrors, centimetre by centimetre, and ways over the seams: nobody falls, no false edge.

One part of 96 is swept by the slow tests, which measure for the fault table. All of it, 4 million drives, takes
five to nine hours of one core: ``make sweep``, which ``make test-slow`` ends with.
"""

import json
import random
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest

from tests.faults import edge_sweep, whole_sweep
from tests.faults.edge_sweep import (
    OVERRUN_M,
    Tally,
    rim_case,
    rim_cases,
    seam_case,
    speed_of,
    sweep,
    turn_case,
    turn_cases,
)

SHARD, SHARDS = 5, 96
MIN_DRIVEN = 0.25
PERMIT_S = 0.1  # S22, S24

Measured = Callable[..., None]
# Slower than this the way that tells a direction, 0.2 mm and more, takes longer than the bound in time.
SLOW_M_S = 0.02


def check(tally: Tally) -> None:
    print(tally.line)
    assert not tally.falls, "\n".join(tally.worst)
    assert not tally.unseen, "\n".join(tally.worst)
    assert tally.after_m <= OVERRUN_M, "\n".join(tally.worst)
    assert not tally.false_edges, "\n".join(tally.worst)


def check_rim(numbers: Iterable[int], measured: Measured) -> None:
    """All drives count for falls and overrun; the time to the permit is that of those that are not slow."""
    tally, late_s = Tally(), 0.0
    count = 0
    for number in numbers:
        one = sweep(rim_case, [number])
        tally.add(one)
        count += 1
        if speed_of(number) >= SLOW_M_S:
            late_s = max(late_s, one.late_s)
    check(tally)
    assert tally.drives > count * MIN_DRIVEN
    measured("S22", 1e3 * tally.after_m, "mm")
    measured("S22", 1e3 * late_s, "ms")
    measured("S22", tally.falls, "falls")


def test_a_number_is_a_drive() -> None:
    """Every place of every rim, heading and speed has its number, and the same number is the same drive."""
    assert rim_cases() > 3_000_000
    names = {rim_case(number)[0] for number in range(0, rim_cases(), 9973)}
    assert len(names) == len(range(0, rim_cases(), 9973))
    assert {name.split()[2] for name in names} == set(edge_sweep.MIRRORS)
    assert rim_case(4)[1]() == rim_case(4)[1]()


@pytest.mark.fault("S22")
def test_a_sample_of_the_rim(measured: Measured) -> None:
    rng = random.Random(20)
    check_rim([rng.randrange(rim_cases()) for _ in range(160)], measured)


@pytest.mark.fault("S24")
def test_a_sample_of_turns_beside_the_rim(measured: Measured) -> None:
    rng = random.Random(24)
    tally = sweep(turn_case, [rng.randrange(turn_cases()) for _ in range(60)])
    check(tally)
    assert tally.drives > 60 * MIN_DRIVEN
    assert tally.late_s <= PERMIT_S
    measured("S24", 1e3 * tally.late_s)


@pytest.mark.fault("S20", "S21")
def test_a_sample_of_ways_and_stops_over_seams(measured: Measured) -> None:
    rng = random.Random(21)
    tally = sweep(seam_case, [rng.randrange(whole_sweep.SEAMS) for _ in range(24)])
    check(tally)
    assert tally.over_gap > 2
    measured("S20", tally.false_edges / tally.transits)
    measured("S21", float(tally.false_edges))


@pytest.mark.slow
@pytest.mark.fault("S22")
@pytest.mark.parametrize("part", range(4))
def test_the_rim(part: int, measured: Measured) -> None:
    check_rim(range(SHARD + SHARDS * part, rim_cases(), 4 * SHARDS), measured)


@pytest.mark.slow
@pytest.mark.fault("S24")
def test_turns_beside_the_rim(measured: Measured) -> None:
    tally = sweep(turn_case, range(SHARD, turn_cases(), SHARDS))
    check(tally)
    measured("S24", 1e3 * tally.late_s)


@pytest.mark.slow
@pytest.mark.fault("S20", "S21")
@pytest.mark.parametrize("part", range(2))
def test_ways_and_stops_over_seams(part: int, measured: Measured) -> None:
    # Neither mirrors nor kinds of crossing may fall out of step with the shards.
    numbers = range(whole_sweep.SEAMS * part // 2, whole_sweep.SEAMS * (part + 1) // 2)
    tally = sweep(seam_case, [k for k in numbers if k // 8 % SHARDS == SHARD % SHARDS])
    check(tally)
    measured("S20", tally.false_edges / tally.transits)
    measured("S21", float(tally.false_edges))


# -- the whole sweep --------------------------------------------------------------------------------------------------


def few_drives(monkeypatch: pytest.MonkeyPatch, falls_at: int | None = None) -> None:
    """Ten drives over a rim and five over seams, in blocks of four."""

    def case(number: int) -> tuple[str, Callable[[], Tally]]:
        return f"drive {number}", lambda: Tally(drives=1, falls=int(number == falls_at))

    monkeypatch.setattr(whole_sweep, "BLOCK", 4)
    monkeypatch.setattr(whole_sweep, "KINDS", {"rim": (case, lambda: 10), "seam": (case, lambda: 5)})


def test_the_whole_sweep_is_every_drive_once() -> None:
    swept: dict[str, list[range]] = {}
    for kind, first in whole_sweep.blocks():
        swept.setdefault(kind, []).append(range(first, first + whole_sweep.BLOCK))
    for kind, count in (("rim", rim_cases()), ("turn", turn_cases()), ("seam", whole_sweep.SEAMS)):
        firsts = sorted(part.start for part in swept[kind])
        assert firsts == list(range(0, count, whole_sweep.BLOCK))


def test_the_whole_sweep_goes_on_where_it_was_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    few_drives(monkeypatch)
    assert whole_sweep.main([str(tmp_path), "--workers", "1", "--blocks", "2"]) == 0
    path = tmp_path / "blocks.jsonl"
    path.write_text(path.read_text()[:-5])  # killed while it wrote
    assert whole_sweep.main([str(tmp_path), "--workers", "1"]) == 0
    said = capsys.readouterr().out
    assert "1 of 5 blocks are done, 4 to do" in said
    assert "rim: 3 of 3 blocks, 10 drives" in said
    assert "seam: 2 of 2 blocks, 5 drives" in said


def test_the_whole_sweep_tells_who_fell(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    few_drives(monkeypatch, falls_at=3)
    assert whole_sweep.main([str(tmp_path), "--workers", "1"]) == 1
    assert "drive 3: 1 drives" in capsys.readouterr().out
    assert whole_sweep.main([str(tmp_path), "--workers", "1"]) == 1  # nor is it forgotten
    monkeypatch.setattr(whole_sweep, "build", lambda: "mended")
    few_drives(monkeypatch)
    assert whole_sweep.main([str(tmp_path), "--workers", "1"]) == 0
    builds = [json.loads(line)["build"] for line in (tmp_path / "blocks.jsonl").read_text().split("\n") if line]
    assert builds[:5] != builds[5:] == ["mended"] * 5
