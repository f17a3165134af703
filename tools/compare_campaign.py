"""Simulated pairs of tracker files before and after an adjustment: does ``ccatp compare`` find what was not made?

``python -m tools.compare_campaign [--pairs N] [--seed S] [--mirror NAME] [--panels N]``.
Each pair goes the way of a user: points file, ``ccatp align --json``, adjustment, another points file, comparison. The
files have other frames (shifted by 0.3 mm, turned by 50 urad), other targets, other scales (5 ppm), other orders of
lines, and a few missing points. Panels bend with their adjusters, or do not, pair by pair; in every third pair their
surfaces are rough (20 um). One panel in ten is not moved as planned: no adjuster moved, one did not move or moved the
wrong way, two were exchanged, or the panel was replaced.
"""

import argparse
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from enum import StrEnum
from itertools import repeat
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from ccatp.core import FloatArray, PanelId
from ccatp.mirror.adjuster_work import work_list
from ccatp.mirror.move_checks import Made, PanelCheck
from ccatp.mirror.panel_modes import adjustable, adjuster_places, quadratic, rigid
from ccatp.report.compare import SurveyPair, read_survey
from tests.support.trackers import Instrument, measured, places_of

_LIES_M, _SLOPE_RAD, _ROUGH_M = 60e-6, 150e-6, 20e-6
_SHARE = 0.1  # of panels that are not moved as planned
_INTERVAL = 1.959964  # sigmas of a 95 % interval


class Deed(StrEnum):
    """What was done at a panel."""

    PLANNED = "as planned"
    NOTHING = "no adjuster moved"
    ONE_NOT = "one did not move"
    ONE_WRONG = "one moved the wrong way"
    EXCHANGED = "two were exchanged"
    REPLACED = "panel replaced"


class Outcome(NamedTuple):
    """What a comparison says of a pair: intervals that hold and all, accused panels and all, names found and all."""

    covered: int
    intervals: int
    accused: int
    right: int
    found: Counter[Deed]
    named: Counter[Deed]
    total: Counter[Deed]
    has_motion: bool


def adjusted(planned_m: FloatArray, deed: Deed, rng: np.random.Generator) -> tuple[FloatArray, tuple[int, ...]]:
    """The moves that were made, and the adjusters that differ: those with the largest moves, or most unlike ones."""
    made, order = planned_m.copy(), np.argsort(-np.abs(planned_m))
    one = int(order[0])
    if deed is Deed.NOTHING:
        return 0.0 * made, tuple(range(len(made)))
    if deed in (Deed.ONE_NOT, Deed.ONE_WRONG):
        made[one] *= 0.0 if deed is Deed.ONE_NOT else -1.0
        return made, (one,)
    if deed is Deed.EXCHANGED:
        other = int(np.argmax(np.abs(planned_m - planned_m[one])))
        made[[one, other]] = made[[other, one]]
        return made, (one, other)
    return made, ()


def outcome(seed: int, name: str, panels: int | None = None) -> Outcome:
    """One pair of surveys."""
    rng, places = np.random.default_rng([seed, 45]), places_of(name, panels)
    count, does_bend, is_rough = len(places.panels), seed % 2 == 1, seed % 3 == 0
    modes = np.array([adjustable(one) for one in places.places_m])
    scale = np.array([_LIES_M, _SLOPE_RAD, _SLOPE_RAD, 0.0, 0.0])
    lies = scale * rng.normal(size=(count, 5))
    rough = _ROUGH_M * is_rough * rng.normal(size=(count, 9))
    with TemporaryDirectory() as folder:
        before = measured(
            Path(folder) / "before.csv", places, np.einsum("nki,ni->nk", modes, lies) + rough, Instrument(), rng
        )
        first = read_survey(before)
        planned, work = first.panels, work_list(first.mirror, first.cfg.adjusters, [*first.panels.values()]).panels
        deeds, truth, later = dict[PanelId, tuple[Deed, tuple[int, ...]]](), dict[PanelId, FloatArray](), lies.copy()
        for at, panel in enumerate(places.panels):
            if panel not in work:
                continue
            wrong = [deed for deed in Deed if deed is not Deed.PLANNED]
            deed = Deed(rng.choice(wrong)) if rng.random() < _SHARE else Deed.PLANNED
            made, which = adjusted(planned[panel].rigid.moves.values_m, deed, rng)
            own = adjuster_places(places.mirror, panel)[1]
            shape = adjustable if does_bend else rigid
            change = np.linalg.lstsq(shape(own), made, rcond=None)[0]
            later[at, : len(change)] += change
            deeds[panel], truth[panel] = (deed, which), shape(own) @ change
            if deed is Deed.REPLACED:
                # Another panel lies and is curved otherwise.
                later[at] = scale * rng.normal(size=5)
                rough[at] = quadratic(places.places_m[at])[:, 3:] @ rng.normal(0.0, 3e-3, 3)
        displaced = np.einsum("nki,ni->nk", modes, later) + rough
        after = measured(Path(folder) / "after.csv", places, displaced, Instrument(offset_m=0.0127), rng)
        pair = SurveyPair(first, read_survey(after))
    return judged(pair, deeds, truth)


def judged(
    pair: SurveyPair, deeds: dict[PanelId, tuple[Deed, tuple[int, ...]]], truth: dict[PanelId, FloatArray]
) -> Outcome:
    """Compare what the comparison says with what was done."""
    covered, intervals, accused, right = 0, 0, 0, 0
    found, named, total = Counter[Deed](), Counter[Deed](), Counter[Deed]()
    for check in pair.checks:
        deed, which = deeds[check.panel]
        total[deed] += 1
        if deed is Deed.PLANNED:
            right += 1
            accused += not check.is_as_planned
        else:
            found[deed] += not check.is_as_planned
            named[deed] += deed is not Deed.REPLACED and _names(check, which)
        if deed is not Deed.REPLACED:
            away = np.array([move.measured_m for move in check.moves]) - truth[check.panel]
            sigmas = np.array([move.sigma_m for move in check.moves])
            covered += int(np.sum(np.abs(away) <= _INTERVAL * sigmas))
            intervals += len(away)
    other = set(pair.changes.repeat.other_surface if pair.changes else ())
    named[Deed.REPLACED] = sum(deeds[panel][0] is Deed.REPLACED for panel in other if panel in deeds)
    has_motion = pair.changes is not None and pair.changes.motion is not None
    return Outcome(covered, intervals, accused, right, found, named, total, has_motion)


def _names(check: PanelCheck, which: Sequence[int]) -> bool:
    """Whether the adjusters are named: alone, or as one of few explanations."""
    names = {check.moves[at].adjuster for at in which}
    if check.is_plane:
        return any(set(one.adjusters) == names for one in check.explanations)
    return {move.adjuster for move in check.moves if move.made is not Made.AS_PLANNED} == names


def campaign(pairs: int, seed: int, name: str, panels: int | None = None, workers: int = 1) -> Iterator[Outcome]:
    """Pairs one after the other, or on some processes."""
    seeds = range(seed, seed + pairs)
    if workers == 1:
        yield from map(outcome, seeds, repeat(name), repeat(panels))
        return
    with ProcessPoolExecutor(workers) as pool:
        yield from pool.map(outcome, seeds, repeat(name), repeat(panels))


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--pairs", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--mirror", default="fyst-m1")
    parser.add_argument("--panels", type=int, default=24)
    parser.add_argument("--workers", type=int, default=1)
    args = parser.parse_args()
    found = [*campaign(args.pairs, args.seed, args.mirror, args.panels, args.workers)]
    for title, some in (("smooth", [0, 1]), ("rough", [2])):
        chosen = [one for at, one in enumerate(found, args.seed) if (at % 3 == 0) == (some == [2])]
        hits, intervals = sum(one.covered for one in chosen), max(sum(one.intervals for one in chosen), 1)
        print(f"{title} panels: {len(chosen)} pairs, 95 % intervals of moves hold in {100.0 * hits / intervals:.2f} %")
    accused, right = sum(one.accused for one in found), sum(one.right for one in found)
    pairs = sum(one.accused > 0 for one in found)
    print(f"accused falsely: {accused} of {right} panels, in {pairs} of {len(found)} pairs")
    print(f"motion of the mirror found in {sum(one.has_motion for one in found)} of {len(found)} pairs")
    for deed in Deed:
        total = sum(one.total[deed] for one in found)
        if deed is not Deed.PLANNED:
            seen, named = (sum(getattr(one, what)[deed] for one in found) for what in ("found", "named"))
            print(f"{deed}: not as planned {seen} of {total}, named {named}")


if __name__ == "__main__":
    main()
