"""Several radios on one vehicle: lever arms in all estimators, and the heading that they make observable."""

from dataclasses import replace

import numpy as np
import pytest

from ccatp.beacons.config.load import load_recordings_config
from ccatp.beacons.datasets.checks import suspicions
from ccatp.beacons.datasets.mounting import misplaced_radios
from ccatp.beacons.estimation.batch_problem import BatchProblem
from ccatp.beacons.estimation.batch_unknowns import BEACON, SHARED, BatchState
from ccatp.beacons.estimation.evaluation import judge, truth_at
from ccatp.beacons.estimation.motion import RadioPose
from ccatp.beacons.estimation.recording import KnownMap, Radio, RecordedRun
from ccatp.beacons.studies.recordings import FILTERS, estimate
from ccatp.core import FloatArray
from tests.support.cases import slow_case
from tests.unit.beacons.datasets.sets import BEACONS, recorded, world

CFG = load_recordings_config(None, {"csv.radio.range_sigma_m": 0.05})
TAGS = (Radio("front", 0.4, 0.1), Radio("rear", -0.3, -0.2))


def by_radios(run: RecordedRun, tags: tuple[Radio, ...], sigma_m: float, seed: int) -> RecordedRun:
    """The run with ranges of radios in turn; without tags, of one at the pose."""
    assert run.truth is not None
    r, rng = run.readings, np.random.default_rng(seed)
    if tags:
        tag = np.arange(len(r.times_s)) // len(run.beacon_ids) % len(tags)
        r = r._replace(tag=tag, arm_m=np.array([one[1:] for one in tags])[tag])
    places = np.array([run.beacon_truth_m[name] for name in run.beacon_ids])[r.beacon]
    way = places - r.radios_at(truth_at(run.truth, r.times_s))
    nothing = np.full(len(r.times_s), np.nan)
    range_m = np.hypot(*way.T) + sigma_m * rng.standard_normal(len(r.times_s))
    return replace(run, readings=r._replace(range_m=range_m, bearing_rad=nothing), tags=tags)


def driven(seed: int, tags: tuple[Radio, ...] = TAGS, seconds: float = 60.0) -> RecordedRun:
    """A drive with errors of the odometry as configured."""
    run = by_radios(recorded(world(seed, seconds)), tags, 0.05, seed)
    noise, rng = CFG.csv.odometry, np.random.default_rng(1000 + seed)
    d, w = run.steps.distance_m, run.steps.turn_rad
    turn_sigma = np.sqrt(noise.turn_per_sqrt_m**2 * d + noise.turn_per_sqrt_rad**2 * np.abs(w))
    return replace(
        run,
        steps=run.steps._replace(
            distance_m=d + noise.distance_per_sqrt_m * np.sqrt(d) * rng.standard_normal(d.size),
            turn_rad=w + turn_sigma * rng.standard_normal(d.size),
        ),
    )


def test_the_derivatives_by_a_pose_and_a_beacon_are_those_of_the_ranges() -> None:
    run = by_radios(recorded(world(1, 3.0)), TAGS, 0.0, 1)
    r, count = run.readings, len(run.beacon_ids)
    assert run.truth is not None
    times_s = np.union1d(r.times_s, run.steps.times_s[:1])
    problem = BatchProblem(run.steps, r, times_s, run.first_pose, CFG.csv, np.ones(count, dtype=bool))
    beacons = np.zeros((count, BEACON))
    beacons[:, :2] = list(BEACONS.values())
    poses, shared = truth_at(run.truth, times_s), np.zeros(len(SHARED))

    def off(by_pose: FloatArray, by_beacon: FloatArray) -> FloatArray:
        moved = beacons.copy()
        moved[:, :2] += by_beacon
        return problem.residuals(BatchState(poses + by_pose, shared, moved)).readings[:, 0].copy()

    rows = problem.residuals(BatchState(poses, shared, beacons)).by_unknowns[:, 0]
    for k in range(3):
        step = 1e-6 * np.eye(3)[k]
        numeric = (off(step, np.zeros(2)) - off(-step, np.zeros(2))) / 2e-6
        np.testing.assert_allclose(rows[:, k], numeric, atol=1e-7)
    for k in range(2):
        step = 1e-6 * np.eye(2)[k]
        numeric = (off(np.zeros(3), step) - off(np.zeros(3), -step)) / 2e-6
        np.testing.assert_allclose(rows[:, -BEACON + k], numeric, atol=1e-7)


def test_the_place_of_a_radio_turns_with_the_heading() -> None:
    pose, step = [1.0, 2.0, 0.7], 1e-6
    radio = RadioPose.at(pose, TAGS[0])
    later, sooner = (RadioPose.at([1.0, 2.0, 0.7 + sign * step], TAGS[0]).pose for sign in (1.0, -1.0))
    slope = [(a - b) / (2.0 * step) for a, b in zip(later[:2], sooner[:2], strict=True)]
    assert radio.by_heading == pytest.approx(slope, abs=1e-9)
    assert radio.turned(0.6, -0.8, 0.1) == pytest.approx((0.6, -0.8, 0.1 + 0.6 * slope[0] - 0.8 * slope[1]))


def resting(tags: tuple[Radio, ...]) -> RecordedRun:
    """A vehicle that stands among known beacons, with a first heading that is 0.4 rad off."""
    w = world(3, 40.0)
    still = replace(w, distance_m=np.zeros_like(w.distance_m), turn_rad=np.zeros_like(w.turn_rad))
    run = recorded(replace(still, poses=np.tile(w.poses[:1], (len(w.poses), 1))))
    run = by_radios(run, tags, 0.05, 3)
    names, count = tuple(BEACONS), 2 * len(BEACONS)
    known = KnownMap(names, np.array(list(BEACONS.values())), 1e-4 * np.eye(count), np.full(len(names), np.nan))
    x_m, y_m, heading_rad = run.first_pose
    return replace(run, known_map=known, first_pose=(x_m, y_m, heading_rad + 0.4))


@pytest.mark.parametrize("name", FILTERS)
def test_two_radios_show_the_heading_of_a_vehicle_that_stands_and_one_does_not(name: str) -> None:
    cfg = load_recordings_config(None, {"csv.radio.range_sigma_m": 0.05, "csv.priors.heading_rad": 0.5})
    off_rad, sigma_rad = 0.0, {}
    for tags in ((), TAGS):
        run = resting(tags)
        track = estimate(run, cfg, name)
        off_rad = abs(track.poses[-1, 2] - recorded(world(3, 40.0)).first_pose[2])
        sigma_rad[len(tags)] = float(np.sqrt(track.covariances[-1, 2, 2]))
    assert sigma_rad[2] < 0.05
    assert sigma_rad[0] > 0.3  # of 0.5
    assert off_rad < 4.0 * sigma_rad[2]


# The fixed lag shows the use of two radios above, and the smoother has the same equations.
@pytest.mark.parametrize("name", [slow_case(name) if name == "fixed-lag" else name for name in FILTERS])
def test_estimates_with_two_radios_are_consistent_and_no_worse_than_with_one(name: str) -> None:
    squares, errors_m = [], {0: list[float](), 2: list[float]()}
    for seed in range(2):
        for tags in ((), TAGS):
            run = driven(seed, tags)
            judged = judge(estimate(run, CFG, name), run)
            assert judged.nees is not None
            assert judged.trajectory_rmse_m is not None
            errors_m[len(tags)].append(judged.trajectory_rmse_m)
            if tags:
                squares.append(judged.nees.mean)
    assert 0.3 < float(np.mean(squares)) < 2.0
    assert float(np.mean(errors_m[2])) < 1.2 * float(np.mean(errors_m[0]))


def with_places(run: RecordedRun, tags: tuple[Radio, ...]) -> RecordedRun:
    r = run.readings
    assert r.tag is not None
    return replace(run, tags=tags, readings=r._replace(arm_m=np.array([one[1:] for one in tags])[r.tag]))


def test_wrong_places_of_radios_are_named_and_right_ones_are_not() -> None:
    run = driven(5, seconds=180.0)
    assert run.truth is not None
    poses = truth_at(run.truth, run.readings.times_s)

    def said(tags: tuple[Radio, ...]) -> str:
        return " | ".join(misplaced_radios(with_places(run, tags), poses, run.beacon_truth_m, "truth and survey"))

    assert said(TAGS) == ""
    (front, rear) = TAGS
    assert "tag rear is about 0.3 m behind and 0.2 m to the right" in said((front, rear._replace(ahead_m=0.0)))
    assert said((front, rear._replace(ahead_m=0.0))).count("tag ") == 1
    exchanged = said((front._replace(ahead_m=-0.3, left_m=-0.2), rear._replace(ahead_m=0.4, left_m=0.1)))
    assert "tag front" in exchanged
    assert "tag rear" in exchanged


@pytest.mark.parametrize(("late_s", "what"), [(0.6, "late"), (-0.6, "early")])
def test_ranges_that_are_late_are_not_only_taken_for_a_radio_that_is_behind(late_s: float, what: str) -> None:
    run = driven(5, seconds=180.0)
    assert run.truth is not None
    poses = truth_at(run.truth, run.readings.times_s + late_s)
    lines = list(misplaced_radios(with_places(run, TAGS), poses, run.beacon_truth_m, "truth and survey"))
    assert len(lines) == 2
    assert all(line.endswith(f"is its place given rightly, or are the ranges {what}?") for line in lines)


@pytest.mark.parametrize(("signs", "what"), [((1, -1), "left and right"), ((-1, 1), "ahead and behind")])
def test_places_of_radios_with_another_sign_are_named_without_a_truth(signs: tuple[int, int], what: str) -> None:
    tags = (Radio("a", 0.5, 0.3), Radio("b", -0.4, -0.4))
    run = replace(driven(6, tags, seconds=180.0), truth=None, beacon_truth_m={})
    assert "exchanged in the places" not in " | ".join(suspicions(run))
    mirrored = tuple(Radio(one.name, signs[0] * one.ahead_m, signs[1] * one.left_m) for one in tags)
    line = f"ranges fit the odometry far better if {what} are exchanged in the places of the tags"
    assert line in " | ".join(suspicions(with_places(run, mirrored)))


def test_the_errors_of_one_beacon_by_two_radios_are_two_errors() -> None:
    run = driven(7)
    heard = run.readings.heard(len(run.beacon_ids))
    assert len(np.unique(heard)) == 2 * len(run.beacon_ids)
    assert replace(run, readings=run.readings._replace(tag=None)).readings.heard(4).max() == 3
