"""A run made of frames by hand, through the localizers."""

from collections.abc import Callable, Iterator, Sequence
from math import cos, sin

import numpy as np
import pytest

from ccatp.config.load import load_config
from ccatp.config.models import Config
from ccatp.core import DeckPose, EdgeSample, Fix, FloatArray, GravitySample, ImuSample, WheelSample
from ccatp.filters import FILTERS, Smoother
from ccatp.links.robot_messages import CommandEcho, Sensors
from ccatp.links.topics import FixMessage, Rest
from ccatp.localizer import build_localizer
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.records.run_reader import Event, Fixed, Marked, Message, in_order
from ccatp.studies import replay as recording_filter
from ccatp.studies.replay import RecordingFilter, added_noise, has_smoother, replay, transition_of_reset

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
    # 0.1 mm: a start known to 2 mm and a fix known to 10 um, from a robot that is not yet known to stand.
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
    times_s: list[float] = []
    found = replay(cfg, mirror, driving(mirror, cfg, late_frames=20), on_frame=times_s.append)
    assert times_s == [n * FRAME_S for n in range(1, 261)]
    assert found.moving.tolist() == list(range(STILL_FRAMES + 1, 261))
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


def test_four_states_cannot_be_smoothed(mirror: Mirror) -> None:
    assert [has_smoother(config_for(name)) for name in ("kf", "ekf", "ukf")] == [False, True, True]
    with pytest.raises(ValueError, match="no smoother for filter kf"):
        replay(config_for("kf"), mirror, [], smooth=True)


def test_no_frames_at_all(mirror: Mirror) -> None:
    found = replay(config_for("ekf"), mirror, [], smooth=True)
    assert found.smoothed is not None
    assert not len(found.trace.seq)
    assert not len(found.smoothed.seq)


def events_frame(seq: int) -> Sensors:
    echo = CommandEcho(seq=-1, age=0.0, permit_age=0.0, held=False)
    return Sensors(seq, 0.01 * seq, [], [], [], None, (0.0, 0.0), 1.0, echo, [])


def given(seq: int, t_s: float, is_fused: bool) -> FixMessage:
    return FixMessage(
        seq=seq, t_s=t_s, point=None, is_fused=is_fused, position_m=(1.0, 2.0, 3.0), covariance_m2=[0.5] * 9, dop=1.25,
        residual_rms_m=1e-6, channels=[1, 4], jump_mm=0.0,
    )  # fmt: skip


def stood(seq: int) -> Rest:
    return Rest(seq=seq, t_s=0.0)


def names_of(messages: Sequence[Message]) -> list[str]:
    def name(event: Event) -> str:
        if isinstance(event, Marked):
            return f"{event.sensors.seq}{' rests' if event.at_rest else ''}"
        return f"fix {event.fix.t_s:g}{'' if event.was_fused else ' refused'}"

    return [name(event) for event in in_order(messages)]


FRAMES = [events_frame(seq) for seq in range(4)]
GIVEN = given(1, 7.0, True)


@pytest.mark.parametrize(
    ("messages", "wanted"),
    [
        pytest.param([GIVEN, *FRAMES], ["0", "1", "fix 7", "2", "3"], id="before the batch of its frame"),
        pytest.param([*FRAMES[:2], GIVEN, *FRAMES[2:]], ["0", "1", "fix 7", "2", "3"], id="between two batches"),
        pytest.param([stood(1), GIVEN, *FRAMES[:3]], ["0", "1 rests", "fix 7", "2"], id="a rest before the fix"),
        pytest.param(
            [given(0, 1.0, False), given(0, 2.0, True), *FRAMES[:2]],
            ["0", "fix 1 refused", "fix 2", "1"],
            id="fixes keep their order",
        ),
        pytest.param(
            [*FRAMES[:2], given(1, 1.0, True), given(2, 2.0, True), stood(2)],
            ["0", "1", "fix 1"],
            id="at the end only what belongs to a frame that is there",
        ),
        pytest.param(
            [events_frame(0), given(3, 1.0, True), events_frame(7)],
            ["0", "fix 1", "7"],
            id="before the next frame where frames are missing",
        ),
    ],
)
def test_a_fix_comes_behind_its_frame(messages: Sequence[Message], wanted: list[str]) -> None:
    assert names_of(messages) == wanted


def test_a_recorded_fix_is_the_fix_again() -> None:
    message = given(5, 1.5, False)
    fix = Fix(1.5, (1.0, 2.0, 3.0), (0.5,) * 9, 1.25, (1, 4), 1e-6)
    assert list(in_order([events_frame(5), message]))[1] == Fixed(fix, False)
    message.is_set_aside = True
    assert list(in_order([events_frame(5), message]))[1] == Fixed(fix, False, was_set_aside=True)


N = 4
F = np.eye(N) + np.diag([0.5, 0.2, 0.1], 1)
Q = np.diag([0.3, 0.0, 0.2, 0.1])  # one state without noise
H = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
R = np.array([0.5, 0.25])
READINGS = np.random.default_rng(3).normal(size=(12, 2))


def assert_same(found: FloatArray, wanted: object) -> None:
    # 1e-9: twelve steps back through covariances with a condition number of some 1e3, states of order 1.
    np.testing.assert_allclose(found, np.asarray(wanted, dtype=np.float64), rtol=0.0, atol=1e-9)


def started(name: str) -> RecordingFilter:
    filter_ = RecordingFilter(FILTERS[name](np.zeros(N), np.eye(N)))
    filter_.reset(np.ones(N), 2.0 * np.eye(N))
    return filter_


def drive(filter_: RecordingFilter, readings: FloatArray) -> None:
    for z in readings:
        filter_.predict(F, Q)
        filter_.update(z, H, R)


def by_hand(name: str) -> tuple[FloatArray, FloatArray]:
    filter_, smoother = FILTERS[name](np.ones(N), 2.0 * np.eye(N)), Smoother(N)
    for z in READINGS:
        smoother.predict(filter_, F, Q)
        filter_.update(z, H, R)
    found = smoother.smooth(filter_)
    return found.means[:, :3], found.covariances[:, :3, :3]


@pytest.fixture(params=[(2000, 4096), (0, 4096), (3, 5)], ids=["all pending", "none pending", "chapters"])
def sizes(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    reach, chapter = request.param
    monkeypatch.setattr(recording_filter, "REACH", reach)
    monkeypatch.setattr(recording_filter, "CHAPTER", chapter)


@pytest.mark.usefixtures("sizes")
@pytest.mark.parametrize("name", sorted(FILTERS))
def test_it_filters_as_the_filter_in_it_and_smooths_as_the_smoother(name: str) -> None:
    filter_, alone = started(name), FILTERS[name](np.ones(N), 2.0 * np.eye(N))
    for z in READINGS:
        filter_.predict(F, Q)
        alone.predict(F, Q)
        assert filter_.update(z, H, R).nis == pytest.approx(alone.update(z, H, R).nis, rel=1e-12)  # rounding
        assert_same(filter_.mean, alone.mean)
        assert_same(filter_.covariance, alone.covariance)
    assert filter_.count == len(READINGS)
    means, covariances = by_hand(name)
    found = filter_.smooth()
    assert_same(found.means, means)
    assert_same(found.covariances, covariances)


def test_what_was_taken_back_is_removed() -> None:
    filter_ = started("ekf")
    drive(filter_, READINGS[:5])
    filter_.reset(filter_.mean, filter_.covariance)  # to the present state changes nothing
    kept = filter_.mean, filter_.covariance
    drive(filter_, READINGS[:4] + 3.0)  # not what was read, as it turns out
    filter_.reset(*kept)
    assert filter_.count == 5
    drive(filter_, READINGS[5:6])
    # A late reading between prediction and update: the late one first, then the others again.
    filter_.predict(F, Q)
    kept = filter_.mean, filter_.covariance
    drive(filter_, READINGS[7:9])
    filter_.reset(*kept)
    filter_.update(READINGS[6], H, R)
    drive(filter_, READINGS[7:])
    means, covariances = by_hand("ekf")
    found = filter_.smooth()
    assert_same(found.means, means)
    assert_same(found.covariances, covariances)


@pytest.mark.parametrize("name", ["ekf", "ukf"])
def test_a_shift_of_the_state_shifts_what_is_smoothed(name: str) -> None:
    # The model is linear: from the shift on, everything is as before plus what becomes of the shift.
    shift, filter_ = np.array([10.0, 0.0, -7.0, 1.0]), started(name)
    drive(filter_, READINGS[:6])
    filter_.reset(filter_.mean + shift, filter_.covariance)
    for z in READINGS[6:]:
        shift = F.dot(shift)
        filter_.predict(F, Q)
        filter_.update(z + H.dot(shift), H, R)
    means, _ = by_hand(name)
    found = filter_.smooth().means
    assert len(found) == len(means) + 1  # the shift is a transition
    assert_same(found[:7], means[:7])
    assert_same(found[7], means[6] + [10.0, 0.0, -7.0])


def test_nothing_is_known_across_a_state_drawn_anew() -> None:
    filter_ = started("ekf")
    drive(filter_, READINGS[:6])
    before = filter_.mean[:3].copy(), filter_.covariance[:3, :3].copy()
    filter_.reset(np.zeros(N), 9.0 * np.eye(N))
    drive(filter_, READINGS[6:])
    found = filter_.smooth()
    assert_same(found.means[6], before[0])
    assert_same(found.covariances[6], before[1])


def some_covariance() -> FloatArray:
    root = np.random.default_rng(1).normal(size=(N, N))
    return np.asarray(root @ root.T + np.eye(N))


def redrawn(P: FloatArray) -> FloatArray:
    after = P.copy()
    after[1, :] = after[:, 1] = 0.0
    after[1, 1] = 7.0
    return after


def asymmetric_in_the_last_bit(P: FloatArray) -> FloatArray:
    after = P.copy()
    after[0, 1] = np.nextafter(after[0, 1], np.inf)
    return after


@pytest.mark.parametrize(
    ("change", "diagonal_of_F", "variance"),
    [
        (np.copy, [1, 1, 1, 1], 0.0),
        (asymmetric_in_the_last_bit, [1, 1, 1, 1], 0.0),
        (redrawn, [1, 0, 1, 1], 7.0),
        (lambda P: 0.5 * P, [0, 0, 0, 0], None),
        (lambda P: P + np.diag([1.0, 0.0, 0.0, 0.0]), [0, 0, 0, 0], None),
    ],
)
def test_what_a_reset_was(
    change: Callable[[FloatArray], FloatArray], diagonal_of_F: list[int], variance: float | None
) -> None:
    P = some_covariance()
    after = change(P)
    transition, noise = transition_of_reset(P, after)
    np.testing.assert_array_equal(transition, np.diag(diagonal_of_F))
    # 1e-12: P is of order 10, and what was redrawn is exactly what stands there.
    np.testing.assert_allclose(transition @ P @ transition.T + noise, after, atol=1e-12)
    if variance is not None:
        assert noise[1, 1] == variance


def test_noise_is_what_was_given_unless_the_prediction_added_more() -> None:
    P = some_covariance()
    predicted = F @ P @ F.T + Q
    assert added_noise(P, F, predicted, Q) is Q
    more = np.diag([0.0, 0.0, 0.0, 1e-3])
    np.testing.assert_allclose(added_noise(P, F, predicted + more, Q), Q + more, atol=1e-12)  # rounding of 10
