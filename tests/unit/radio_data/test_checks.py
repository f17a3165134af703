"""What looks wrong in a set is told; what is sound is not."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ccatp.beacons.datasets.checks import suspicions
from ccatp.beacons.datasets.reader import read_run
from ccatp.beacons.slam.recording import RecordedRun, ReferencePath, Steps
from tests.unit.radio_data.sets import BEACONS, labyrinth_lines, plaza_tables, recorded, world, write_lines, write_plaza

W = world(seconds=120.0)


def noisy(run: RecordedRun, scale: float = 1.0, turn_scale: float = 1.0) -> RecordedRun:
    """Odometry as wheels would tell it, so that it is not the truth itself."""
    rng = np.random.default_rng(7)
    steps = run.steps
    distance = scale * steps.distance_m * (1.0 + 0.05 * rng.standard_normal(steps.distance_m.size))
    turn = turn_scale * steps.turn_rad * (1.0 + 0.05 * rng.standard_normal(steps.turn_rad.size))
    return replace(run, steps=Steps(steps.times_s, distance, turn, steps.lateral_m))


SOUND = noisy(recorded(W))


def with_readings(run: RecordedRun, **columns: np.ndarray) -> RecordedRun:
    """The run with other readings."""
    return replace(run, readings=run.readings._replace(**columns))


def with_truth(run: RecordedRun, **columns: np.ndarray) -> RecordedRun:
    """The run with another truth."""
    assert run.truth is not None
    return replace(run, truth=run.truth._replace(**columns))


def told(run: RecordedRun) -> str:
    """All warnings as one text."""
    return " | ".join(suspicions(run))


def test_a_sound_run_raises_no_suspicion() -> None:
    assert suspicions(SOUND) == []


def test_odometry_that_equals_the_truth() -> None:
    found = told(recorded(W))
    assert "odometry distance equals the truth" in found
    assert "odometry turns equal the truth" in found


@pytest.mark.parametrize(
    ("run", "what"),
    [
        (noisy(recorded(W), scale=0.8), "odometry distance: true ways are 1.25 times it"),
        (noisy(recorded(W), scale=1000.0), "true ways are 0.001 times it: are they in millimetres?"),
        (noisy(recorded(W), turn_scale=0.8), "true turns are 1.24 times them (track of the wheels?)"),
        (noisy(recorded(W), turn_scale=180.0 / np.pi), "are the turns in degrees?"),
        (noisy(recorded(W), turn_scale=-1.0), "odometry turns the other way than the truth"),
    ],
)
def test_odometry_of_another_scale_sign_or_unit(run: RecordedRun, what: str) -> None:
    assert what in told(run)


def test_odometry_turns_that_have_nothing_to_do_with_the_truth() -> None:
    turn = np.random.default_rng(3).permutation(SOUND.steps.turn_rad) * np.where(np.arange(1200) % 2, 1.0, -1.0)
    assert "odometry turns have little to do with the truth" in told(
        replace(SOUND, steps=SOUND.steps._replace(turn_rad=turn))
    )


def test_odometry_in_millimetres_without_truth() -> None:
    run = replace(noisy(recorded(W), scale=1000.0), truth=None)
    assert "odometry moves by up to" in told(run)


def test_ranges_with_scale_offset_or_another_unit() -> None:
    ranges = SOUND.readings.range_m
    assert "ranges read +7." in told(with_readings(SOUND, range_m=1.07 * ranges))
    assert "ranges read +0.2" in told(with_readings(SOUND, range_m=ranges + 0.25))
    assert "are they in centimetres?" in told(with_readings(SOUND, range_m=100.0 * ranges))
    assert "are they in feet?" in told(with_readings(SOUND, range_m=ranges / 0.3048))


def test_bearings_in_degrees_or_turned() -> None:
    bearings = SOUND.readings.bearing_rad
    assert "bearings reach" in told(with_readings(SOUND, bearing_rad=np.degrees(bearings)))
    assert "bearings read +0.299 rad off" in told(with_readings(SOUND, bearing_rad=bearings + 0.3))


def test_negative_ranges_and_signal_strengths_without_sign() -> None:
    ranges = SOUND.readings.range_m.copy()
    ranges[5] = -1.0
    assert "1 range below zero" in told(with_readings(SOUND, range_m=ranges))
    rssi = np.full(ranges.size, 56.0)
    assert "signal strengths above 0 dBm: is the sign missing?" in told(with_readings(SOUND, rssi_dbm=rssi))


def test_exchanged_beacons() -> None:
    swap = np.array([1, 0, 2, 3])
    run = with_readings(SOUND, beacon=swap[SOUND.readings.beacon])
    assert "beacons 6 and 7 look exchanged" in told(run)


def test_beacons_that_are_exchanged_halfway() -> None:
    swap = np.where(SOUND.readings.times_s > 60.0, np.array([1, 0, 2, 3])[SOUND.readings.beacon], SOUND.readings.beacon)
    found = told(with_readings(SOUND, beacon=swap))
    assert "from 60 to 120 s alone: beacons 6 and 7 look exchanged" in found
    assert "off (fit to the truth)" not in found


def test_neighbours_that_are_exchanged_show_by_their_bearings() -> None:
    x, y = BEACONS["8"]
    near = replace(SOUND, beacon_truth_m={**BEACONS, "8": (x + 0.3, y)})
    assert "exchanged" not in told(near)
    survey = {**BEACONS, "9": (x + 0.3, y)}
    rows = SOUND.readings.beacon == 3
    pose = [np.interp(SOUND.readings.times_s, W.times_s, column) for column in W.poses.T]
    dx, dy = x + 0.3 - pose[0], y - pose[1]
    ranges = np.where(rows, np.hypot(dx, dy), SOUND.readings.range_m)
    bearings = np.where(rows, np.arctan2(dy, dx) - pose[2], SOUND.readings.bearing_rad)
    run = replace(with_readings(SOUND, range_m=ranges, bearing_rad=bearings), beacon_truth_m=survey)
    assert "exchanged" not in told(run)
    swapped = replace(run, beacon_truth_m={**survey, "8": survey["9"], "9": survey["8"]})
    assert "beacons 8 and 9 look exchanged" in told(swapped)


def test_exchanged_beacons_with_a_neighbour_are_not_taken_for_it() -> None:
    survey = {**BEACONS, "7": (BEACONS["6"][0] + 0.5, BEACONS["6"][1])}  # what the ranges of 8 fit nearly as well
    swapped = {**survey, "6": survey["8"], "8": survey["6"]}
    assert "beacons 6 and 8 look exchanged" in told(replace(SOUND, beacon_truth_m=swapped))


def test_bearings_with_the_other_sign() -> None:
    found = told(with_readings(SOUND, bearing_rad=-SOUND.readings.bearing_rad))
    assert "bearings fit the truth with the other sign: are they clockwise?" in found
    assert "miss its surveyed place" not in found


def test_what_never_moves() -> None:
    zeros = np.zeros(SOUND.steps.distance_m.size)
    still = replace(SOUND, steps=SOUND.steps._replace(distance_m=zeros, turn_rad=zeros))
    assert "odometry never moves (0 m) while the truth gets" in told(still)
    assert SOUND.truth is not None
    there = np.zeros(SOUND.truth.x_m.size)
    found = told(with_truth(SOUND, x_m=there, y_m=there, heading_rad=there))
    assert "the truth never moves (0 m) while the odometry travels" in found
    assert "off (fit to the truth)" not in found


def test_a_beacon_that_was_surveyed_elsewhere() -> None:
    moved = {**BEACONS, "8": (9.0, 4.0)}
    assert "ranges of beacon 8 miss its surveyed place by" in told(replace(SOUND, beacon_truth_m=moved))
    taken = {**BEACONS, "8": (60.0, 60.0), "77": BEACONS["8"]}
    assert "surveyed beacons that were never heard: 77" in told(replace(SOUND, beacon_truth_m=taken))


def test_ranges_that_fit_another_beacon() -> None:
    rows = np.where(SOUND.readings.beacon == 0, 1, SOUND.readings.beacon)
    ranges = SOUND.readings.range_m.copy()
    seen_of_1 = np.interp(SOUND.readings.times_s, SOUND.readings.times_s[rows == 1], ranges[rows == 1])
    true = np.hypot(
        *(
            np.array(BEACONS["7"])[:, None]
            - np.array([np.interp(SOUND.readings.times_s, W.times_s, W.poses[:, k]) for k in range(2)])
        )
    )
    ranges = np.where(SOUND.readings.beacon == 0, true, ranges)
    assert seen_of_1.size
    assert "ranges of beacon 6 fit the place of 7, not its own" in told(with_readings(SOUND, range_m=ranges))


def test_beacons_without_a_surveyed_place() -> None:
    few = {name: BEACONS[name] for name in ("6", "7")}
    assert "beacons without a surveyed place: 8, 9" in told(replace(SOUND, beacon_truth_m=few))


def test_gaps() -> None:
    keep = (SOUND.readings.times_s < 30.0) | (SOUND.readings.times_s > 50.0)
    run = replace(SOUND, readings=SOUND.readings.where(keep))
    assert "readings: 1 gap, the longest of 20." in told(run)
    assert SOUND.truth is not None
    keep = (W.times_s < 30.0) | (W.times_s > 35.0)
    run = replace(SOUND, truth=ReferencePath(*(column[keep] for column in SOUND.truth)))
    assert "truth: 1 gap, the longest of 5." in told(run)


def test_truth_heading_in_degrees() -> None:
    assert SOUND.truth is not None
    run = with_truth(SOUND, heading_rad=np.degrees(SOUND.truth.heading_rad))
    assert "is its heading in degrees?" in told(run)


@pytest.mark.parametrize(("turned", "what"), [(np.pi, "pi"), (-1.2, "-1.200 rad")])
def test_a_truth_heading_that_is_turned_is_turned_back(tmp_path: Path, turned: float, what: str) -> None:
    tables = plaza_tables(W)
    tables["GT"][:, 3] -= turned
    np.savetxt(tmp_path / "x", tables["GT"])
    write_plaza(tmp_path, W, mat=False)
    np.savetxt(tmp_path / "Field1_GT.txt", tables["GT"])
    run = read_run(tmp_path / "Field1_DR.txt", None, None)
    assert any(warning.startswith(f"truth heading is turned by {what}") for warning in run.warnings)
    off = (run.first_pose[2] - W.poses[0, 2] + np.pi) % (2.0 * np.pi) - np.pi
    assert off == pytest.approx(0.0, abs=0.05)  # the mean of the course knows no better


def test_a_truth_that_begins_after_the_odometry(tmp_path: Path) -> None:
    write_plaza(tmp_path, W, mat=False)
    np.savetxt(tmp_path / "Field1_GT.txt", plaza_tables(W)["GT"][100:])
    run = read_run(tmp_path / "Field1_DR.txt", None, None)
    assert any("does not cover the first odometry" in warning for warning in run.warnings)


def test_labyrinth_wheel_columns_by_the_true_path(tmp_path: Path) -> None:
    run = read_run(write_lines(tmp_path / "a.txt", labyrinth_lines(W)), None, None)
    assert any("left, right, track 0.300 m (the readme says" in warning for warning in run.warnings)
    run = read_run(write_lines(tmp_path / "b.txt", labyrinth_lines(W, exchanged=True)), None, None)
    assert any("right, left, track 0.300 m; they were read as left, right" in warning for warning in run.warnings)
    assert any("turns the other way" in warning for warning in run.warnings)
