"""The Cramér-Rao bound against what linear regression finds in simulated draws, and on a run of the real chain."""

import numpy as np
import pytest

from ccatp.config.load import load_config
from ccatp.config.models import Config
from ccatp.core import PanelId
from ccatp.mirror.mirror import build_mirror
from ccatp.studies import cramer_rao as cr
from ccatp.studies.cramer_rao import SeamPass, StopFix, TrueRecord, bounds_of, rehearse_recorded

HZ = 20.0
REST, DRIVE = 20, 40  # frames
LEG_M = 0.22
PANEL = PanelId(5, 5)
FIX_SIGMA_M = 1e-4
EDGE_SIGMA_M = 3e-4
TIMING_M = 2e-4  # of a sensor's place when it changes its value
DRAWS = 6000


def config(**world: object) -> Config:
    """A world with slip and a gyroscope; everything else off unless asked for."""
    values: dict[str, object] = {
        "slip_min": 0.02, "slip_max": 0.04, "slip_walk_sigma": 0.005, "slip_walk_time_s": 1.0,
        "gyroscope_sigma_rad_s": 0.002, "gyroscope_bias_sigma_rad_s": 0.01, "encoder_sigma_rad_s": 0.0,
        "panel_edge_sigma_m": EDGE_SIGMA_M, **world,
    }  # fmt: skip
    keys = {"run.mirror": "thesis-m1", "run.world": "thesis", "sim.robot.frame_hz": HZ, "sim.truth.tilt_sigma_rad": 0.0}
    return load_config(overrides={**keys, **{f"world.{key}": value for key, value in values.items()}})


def straight(cfg: Config, *, sensor_passes: bool = False) -> TrueRecord:
    """A rest with a fix at its end, a straight leg along the deck's x axis, a fix at its end."""
    rows = np.zeros((1 + REST + DRIVE, cr.WAY_COLUMNS))
    rows[:, cr.WAY_T] = np.arange(len(rows)) / HZ
    rows[:, cr.WAY_HX] = rows[:, cr.WAY_LY] = 1.0
    rows[:, cr.WAY_RIGHT_SCALE] = rows[:, cr.WAY_LEFT_SCALE] = 0.97
    drive = slice(1 + REST, None)
    rows[drive, cr.WAY_ORDERED] = 1.0
    turned = np.linspace(LEG_M / DRIVE, LEG_M, DRIVE) / (0.97 * cfg.robot.wheel_radius_m)
    rows[drive, cr.WAY_RIGHT] = rows[drive, cr.WAY_LEFT] = turned
    rows[drive, cr.WAY_X] = np.linspace(LEG_M / DRIVE, LEG_M, DRIVE)
    covariance = np.eye(2) * FIX_SIGMA_M**2
    fixes = tuple(StopFix(k, None, PANEL, covariance, (0.0, 0.0)) for k in (REST, REST + DRIVE))
    edge = (0, PANEL, True)
    # One on either side, so that their levers count.
    at = ((REST + DRIVE // 2, 0), (REST + DRIVE, 3))
    interval_s = TIMING_M * np.sqrt(12.0) / (HZ * LEG_M / DRIVE)
    passes = tuple(SeamPass(frame, corner, interval_s, 0, edge) for frame, corner in at) if sensor_passes else ()
    return TrueRecord(rows, passes, fixes, cfg.robot.wheel_base_m)


def walk(rng: np.random.Generator, sigma: float, time_s: float) -> np.ndarray:
    keep = np.exp(-1.0 / (HZ * time_s))
    values = np.empty((DRAWS, DRIVE))
    x = sigma * rng.standard_normal(DRAWS)
    for k in range(DRIVE):
        x = keep * x + sigma * np.sqrt(1.0 - keep * keep) * rng.standard_normal(DRAWS)
        values[:, k] = x
    return values


def drawn(cfg: Config, *, sensor_passes: bool) -> tuple[np.ndarray, np.ndarray]:
    """Final positions (draws, 2) and everything measured on the way (draws, m) of the same leg, all errors drawn."""
    rng, world, base_m = np.random.default_rng(5), cfg.world, cfg.robot.wheel_base_m
    x, y = world.start_position_sigma_m * rng.standard_normal((2, DRAWS))
    psi = world.start_heading_sigma_rad * rng.standard_normal(DRAWS)
    bias = world.gyroscope_bias_sigma_rad_s * rng.standard_normal(DRAWS)
    gyro = world.gyroscope_sigma_rad_s
    measured = [
        x + FIX_SIGMA_M * rng.standard_normal(DRAWS),
        y + FIX_SIGMA_M * rng.standard_normal(DRAWS),
        bias + gyro / np.sqrt(REST) * rng.standard_normal(DRAWS),
    ]
    slips = [
        rng.uniform(world.slip_min, world.slip_max, (DRAWS, 1))
        + walk(rng, world.slip_walk_sigma, world.slip_walk_time_s)
        for _ in range(2)
    ]
    wheel_m = LEG_M / DRIVE / 0.97
    edge_m = EDGE_SIGMA_M * rng.standard_normal(DRAWS)
    for k in range(DRIVE):
        right, left = ((1.0 - slip[:, k]) * wheel_m for slip in slips)
        turn = (right - left) / base_m
        x = x + 0.5 * (right + left) * np.cos(psi + 0.5 * turn)
        y = y + 0.5 * (right + left) * np.sin(psi + 0.5 * turn)
        psi = psi + turn
        measured.append(HZ * turn + bias + gyro * rng.standard_normal(DRAWS))
        for at, ahead in ((DRIVE // 2, 0.09), (DRIVE, -0.09)):
            if sensor_passes and k + 1 == at:
                timing_m = TIMING_M * rng.standard_normal(DRAWS)
                measured.append(x + ahead * np.cos(psi) - ahead * np.sin(psi) - edge_m + timing_m)
    return np.column_stack([x, y]), np.column_stack(measured)


def last_covariance(cfg: Config, *, sensor_passes: bool = False, with_accelerometer: bool = False) -> np.ndarray:
    """Bound of the covariance at the end of the leg, m^2."""
    record = straight(cfg, sensor_passes=sensor_passes)
    return bounds_of(cfg, build_mirror(cfg.mirror), record, with_accelerometer=with_accelerometer)[-1].covariance_m2


@pytest.mark.parametrize("sensor_passes", [False, True])
def test_it_is_what_the_best_linear_estimate_leaves(sensor_passes: bool) -> None:
    cfg = config()
    bound = last_covariance(cfg, sensor_passes=sensor_passes)
    wanted, measured = drawn(cfg, sensor_passes=sensor_passes)
    known = np.column_stack([np.ones(DRAWS), measured])
    rest = wanted - known @ np.linalg.lstsq(known, wanted, rcond=None)[0]  # after the best linear guess
    found = rest.T @ rest / (DRAWS - known.shape[1])
    # A variance out of 6000 draws is good to 1.8 %; the second order of the slip's difference adds as much.
    assert np.diag(bound) == pytest.approx(np.diag(found), rel=0.08)
    expected, correlation = (c[0, 1] / np.sqrt(c[0, 0] * c[1, 1]) for c in (found, bound))
    assert correlation == pytest.approx(expected, abs=0.05)  # 6000 draws: 0.013


def test_the_scatter_of_slip_is_the_floor_of_a_leg() -> None:
    cfg = config(slip_walk_sigma=0.0, start_position_sigma_m=0.0, start_heading_sigma_rad=0.0)
    expected_m = LEG_M / 0.97 * 0.02 / np.sqrt(12.0) / np.sqrt(2.0)
    assert np.sqrt(last_covariance(cfg)[0, 0]) == pytest.approx(expected_m, rel=1e-3)  # the model is linear along x


def test_an_estimator_does_not_beat_the_bound() -> None:
    keys = {"run.mirror": "thesis-m1", "run.world": "hard", "run.filter": "ekf", "run.panels": 1, "run.seed": 3}
    cfg = load_config(overrides=keys)
    found, record = rehearse_recorded(cfg)
    assert np.diff(record.way[:, cr.WAY_T]) == pytest.approx(0.01)
    assert len(record.fixes) == found.counts["fixes"]
    assert record.passes  # the base lies on another panel
    assert len({one.edge for one in record.passes}) < len(record.passes)  # four sensors cross the same edge
    bounds = bounds_of(cfg, build_mirror(cfg.mirror), record)[1:]  # until the second fix only the start errors count
    errors = np.array([stop.fix.error_m for stop in bounds])
    squares = [e @ np.linalg.solve(stop.covariance_m2, e) for e, stop in zip(errors, bounds, strict=True)]
    median_m = np.median([np.sqrt(np.trace(stop.covariance_m2)) for stop in bounds])
    assert 0.5e-3 < median_m < 3e-3  # the scatter of slip on legs of 0.22 and 0.245 m
    # In units of their own bound, over eight stops: a chi-square of 16 degrees falls below half its mean once in 200.
    assert np.sqrt(np.mean(squares) / 2.0) > 0.6
