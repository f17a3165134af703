"""One-shot fixes from levels: unbiased places, regions that hold what they promise, exchanged names."""

import numpy as np
import pytest

from ccatp.beacons.slam.path_loss import LevelLocator, LevelPair, PathLossFit, Room, fit_path_loss, likeliest_names

BEACONS = {"A": (0.0, 0.0), "B": (0.0, 4.0), "C": (4.0, 0.0)}
ROOM = Room((0.0, 0.0), (4.0, 4.0), 0.1)
Levels = dict[str, float]


def scene(seed: int, sigma_db: float, points: int) -> tuple[LevelLocator, list[tuple[tuple[float, float], Levels]]]:
    """A locator calibrated at 40 places, and points with levels from the same model."""
    rng = np.random.default_rng(seed)

    def level(place: tuple[float, float], name: str) -> float:
        r = max(float(np.hypot(place[0] - BEACONS[name][0], place[1] - BEACONS[name][1])), 0.1)
        return float(-45.0 - 25.0 * np.log10(r) + sigma_db * rng.standard_normal())

    def draw() -> tuple[float, float]:
        x, y = rng.uniform(0.0, 4.0, 2).tolist()
        return x, y

    fits: dict[str, PathLossFit] = {}
    for name, at in BEACONS.items():
        places = [draw() for _ in range(40)]
        distances = [max(float(np.hypot(p[0] - at[0], p[1] - at[1])), 0.1) for p in places]
        fits[name] = fit_path_loss(LevelPair(r, level(p, name), p) for r, p in zip(distances, places, strict=True))
    heard = [(place, {name: level(place, name) for name in BEACONS}) for place in (draw() for _ in range(points))]
    return LevelLocator(BEACONS, fits, ROOM), heard


def test_good_levels_give_the_place() -> None:
    locator, heard = scene(1, 0.3, 20)
    for place, levels in heard:
        assert np.hypot(*(locator.fix(levels).position_m - place)) < 0.3


def test_ninety_per_cent_regions_hold_ninety_per_cent() -> None:
    locator, heard = scene(2, 5.0, 300)
    inside = np.mean([locator.fix(levels).holds(place, 0.9) for place, levels in heard])
    assert inside == pytest.approx(0.9, abs=0.06)  # 3.5 sigma of 300 points


def test_a_beacon_that_is_not_heard_is_left_out() -> None:
    locator, heard = scene(3, 1.0, 1)
    levels = heard[0][1]
    fewer = locator.fix({"A": levels["A"]})
    assert fewer.region(0.9).sum() > locator.fix(levels).region(0.9).sum()
    with pytest.raises(ValueError, match="none of the beacons A, B, C was heard"):
        locator.fix({"D": -50.0})


def test_exchanged_names_are_found() -> None:
    locator, heard = scene(4, 5.0, 12)
    assert likeliest_names(locator, heard) == ({"A": "A", "B": "B", "C": "C"}, 0.0)
    exchanged = [(place, {"A": z["A"], "B": z["C"], "C": z["B"]}) for place, z in heard]
    names, gain = likeliest_names(locator, exchanged)
    assert names == {"A": "A", "B": "C", "C": "B"}
    assert gain > 7.0
