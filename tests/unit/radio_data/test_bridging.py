"""Odometry that is silent for a while: its way is guessed, and how far the guess may be off."""

from pathlib import Path

import numpy as np
import pytest

from ccatp.beacons.datasets.reader import read_run
from ccatp.beacons.datasets.tables import LOST_RAD, bridged
from ccatp.beacons.slam.recording import Steps
from ccatp.core import FloatArray
from tests.unit.radio_data.sets import csv_lines, plaza_tables, world, write_lines, write_plaza


def steps_of(distance_m: FloatArray, turn_rad: FloatArray, interval_s: float = 0.1) -> Steps:
    return Steps(interval_s * np.arange(distance_m.size + 1.0), distance_m, turn_rad, np.zeros(distance_m.size))


def test_steps_without_a_gap_stay_as_they_are() -> None:
    steps = steps_of(np.full(100, 0.05), np.full(100, 0.01))
    assert bridged(steps) is steps


def test_a_row_that_is_lost_goes_on_as_before() -> None:
    rng = np.random.default_rng(1)
    distance: FloatArray = 0.05 + 0.001 * rng.standard_normal(1000)
    distance[400] = np.nan
    found = bridged(steps_of(distance, np.full(1000, 0.01)))
    assert found.distance_m[400] == pytest.approx(0.05, abs=0.002)
    assert found.turn_rad[400] == pytest.approx(0.01)
    assert np.sqrt(found.guess_m2[400]) == pytest.approx(0.001, rel=0.3)  # type: ignore[index]  # as steps differ
    assert np.count_nonzero(found.guess_m2) == 1


def test_a_long_gap_leaves_the_heading_lost_and_the_place_as_far_as_it_may_have_driven() -> None:
    t = np.arange(6000)
    turn = 0.03 * np.sign(np.sin(0.013 * t))  # lanes up and down
    whole = steps_of(np.full(6000, 0.05), turn)
    keep = np.concatenate([[True], (t < 3000) | (t >= 3200)])
    cut = Steps(whole.times_s[keep], *(column[keep[1:]] for column in whole[1:4]))
    found = bridged(cut)
    assert found.times_s[3001] - found.times_s[3000] == pytest.approx(20.1)
    guess_m2, guess_rad2 = np.asarray(found.guess_m2)[3000], np.asarray(found.guess_rad2)[3000]
    assert guess_rad2 == pytest.approx(LOST_RAD**2)
    assert np.sqrt(guess_m2) == pytest.approx(10.0, rel=0.15)  # at 0.5 m/s, anywhere about where it was
    assert abs(found.distance_m[3000]) < 3.0


@pytest.mark.parametrize("form", ["plaza", "csv"])
def test_a_row_that_is_not_finite_keeps_its_time(tmp_path: Path, form: str) -> None:
    w = world()
    if form == "plaza":
        write_plaza(tmp_path, w, mat=False)
        table = plaza_tables(w)["DR"]
        table[50, 1] = np.nan
        file = tmp_path / "Field1_DR.txt"
        np.savetxt(file, table)
    else:
        lines = csv_lines(w)
        row = next(k for k, line in enumerate(lines) if line.startswith(f"odom,{w.times_s[51]},"))
        lines[row] = f"odom,{w.times_s[51]},nan,{w.turn_rad[50]}"
        file = write_lines(tmp_path / "mine.csv", lines)
    run = read_run(file, None, None)
    assert run.steps.times_s.size == w.times_s.size
    assert run.steps.distance_m.sum() == pytest.approx(w.distance_m.sum(), abs=2e-3)
    assert any("1 row not finite (the first here): the way there is guessed" in line for line in run.warnings)
