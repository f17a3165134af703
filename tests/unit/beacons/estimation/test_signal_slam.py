"""EKF-SLAM by levels and bearings: derivatives against differences, consistency over seeds, what waits, what moves."""

from math import hypot, log

import numpy as np
import pytest
from scipy.stats import chi2

from ccatp.beacons.config.load import load_radio_config
from ccatp.beacons.config.models import RadioConfig
from ccatp.beacons.estimation.level_fix import LevelLocator, MeasuredPlace, grid_points, likeliest_names
from ccatp.beacons.estimation.motion import Increment, Odometry, SlippingVehicle, Steering
from ccatp.beacons.estimation.path_loss import LevelPair, PathLoss, PathLossError, PathLossFit, fit_path_loss
from ccatp.beacons.estimation.recording import Reading
from ccatp.beacons.estimation.signal_slam import MovingRadio, SignalSlam
from ccatp.beacons.filters.ekf_slam import EkfSlam
from ccatp.beacons.studies.radio_studies import run_radio

ODOMETRY: dict[str, Odometry] = {
    "ackermann": Steering(0.1, 0.1, 0.15, 0.3),
    "differential": Increment(0.1, 0.1, 0.015, 0.02),
}


def config(**keys: object) -> RadioConfig:
    return load_radio_config(None, {name.replace("__", "."): value for name, value in keys.items()})


def vehicle(kind: str, **keys: object) -> SlippingVehicle:
    noise: dict[str, object] = {
        "odometry__speed_sigma_m_s": 0.01, "odometry__steer_sigma_rad": 0.02, "odometry__turn_rate_sigma_rad_s": 0.02,
        "odometry__heading_drift_sigma_rad_s": 0.01, "odometry__slip_sigma": 0.05,
    }  # fmt: skip
    cfg = config(vehicle__kind=kind, vehicle__wheelbase_m=0.35, **(noise | keys))
    return SlippingVehicle(cfg.vehicle, cfg.odometry)


@pytest.mark.parametrize("kind", ["ackermann", "differential"])
def test_motion_has_the_derivatives_of_its_mean(kind: str) -> None:
    model = vehicle(kind)
    assert model.names == ("heading_drift_rad_s", "slip")
    x = np.array((1.0, 2.0, 0.7, 0.02, 0.06))
    F = model.step(x, ODOMETRY[kind]).F
    for k in range(5):
        step = np.eye(5)[k] * 1e-6
        slope = (model.step(x + step, ODOMETRY[kind]).mean - model.step(x - step, ODOMETRY[kind]).mean) / 2e-6
        assert F[:, k] == pytest.approx(slope, abs=1e-8)


@pytest.mark.parametrize("kind", ["ackermann", "differential"])
def test_motion_noise_is_that_of_its_readings(kind: str) -> None:
    model = vehicle(kind)
    x, rng = np.array((1.0, 2.0, 0.7, 0.02, 0.06)), np.random.default_rng(1)
    drawn = []
    for speed, turn in rng.standard_normal((4000, 2)).tolist():
        if kind == "ackermann":
            odometry: Odometry = Steering(0.1, 0.1, 0.15 + 0.01 * speed, 0.3 + 0.02 * turn)
        else:
            odometry = Increment(0.1, 0.1, 0.1 * (0.15 + 0.01 * speed), 0.1 * (0.2 + 0.02 * turn))
        drawn.append(model.step(x, odometry).mean[:3])
    Q = model.step(x, ODOMETRY[kind]).Q[:3, :3]
    assert np.sqrt(np.diag(Q)) == pytest.approx(np.std(drawn, axis=0), rel=0.06)


def test_a_vehicle_takes_the_odometry_of_its_kind() -> None:
    with pytest.raises(TypeError, match="takes speed and steering angle, not Increment"):
        vehicle("ackermann").step(np.zeros(5), ODOMETRY["differential"])
    with pytest.raises(TypeError, match="takes increments, not Steering"):
        vehicle("differential").step(np.zeros(5), ODOMETRY["ackermann"])
    assert SlippingVehicle(config().vehicle, config().odometry).names == ()


def moving() -> tuple[EkfSlam, MovingRadio]:
    engine = EkfSlam(np.array((1.0, 1.0, 0.5)), np.diag((0.01, 0.01, 0.001)))
    radio = MovingRadio("t", 0.02, 20.0, 5.0, 1.5, (3.0, 3.0))
    radio.join(engine, 0.2)
    return engine, radio


def test_many_levels_with_one_unknown_offset_do_not_tell_the_range() -> None:
    engine, radio = moving()
    loss = PathLoss(-33.0, 2.0, 2.0)
    rng = np.random.default_rng(4)
    for _ in range(300):
        level_dbm = loss.level_dbm(1.5) - 6.0 + 2.0 * rng.standard_normal()
        reading = Reading(0.0, "t", bearing_rad=0.2 + 0.3 * rng.standard_normal(), rssi_dbm=level_dbm)
        radio.update(engine, reading, loss, (4.0, 0.32**2), (9e9, 9e9))
    place = engine.block("t")
    offset = engine.mean[place][:2] - engine.mean[:2]
    r = float(np.hypot(*offset))
    along = offset / r
    sigma = float(np.sqrt(along @ engine.covariance[place, place][:2, :2] @ along)) / r
    # prior of ln r (ln 2) and 5 dB of shadowing (0.576): together 0.443; three hundred levels add nothing to that
    assert sigma == pytest.approx(1.0 / np.hypot(1.0 / log(2.0), 1.0 / 0.576), rel=0.05)


def received(slam_cfg: RadioConfig, scans: int) -> tuple[SignalSlam, float]:
    """Of a radio in the middle of the room, far from walls; and the error of its place."""
    slam = SignalSlam(slam_cfg)
    loss = slam.path_loss_of("b")
    for k in range(scans):
        for _ in range(10):
            slam.predict(Steering(0.0, 0.1, 0.15, 0.0))
        pose = slam.engine.mean[:3].tolist()
        level = loss.level_dbm(hypot(1.5 - pose[0], 1.5 - pose[1]))
        bearing_rad = np.arctan2(1.5 - pose[1], 1.5 - pose[0]) - pose[2]
        slam.observe([Reading(k, "b", bearing_rad=bearing_rad, rssi_dbm=level)])
    estimate = slam.beacons["b"]
    return slam, float(np.hypot(*(estimate.mean - 1.5)))


def test_a_new_radio_waits_and_is_on_the_map_all_the_same() -> None:
    slam, error_m = received(config(), 1)
    assert "b" not in slam.engine
    assert error_m < 0.01
    slam, error_m = received(config(estimator__waiting_scans=4), 5)
    assert "b" in slam.engine
    assert error_m < 0.02
    assert not [b for b in slam.engine.blocks if not isinstance(b, str)]


@pytest.mark.parametrize("beyond_m", [0.0, 1.0])
def test_a_radio_in_the_shadow_is_looked_for_in_the_room(beyond_m: float) -> None:
    keys: dict[str, object] = {"path_loss__shadowing_sigma_db": 5.0, "estimator__shadowing": "map"}
    slam = SignalSlam(config(**keys, estimator__radios_beyond_m=beyond_m))
    level = slam.path_loss_of("b").level_dbm(12.0)
    slam.observe([Reading(0.0, "b", bearing_rad=np.pi / 4.0 - slam.pose.heading_rad, rssi_dbm=level)])
    estimate = slam.beacons["b"]
    assert estimate.mean.max() == pytest.approx(3.0 + beyond_m, abs=0.3)  # 12 m away by the level alone
    assert np.linalg.eigvalsh(estimate.covariance).max() < 0.1**2
    assert "b" not in slam.engine  # it is sure by the walls, which one reading cannot confirm


SHADOW = {"sim.radio.shadowing_sigma_db": 5.0, "path_loss.shadowing_sigma_db": 5.0, "estimator.shadowing": "map"}


def test_white_noise_runs_are_consistent() -> None:
    runs = [run_radio(load_radio_config(None, {"run.seed": seed, "run.steps": 450})) for seed in range(1, 7)]
    nees, states = (sum(run.joint_nees[k] for run in runs) for k in (0, 1))
    low, high = (float(chi2.ppf(share, states)) for share in (0.001, 0.999))
    assert low < nees < high
    rows = sum(size for run in runs for _, size in run.nis)
    assert sum(nis for run in runs for nis, _ in run.nis) / rows == pytest.approx(1.0, abs=3.5 * (2.0 / rows) ** 0.5)


def test_ignored_shadowing_is_overconfident_and_mapped_shadowing_is_not() -> None:
    hits = {}
    for mode in ("none", "map"):
        keys = {**SHADOW, "estimator.shadowing": mode, "run.steps": 450}
        runs = [run_radio(load_radio_config(None, {**keys, "run.seed": seed})) for seed in (1, 2)]
        hits[mode] = np.mean([run.beacon_nees[name][-1] < 4.605 for run in runs for name in run.places])
    assert hits["none"] <= 0.5
    assert hits["map"] > 0.7


BEACONS = {"A": (0.0, 0.0), "B": (0.0, 4.0), "C": (4.0, 0.0)}
ROOM = grid_points((0.0, 0.0), (4.0, 4.0), 0.1)
Levels = dict[str, float]


def scene(seed: int, sigma_db: float, points: int) -> tuple[LevelLocator, list[MeasuredPlace]]:
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
    drawn = (draw() for _ in range(points))
    received = [MeasuredPlace(place, {name: level(place, name) for name in BEACONS}) for place in drawn]
    return LevelLocator(BEACONS, fits, ROOM), received


def test_ninety_per_cent_regions_hold_ninety_per_cent() -> None:
    locator, received = scene(2, 5.0, 300)
    inside = np.mean([locator.fix(levels).holds(place, 0.9) for place, levels in received])
    assert inside == pytest.approx(0.9, abs=0.06)  # 3.5 sigma of 300 points


def test_a_beacon_that_is_not_received_is_not_used() -> None:
    locator, received = scene(3, 1.0, 1)
    levels = received[0][1]
    fewer = locator.fix({"A": levels["A"]})
    assert fewer.region(0.9).sum() > locator.fix(levels).region(0.9).sum()
    with pytest.raises(ValueError, match="none of the beacons A, B, C was received"):
        locator.fix({"D": -50.0})


def test_exchanged_names_are_found() -> None:
    locator, received = scene(4, 5.0, 12)
    assert likeliest_names(locator, received) == ({"A": "A", "B": "B", "C": "C"}, 0.0)
    exchanged = [one.renamed({"B": "C", "C": "B"}) for one in received]
    names, gain = likeliest_names(locator, exchanged)
    assert names == {"A": "A", "B": "C", "C": "B"}
    assert gain > 7.0


def test_printed_ranges_of_2017_come_out() -> None:
    model = PathLoss(-33.0, 2.0, 2.0)
    printed = [(-23.0, 0.3162), (-33.103, 1.0119), (-38.308, 1.8425), (-41.974, 2.81)]
    for level_dbm, range_m in printed:
        assert model.median_range_m(level_dbm) == pytest.approx(range_m, abs=6e-4)


def test_a_distance_of_nought_has_no_level() -> None:
    model = PathLoss(-40.0, 2.0, 5.0)
    with pytest.raises(ValueError, match="must be positive"):
        model.level_dbm(0.0)


def drawn(seed: int, places: int, repeats: int, static_db: float, white_db: float) -> list[LevelPair]:
    rng = np.random.default_rng(seed)
    found = []
    for distance_m in np.geomspace(0.3, 6.0, places).tolist():
        level = -45.0 - 25.0 * np.log10(distance_m) + static_db * rng.standard_normal()
        found += [LevelPair(distance_m, level + white_db * rng.standard_normal()) for _ in range(repeats)]
    return found


def test_confidence_intervals_hold_what_they_promise() -> None:
    inside = np.zeros(3)
    for seed in range(300):
        fit = fit_path_loss(drawn(seed, 8, 1, 4.0, 0.0))
        reference, exponent = fit.half_widths(0.9)
        low, high = fit.sigma_interval_db(0.9)
        inside += abs(fit.reference_dbm + 45.0) < reference, abs(fit.exponent - 2.5) < exponent, low < 4.0 < high
    assert inside / 300 == pytest.approx(0.9, abs=0.055)  # 3.2 sigma of 300 trials


def test_repeated_readings_tell_white_from_static() -> None:
    fit = fit_path_loss(drawn(3, 40, 30, 4.0, 1.5))
    assert fit.white_sigma_db == pytest.approx(1.5, rel=0.05)
    assert fit.shadowing_sigma_db == pytest.approx(4.0, rel=0.3)
    once = fit_path_loss(drawn(3, 40, 1, 4.0, 1.5))
    assert fit.sigma_db == pytest.approx(once.sigma_db, rel=0.3)  # thirty readings of a place are one witness


def test_doubts_are_reported() -> None:
    good = drawn(1, 12, 1, 0.5, 0.0)
    assert fit_path_loss(good).doubts() == []
    off = [*good[:-1], LevelPair(good[-1].distance_m, good[-1].level_dbm + 20.0)]
    flat = [LevelPair(d, -60.0 - 0.5 * d) for d in (1.0, 2.0, 3.0, 4.0)]
    far = [LevelPair(100.0 * pair.distance_m, pair.level_dbm) for pair in good]
    line = [LevelPair(r, -40.0 - 20.0 * np.log10(r)) for r in (1.0, 2.0, 4.0, 8.0)]
    reported = ("off the line", "is outside 1 to 6", "is above -10 dBm", "on a line exactly")
    for pairs, what in zip((off, flat, far, line), reported, strict=True):
        assert any(what in doubt for doubt in fit_path_loss(pairs).doubts())


@pytest.mark.parametrize(
    ("pairs", "message"),
    [
        ([(1.0, -40.0), (2.0, -46.0), (2.0, -47.0)], "2 different distances, at least 3 needed"),
        ([(1.0, -40.0), (0.0, -46.0), (2.0, -47.0)], "pair of 0 m and -46 dBm cannot be used"),
        ([(1.0, -40.0), (3.0, float("nan")), (2.0, -47.0)], "cannot be used"),
        ([(1.0, -60.0), (2.0, -60.0), (3.0, -60.0)], "levels do not fall with distance"),
    ],
)
def test_pairs_without_a_path_loss_are_refused(pairs: list[tuple[float, float]], message: str) -> None:
    with pytest.raises(PathLossError, match=message):
        fit_path_loss(LevelPair(*pair) for pair in pairs)
