"""Whether gravity agrees with the slope of the configured mirror."""

import numpy as np
import pytest

from ccatp.config.load import load_config
from ccatp.core import DeckPose
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.survey.reactions import PATIENCE_S, READINGS, MirrorCheck

MIRRORS = ("fyst-m1", "fyst-m2", "thesis-m1", "thesis-m2")
SIGMA_RAD = 0.035  # of a reading, as shipped
SEEDS = 40


def mirror_of(name: str) -> Mirror:
    return build_mirror(load_config(overrides={"run.mirror": name}).mirror)


def noisy(direction: np.ndarray, rng: np.random.Generator) -> tuple[float, float, float, float]:
    found = direction + SIGMA_RAD * rng.normal(size=3)
    x, y, z = found / np.linalg.norm(found)
    return 0.0, float(x), float(y), float(z)


def tilted(mirror: Mirror, pose: DeckPose, by_deg: float, heading: float) -> np.ndarray:
    """Gravity in the robot frame on a surface whose slope differs by so much, the robot turned anyhow."""
    gx, gy, gz = mirror.gravity_in_robot(pose)
    slope = np.arctan2(np.hypot(gx, gy), -gz) + np.radians(by_deg)
    return np.array([np.sin(slope) * np.cos(heading), np.sin(slope) * np.sin(heading), -np.cos(slope)])


def check(mirror: Mirror, direction: np.ndarray, seed: int) -> MirrorCheck:
    """Frames of 100 Hz, a reading in every fifth, until it is known."""
    rng = np.random.default_rng(seed)
    found = MirrorCheck(mirror)
    for k in range(1000):
        if found.hear(0.01 * k, None if k % 5 else noisy(direction, rng), mirror.base_pose):
            assert k == 5 * (READINGS - 1)
            return found
    raise AssertionError("it never came to an end")


@pytest.mark.fault("P21")
def test_no_other_mirror_passes(measured: object) -> None:
    """Every mirror of the telescope taken for every other one whose slope at the base differs by more than 5 deg."""
    begun = 0
    mirrors = [mirror_of(name) for name in MIRRORS]
    for configured in mirrors:
        for real in mirrors:
            direction = np.array(real.gravity_in_robot(real.base_pose))
            is_same = configured.overhang == real.overhang
            for seed in range(SEEDS):
                contradiction = check(configured, direction, seed).contradiction
                assert is_same == (not contradiction), (configured.name, real.name, contradiction)
                begun += not is_same and not contradiction
    assert callable(measured)
    measured("P21", begun)


@pytest.mark.fault("P21")
@pytest.mark.parametrize("name", MIRRORS)
def test_a_slope_that_differs_by_more_than_5_deg_never_passes(name: str) -> None:
    mirror = mirror_of(name)
    for by_deg in (-60, -20, -10, -7, -5.5, -5, 5, 5.5, 7, 10, 20, 60):
        for seed in range(SEEDS):
            direction = tilted(mirror, mirror.base_pose, by_deg, 0.4 * seed)
            assert "is this the right mirror" in check(mirror, direction, seed).contradiction, by_deg
    for by_deg in (-1.5, 0.0, 1.5):
        for seed in range(SEEDS):
            assert not check(mirror, tilted(mirror, mirror.base_pose, by_deg, 0.4 * seed), seed).contradiction, by_deg


def test_a_few_readings_of_garbage_do_no_harm() -> None:
    mirror = mirror_of("fyst-m1")
    found = MirrorCheck(mirror)
    good = (0.0, *mirror.gravity_in_robot(mirror.base_pose))
    for k in range(READINGS):
        is_over = found.hear(0.05 * k, (0.0, 0.0, 0.0, 1.0) if k % 3 == 0 else good, mirror.base_pose)
    assert is_over
    assert not found.contradiction


def test_a_robot_without_the_sensor_is_waited_for_and_told() -> None:
    found = MirrorCheck(mirror_of("fyst-m1"))
    pose = mirror_of("fyst-m1").base_pose
    assert not found.hear(10.0, None, pose)
    assert not found.hear(10.0 + 0.99 * PATIENCE_S, None, pose)
    assert found.hear(10.0 + PATIENCE_S, None, pose)
    assert "tells no gravity" in found.warning
    assert not found.contradiction


def test_a_slow_sensor_is_judged_by_what_has_come() -> None:
    found = MirrorCheck(mirror_of("fyst-m1"))
    pose = mirror_of("fyst-m1").base_pose
    found.hear(0.0, (0.0, *mirror_of("fyst-m2").gravity_in_robot(pose)), pose)
    assert found.hear(PATIENCE_S, None, pose)
    assert "104" in found.contradiction or "deg" in found.contradiction
