"""A run made of frames by hand, through the localizers."""

from collections.abc import Iterator
from math import cos, sin

import numpy as np
import pytest

from ccatp.config.load import load_config
from ccatp.config.models import Config
from ccatp.core import DeckPose, EdgeSample, Fix, GravitySample, ImuSample, WheelSample
from ccatp.links.robot_messages import CommandEcho, Sensors
from ccatp.localizer import build_localizer
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.records.run_reader import Event, Fixed, Marked
from ccatp.studies.replay import has_smoother, replay

FRAME_S = 0.01
STILL_FRAMES = 60  # longer than a rest takes to be seen
RATE_RAD_S = 1.0  # of both wheels: 30 mm/s
FIX_SIGMA_M = 1e-5


def config_for(name: str) -> Config:
    return load_config(None, {"run.filter": name})


@pytest.fixture(scope="module")
def mirror() -> Mirror:
    return build_mirror(load_config().mirror)


def frame(number: int, rate_rad_s: float, *, at_rest: bool = False) -> Marked:
    t_s = number * FRAME_S
    imu = [ImuSample(t_s, 0.0, 0.0)]
    encoders = [WheelSample(t_s - 0.001 * k, rate_rad_s, rate_rad_s) for k in range(9, -1, -1)]
    edges = [EdgeSample(t_s, 1, 1, 1, 1)]
    echo = CommandEcho(seq=-1, age=0.0, permit_age=0.0, held=False)
    gravity: GravitySample | None = None
    return Marked(Sensors(number, t_s, imu, encoders, edges, gravity, (0.0, 0.0), 1.0, echo, []), at_rest)


def fix_at(mirror: Mirror, cfg: Config, place: tuple[float, float], t_s: float) -> Fix:
    puck = mirror.puck_world(DeckPose(*place, 0.0), cfg.robot.puck_height_m)
    return Fix(t_s, puck, tuple((FIX_SIGMA_M**2 * np.eye(3)).ravel().tolist()), 1.0, (1, 2, 3, 4), 0.0)


def beside_base(mirror: Mirror, dx_m: float, dy_m: float) -> tuple[float, float]:
    return mirror.base_pose.x_m + dx_m, mirror.base_pose.y_m + dy_m


def standing(mirror: Mirror, cfg: Config, *, was_fused: bool = True) -> Iterator[Event]:
    """A robot that stands 3 mm and 1 mm beside base, as a fix shows."""
    for n in range(1, 101):
        yield frame(n, 0.0)
    yield Fixed(fix_at(mirror, cfg, beside_base(mirror, 3e-3, -1e-3), 1.0), was_fused)
    for n in range(101, 151):
        yield frame(n, 0.0)


@pytest.mark.parametrize("name", ["ekf", "ukf"])
def test_the_smoother_knows_from_the_first_frame_on_what_the_fix_showed(name: str, mirror: Mirror) -> None:
    cfg = config_for(name)
    found = replay(cfg, mirror, standing(mirror, cfg), smooth=True)
    assert found.smoothed is not None
    wanted = np.tile(beside_base(mirror, 3e-3, -1e-3), (150, 1))
    np.testing.assert_allclose(found.feet[0], (100, *wanted[0]), rtol=0.0, atol=1e-9)  # Newton's rest
    before, after = found.trace.pose[:100, :2], found.smoothed.pose[:, :2]
    assert np.linalg.norm(before - wanted[:100], axis=1).min() > 3e-3
    # 0.1 mm: a start known to 2 mm and a fix known to 10 um, from a robot of which nobody says at first that it stands.
    np.testing.assert_allclose(after, wanted, atol=1e-4)
    assert found.smoothed.covariance is not None
    assert np.sqrt(found.smoothed.covariance[0, 0, 0]) < 1e-4
    np.testing.assert_array_equal(found.smoothed.seq, found.trace.seq)


def driving(mirror: Mirror, cfg: Config, *, late_frames: int) -> Iterator[Event]:
    """A robot that starts 1 mm to the left of base and drives 0.06 m; a fix of frame 160 is handed over later."""
    base = mirror.base_pose
    for n in range(1, STILL_FRAMES + 1):
        yield frame(n, 0.0)
    for n in range(STILL_FRAMES + 1, 261):
        yield frame(n, RATE_RAD_S, at_rest=n == 200)  # wrongly: what a localizer makes of that shows
        if n == 160 + late_frames:
            way_m = 0.001 * 1000 * FRAME_S * 100 * RATE_RAD_S * cfg.robot.wheel_radius_m
            c, s = cos(base.heading_rad), sin(base.heading_rad)
            place = base.x_m + way_m * c - 1e-3 * s, base.y_m + way_m * s + 1e-3 * c
            yield Fixed(fix_at(mirror, cfg, place, 160 * FRAME_S), True)


@pytest.mark.parametrize("name", ["kf", "ekf", "ukf"])
def test_a_replay_is_what_the_localizer_does(name: str, mirror: Mirror) -> None:
    cfg = config_for(name)
    localizer, wanted = build_localizer(cfg, mirror), []
    for event in driving(mirror, cfg, late_frames=20):
        if isinstance(event, Fixed):
            localizer.fuse_fix(event.fix)
        else:
            s = event.sensors
            localizer.step(s.t, s.imu, s.enc, s.edge, s.gravity)
            if event.at_rest:
                localizer.rest()
            wanted.append(mirror.deck_pose(localizer.pose))
    found = replay(cfg, mirror, driving(mirror, cfg, late_frames=20))
    assert found.trace.seq.tolist() == list(range(1, 261))
    assert found.trace.t_s[-1] == 2.6
    # 1e-12 m: the trace goes by way of many poses at once, which drops a point on the surface by other arithmetic.
    np.testing.assert_allclose(found.trace.pose, [(p.x_m, p.y_m, p.heading_rad) for p in wanted], rtol=0.0, atol=1e-12)
    assert found.trace.covariance is not None
    np.testing.assert_allclose(found.trace.covariance[-1], localizer.pose_covariance)
    assert (found.fixes, found.refused, found.first_difference) == (1, 0, None)
    assert found.counts["fixes"] == 1
    assert found.feet[:, 0].tolist() == [180]


@pytest.mark.parametrize("name", ["ekf", "ukf"])
def test_a_late_fix_is_smoothed_as_if_it_had_come_in_time(name: str, mirror: Mirror) -> None:
    cfg = config_for(name)
    in_time, late = (replay(cfg, mirror, driving(mirror, cfg, late_frames=n), smooth=True).smoothed for n in (0, 60))
    assert in_time is not None
    assert late is not None
    # 50 um: the filters are linearised where they are, which a fix of 1 mm changes; a record of what was done twice
    # would be beside it by the whole millimetre.
    np.testing.assert_allclose(late.pose[:, :2], in_time.pose[:, :2], atol=5e-5)
    aside = in_time.pose[STILL_FRAMES, :2] - replay(cfg, mirror, driving(mirror, cfg, late_frames=0)).trace.pose[0, :2]
    assert np.linalg.norm(aside) > 5e-4  # the fix is seen from the beginning


def test_it_tells_which_wheels_turned(mirror: Mirror) -> None:
    cfg = config_for("ekf")
    found = replay(cfg, mirror, driving(mirror, cfg, late_frames=0))
    assert found.moving.tolist() == list(range(STILL_FRAMES + 1, 261))


def test_a_fix_that_the_run_refused_and_the_replay_takes(mirror: Mirror) -> None:
    cfg = config_for("ekf")
    found = replay(cfg, mirror, standing(mirror, cfg, was_fused=False))
    assert (found.refused, found.first_difference) == (0, (1.0, ""))
    assert not found.feet.size  # it showed the place of nothing


@pytest.mark.parametrize("name", ["kf", "ekf", "ukf"])
def test_a_fix_that_was_set_aside_is_kept_from_the_localizer(name: str, mirror: Mirror) -> None:
    cfg = config_for(name)
    events = list(standing(mirror, cfg, was_fused=False))
    aside = [Fixed(e.fix, was_fused=False, was_set_aside=True) if isinstance(e, Fixed) else e for e in events]
    found = replay(cfg, mirror, aside)
    without = replay(cfg, mirror, [e for e in events if not isinstance(e, Fixed)])
    assert (found.fixes, found.set_aside, found.refused, found.first_difference) == (1, 1, 0, None)
    np.testing.assert_array_equal(found.trace.pose, without.trace.pose)
    assert np.abs(found.trace.pose - replay(cfg, mirror, events).trace.pose).max() > 1e-4


def test_a_fix_that_the_run_took_and_the_replay_refuses(mirror: Mirror) -> None:
    cfg = load_config(None, {"run.filter": "ekf", "localizer.full_state.fix_gate_nis": 1e-3})
    found = replay(cfg, mirror, standing(mirror, cfg))
    assert found.refused == 1
    assert found.first_difference is not None
    assert found.first_difference[0] == 1.0
    assert "mm from the estimate" in found.first_difference[1]


def test_progress_is_told_frame_by_frame(mirror: Mirror) -> None:
    told: list[float] = []
    cfg = config_for("kf")
    replay(cfg, mirror, standing(mirror, cfg), on_frame=told.append)
    assert told == [n * FRAME_S for n in range(1, 151)]


def test_four_states_cannot_be_smoothed(mirror: Mirror) -> None:
    assert [has_smoother(config_for(name)) for name in ("kf", "ekf", "ukf")] == [False, True, True]
    with pytest.raises(ValueError, match="no smoother for filter kf"):
        replay(config_for("kf"), mirror, [], smooth=True)


def test_no_frames_at_all(mirror: Mirror) -> None:
    found = replay(config_for("ekf"), mirror, [], smooth=True)
    assert found.smoothed is not None
    assert not len(found.trace.seq)
    assert not len(found.smoothed.seq)
