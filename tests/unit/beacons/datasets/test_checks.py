"""What looks wrong in a set is told; what is sound is not."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ccatp.beacons.datasets.checks import suspicions
from ccatp.beacons.datasets.reader import read_run
from ccatp.beacons.estimation.recording import (
    RecordedRun,
    ReferencePath,
    Steps,
    antenna_path,
    dead_reckoned,
)
from tests.unit.beacons.datasets.sets import (
    BEACONS,
    labyrinth_lines,
    plaza_tables,
    recorded,
    world,
    write_lines,
    write_plaza,
)

W = world(seconds=120.0)


def noisy(scale: float = 1.0, turn_scale: float = 1.0) -> RecordedRun:
    """Odometry as wheels would tell it, so that it is not the truth itself."""
    rng, run = np.random.default_rng(7), recorded(W)
    steps = run.steps
    distance = scale * steps.distance_m * (1.0 + 0.05 * rng.standard_normal(steps.distance_m.size))
    turn = turn_scale * steps.turn_rad * (1.0 + 0.05 * rng.standard_normal(steps.turn_rad.size))
    return replace(run, steps=Steps(steps.times_s, distance, turn, steps.lateral_m))


SOUND = noisy()
READ = SOUND.readings
COURSE = ReferencePath(W.times_s, *W.poses.T)
ZEROS, NOWHERE = np.zeros(SOUND.steps.distance_m.size), np.zeros(COURSE.x_m.size)
SHUFFLED = np.random.default_rng(3).permutation(SOUND.steps.turn_rad) * np.where(np.arange(1200) % 2, 1.0, -1.0)
KEPT = (W.times_s < 30.0) | (W.times_s > 35.0)
ONE_NEGATIVE = np.where(np.arange(READ.range_m.size) == 5, -1.0, READ.range_m)
WILD = SOUND.steps.distance_m.copy()
WILD[100:103] = 1e6
EXCHANGED = np.array([1, 0, 2, 3])[READ.beacon]
POSES = np.array([np.interp(READ.times_s, W.times_s, column) for column in W.poses.T])
OF_7 = np.hypot(*(np.array(BEACONS["7"])[:, None] - POSES[:2]))  # what ranges to beacon 7 would be


def with_readings(**columns: np.ndarray) -> RecordedRun:
    return replace(SOUND, readings=READ._replace(**columns))


def with_truth(**columns: np.ndarray) -> RecordedRun:
    return replace(SOUND, truth=COURSE._replace(**columns))


def with_steps(**columns: np.ndarray) -> RecordedRun:
    return replace(SOUND, steps=SOUND.steps._replace(**columns))


def surveyed(**places: tuple[float, float]) -> RecordedRun:
    return replace(SOUND, beacon_truth_m={**BEACONS, **{name[1:]: place for name, place in places.items()}})


# The 9 stands 0.3 m beside the 8, which the ranges tell apart by little and the bearings well.
X, Y = BEACONS["8"]
TO_9 = X + 0.3 - POSES[0], Y - POSES[1]
NEIGHBOURS = replace(
    with_readings(
        range_m=np.where(READ.beacon == 3, np.hypot(*TO_9), READ.range_m),
        bearing_rad=np.where(READ.beacon == 3, np.arctan2(TO_9[1], TO_9[0]) - POSES[2], READ.bearing_rad),
    ),
    beacon_truth_m={**BEACONS, "9": (X + 0.3, Y)},
)
MIXED = {**BEACONS, "7": (BEACONS["6"][0] + 0.5, BEACONS["6"][1])}  # what the ranges of 8 fit nearly as well
WRONG: list[tuple[RecordedRun, str, str]] = [
    (recorded(W), "odometry distance equals the truth", "surveyed"),
    (recorded(W), "odometry turns equal the truth", "surveyed"),
    (noisy(scale=0.8), "odometry distance: true ways are 1.25 times it", "degrees"),
    (noisy(scale=1000.0), "true ways are 0.001 times it: are they in millimetres?", "degrees"),
    (noisy(turn_scale=0.8), "true turns are 1.25 times them (track of the wheels?)", "degrees"),
    (noisy(turn_scale=180.0 / np.pi), "are the turns in degrees?", "surveyed"),
    (noisy(turn_scale=-1.0), "odometry turns the other way than the truth", "degrees"),
    (with_steps(turn_rad=SHUFFLED), "odometry turns have little to do with the truth", "degrees"),
    (replace(noisy(scale=1000.0), truth=None), "odometry moves by up to", "degrees"),
    (with_steps(distance_m=WILD), "3 steps faster than 50 m/s, the first of 1e+06 m at 10.000 s", "degrees"),
    (with_readings(range_m=1.07 * READ.range_m), "ranges read +7.", "degrees"),
    (with_readings(range_m=READ.range_m + 0.25), "ranges read +0.2", "degrees"),
    (with_readings(range_m=100.0 * READ.range_m), "are they in centimetres?", "degrees"),
    (with_readings(range_m=READ.range_m / 0.3048), "are they in feet?", "degrees"),
    (with_readings(range_m=ONE_NEGATIVE), "1 range below zero", "degrees"),
    (with_readings(bearing_rad=np.degrees(READ.bearing_rad)), "bearings reach", "surveyed"),
    (with_readings(bearing_rad=READ.bearing_rad + 0.3), "bearings read +0.299 rad off", "degrees"),
    (with_readings(bearing_rad=-READ.bearing_rad), "with the other sign: are they clockwise?", "miss its surveyed"),
    (with_readings(rssi_dbm=np.full(READ.range_m.size, 56.0)), "above 0 dBm: is the sign missing?", "degrees"),
    (with_readings(beacon=EXCHANGED), "beacons 6 and 7 look exchanged", "from 60"),
    (
        with_readings(beacon=np.where(READ.times_s > 60.0, EXCHANGED, READ.beacon)),
        "from 60 to 120 s alone: beacons 6 and 7 look exchanged", "off (fit to the truth)",
    ),
    (
        with_readings(range_m=np.where(READ.beacon == 0, OF_7, READ.range_m)),
        "ranges of beacon 6 fit the place of 7, not its own", "exchanged",
    ),
    (replace(NEIGHBOURS, beacon_truth_m={**BEACONS, "8": (X + 0.3, Y), "9": (X, Y)}), "8 and 9 look exchanged", "feet"),
    (replace(SOUND, beacon_truth_m={**MIXED, "6": MIXED["8"], "8": MIXED["6"]}), "6 and 8 look exchanged", "feet"),
    (surveyed(_8=(9.0, 4.0)), "ranges of beacon 8 miss its surveyed place by", "exchanged"),
    (surveyed(_8=(60.0, 60.0), _77=BEACONS["8"]), "surveyed beacons without any reading: 77", "exchanged"),
    (replace(SOUND, beacon_truth_m={"6": BEACONS["6"], "7": BEACONS["7"]}), "a surveyed place: 8, 9", "exchanged"),
    (
        replace(SOUND, readings=READ.where((READ.times_s < 30.0) | (READ.times_s > 50.0))),
        "readings: 1 gap, the longest of 20.", "truth: 1 gap",
    ),
    (
        replace(SOUND, truth=ReferencePath(*(column[KEPT] for column in COURSE))),
        "truth: 1 gap, the longest of 5.", "readings: 1 gap",
    ),
    (with_truth(heading_rad=np.degrees(COURSE.heading_rad)), "is its heading in degrees?", "feet"),
    (with_steps(distance_m=ZEROS, turn_rad=ZEROS), "odometry never moves (0 m) while the truth gets", "feet"),
    (
        with_truth(x_m=NOWHERE, y_m=NOWHERE, heading_rad=NOWHERE),
        "the truth never moves (0 m) while the odometry travels", "off (fit to the truth)",
    ),
]  # fmt: skip


def test_a_sound_run_raises_no_suspicion() -> None:
    assert suspicions(SOUND) == []
    assert "exchanged" not in " | ".join(suspicions(NEIGHBOURS))
    assert "exchanged" not in " | ".join(suspicions(surveyed(_8=(X + 0.3, Y))))


def test_noise_of_the_odometry_is_no_scale_of_its_turns() -> None:
    """The slope of the truth on noisy turns is too small: turns of a fast vehicle change little between two chords."""
    noise = np.random.default_rng(5).normal(0.0, 0.04, SOUND.steps.turn_rad.size)
    assert not any("true turns" in line for line in suspicions(with_steps(turn_rad=SOUND.steps.turn_rad + noise)))


def test_checks_leave_out_the_gap_of_a_truth() -> None:
    """As of a motion capture that sees the beginning and the end of a run."""
    seen = (W.times_s < 30.0) | (W.times_s > 90.0)
    (line,) = suspicions(replace(SOUND, truth=ReferencePath(*(column[seen] for column in COURSE))))
    assert line.startswith("truth: 1 gap, the longest of 60.")
    unturned = replace(
        SOUND, truth=ReferencePath(*(column[seen] for column in COURSE))._replace(heading_rad=np.nan * NOWHERE[seen])
    )
    assert not any("fits the odometry" in line for line in suspicions(unturned))


@pytest.mark.parametrize("late_s", [0.3, -0.2])
def test_a_truth_that_is_a_little_late_is_named(late_s: float) -> None:
    reported = " | ".join(suspicions(with_truth(times_s=COURSE.times_s + late_s)))
    assert f"if taken {abs(late_s)} s {'earlier' if late_s > 0 else 'later'}: their clocks differ" in reported


def test_a_vehicle_that_mostly_stands_has_no_beacons_above_it() -> None:
    """In its place all of the range would be height."""
    slow = 0.1 * (W.times_s[:-1] < 20.0)
    steps = Steps(W.times_s, slow * SOUND.steps.distance_m, slow * SOUND.steps.turn_rad, np.zeros(slow.size))
    path = dead_reckoned(steps, (3.0, 1.0, 0.4))
    at = np.array([np.interp(READ.times_s, W.times_s, column) for column in path[:, :2].T])
    noise = np.random.default_rng(2).normal(0.0, 0.02, READ.times_s.size)
    ranges = np.hypot(*(np.array(list(BEACONS.values()))[READ.beacon].T - at)) + noise
    nothing = np.full(ranges.size, np.nan)
    run = replace(SOUND, steps=steps, truth=None, readings=READ._replace(range_m=ranges, bearing_rad=nothing))
    assert not any("above or below" in line for line in suspicions(run))


@pytest.mark.parametrize(("run", "what", "unsaid"), WRONG, ids=[what for _, what, _ in WRONG])
def test_what_looks_wrong_is_reported_and_nothing_else(run: RecordedRun, what: str, unsaid: str) -> None:
    reported = " | ".join(suspicions(run))
    assert what in reported
    assert unsaid not in reported


@pytest.mark.parametrize(("turned", "what"), [(np.pi, "pi"), (-1.2, "-1.200 rad")])
def test_a_truth_heading_that_is_turned_is_turned_back(tmp_path: Path, turned: float, what: str) -> None:
    tables = plaza_tables(W)
    tables["GT"][:, 3] -= turned
    write_plaza(tmp_path, W, mat=False)
    np.savetxt(tmp_path / "Field1_GT.txt", tables["GT"])
    run = read_run(tmp_path / "Field1_DR.txt", None, None)
    assert any(warning.startswith(f"truth heading is turned by {what}") for warning in run.warnings)
    off = (run.first_pose[2] - W.poses[0, 2] + np.pi) % (2.0 * np.pi) - np.pi
    assert off == pytest.approx(0.0, abs=0.05)  # the mean of the course knows no better


def test_the_run_begins_with_a_truth_that_begins_while_the_vehicle_moves(tmp_path: Path) -> None:
    write_plaza(tmp_path, W, mat=False)
    np.savetxt(tmp_path / "Field1_GT.txt", plaza_tables(W)["GT"][100:])
    run = read_run(tmp_path / "Field1_DR.txt", None, None)
    assert any(line.startswith("the truth begins 10 s after the odometry") for line in run.warnings)
    assert run.first_pose == pytest.approx(W.poses[100])
    assert run.steps.times_s[0] == W.times_s[100]


@pytest.mark.parametrize("exchanged", [False, True])
def test_labyrinth_wheel_columns_are_reported_and_compared_with_the_true_path(tmp_path: Path, exchanged: bool) -> None:
    run = read_run(write_lines(tmp_path / "a.txt", labyrinth_lines(W, exchanged=exchanged)), None, None)
    reported = " | ".join(run.warnings)
    assert "read as left, right and half the track of 0.3 m" in reported
    assert ("turns the other way" in reported) is exchanged


@pytest.mark.parametrize(
    ("arm_m", "what"),
    [((0.6, -0.3), ("ahead", "right")), ((-0.5, 0.4), ("behind", "left")), ((0.02, 0.0), ())],
)
def test_a_radio_off_the_origin_is_no_other_clock(arm_m: tuple[float, float], what: tuple[str, ...]) -> None:
    at = antenna_path(POSES.T, arm_m)
    places = np.array(list(BEACONS.values()))[READ.beacon]
    noise_m = 0.05 * np.random.default_rng(4).standard_normal(READ.range_m.size)
    run = with_readings(range_m=np.hypot(*(places - at).T) + noise_m, bearing_rad=np.full(READ.range_m.size, np.nan))
    said = [line for line in suspicions(run) if "fit the odometry" in line]
    assert len(said) == bool(what)
    assert not any("clock" in line for line in said)
    for line in said:
        assert all(word in line for word in what)
        sizes_m = [float(size) for size in re.findall(r"[\d.]+(?= m )", line)]
        assert sizes_m == pytest.approx(np.abs(arm_m), abs=0.05)  # sigma of a range


def test_beacons_above_the_radio_are_distinguished_from_those_in_its_plane() -> None:
    nothing = np.full(READ.range_m.size, np.nan)
    run = with_readings(range_m=np.hypot(READ.range_m, 2.5), bearing_rad=nothing)
    (line,) = [line for line in suspicions(run) if "above or below" in line]
    assert "about 2 m" in line or "about 3 m" in line
    assert not any("above or below" in line for line in suspicions(with_readings(bearing_rad=nothing)))


def test_an_odometry_that_never_moves_is_named() -> None:
    said = suspicions(replace(with_steps(distance_m=ZEROS, turn_rad=ZEROS), truth=None))
    assert any("the odometry never moves" in line for line in said)
