"""A run made of frames by hand, through the localizers; its smoother; figures against a reference, done by hand."""

from collections.abc import Iterator, Sequence
from math import cos, pi, sin, sqrt

import numpy as np
import pytest

from ccatp.config.load import load_config
from ccatp.config.models import Config
from ccatp.core import DeckPose, EdgeSample, Fix, FloatArray, ImuSample, WheelSample
from ccatp.filters import FILTERS
from ccatp.links.robot_messages import CommandEcho, Sensors
from ccatp.links.topics import FixMessage, Rest
from ccatp.localizer import build_localizer
from ccatp.mirror.mirror import build_mirror
from ccatp.records.run_reader import Event, Fixed, Marked, Message, Placed, Trace, in_order
from ccatp.studies import replay as recording_filter
from ccatp.studies.replay import (
    REPRODUCED,
    RecordingFilter,
    Replayed,
    ReplayEvaluation,
    csv_lines,
    difference,
    errors_of,
    figures,
    has_smoother,
    judge,
    replay,
    table_lines,
)
from ccatp.studies.smoother import Smoother

FRAME_S = 0.01
STILL_FRAMES = 60  # longer than a rest takes to be seen
RATE_RAD_S = 1.0  # of both wheels: 30 mm/s
FIX_SIGMA_M = 1e-5
MIRROR = build_mirror(load_config().mirror)
ECHO = CommandEcho(seq=-1, age=0.0, permit_age=0.0, held=False)


def config_for(name: str, **keys: object) -> Config:
    return load_config(None, {"run.filter": name, **keys})


def frame(number: int, rate_rad_s: float, *, at_rest: bool = False) -> Marked:
    t_s = number * FRAME_S
    imu = [ImuSample(t_s, 0.0, 0.0)]
    encoders = [WheelSample(t_s - 0.001 * k, rate_rad_s, rate_rad_s) for k in range(9, -1, -1)]
    edges = [EdgeSample(t_s, 1, 1, 1, 1)]
    return Marked(number, t_s, Sensors(number, t_s, imu, encoders, edges, None, (0.0, 0.0), 1.0, ECHO, []), at_rest)


def fix_at(cfg: Config, place: tuple[float, float], t_s: float) -> Fix:
    puck = MIRROR.puck_world(DeckPose(*place, 0.0), cfg.robot.puck_height_m)
    return Fix(t_s, puck, tuple((FIX_SIGMA_M**2 * np.eye(3)).ravel().tolist()), 1.0, (1, 2, 3, 4), 0.0)


BESIDE = MIRROR.base_pose.x_m + 3e-3, MIRROR.base_pose.y_m - 1e-3


def standing(cfg: Config, **fate: bool) -> list[Event]:
    """A robot that stands 3 mm and 1 mm beside base, as a fix shows; the fate of that in the run."""
    seen = Fixed(0, 1.0, fix_at(cfg, BESIDE, 1.0), **({"was_fused": True} | fate))
    return [*(frame(n, 0.0) for n in range(1, 101)), seen, *(frame(n, 0.0) for n in range(101, 151))]


def driving(cfg: Config, *, late_frames: int) -> Iterator[Event]:
    """A robot that starts 1 mm to the left of base and drives 0.06 m; a fix of frame 160 is handed over later."""
    base = MIRROR.base_pose
    for n in range(1, STILL_FRAMES + 1):
        yield frame(n, 0.0)
    for n in range(STILL_FRAMES + 1, 261):
        yield frame(n, RATE_RAD_S, at_rest=n == 200)  # wrongly: what a localizer makes of that shows
        if n == 160 + late_frames:
            way_m = 0.001 * 1000 * FRAME_S * 100 * RATE_RAD_S * cfg.robot.wheel_radius_m
            c, s = cos(base.heading_rad), sin(base.heading_rad)
            place = base.x_m + way_m * c - 1e-3 * s, base.y_m + way_m * s + 1e-3 * c
            yield Fixed(160, 160 * FRAME_S, fix_at(cfg, place, 160 * FRAME_S), True)


@pytest.mark.parametrize("name", ["ekf", "ukf"])
def test_the_smoother_knows_from_the_first_frame_on_what_the_fix_showed(name: str) -> None:
    cfg = config_for(name)
    found = replay(cfg, MIRROR, standing(cfg), smooth=True)
    assert found.smoothed is not None
    wanted = np.tile(BESIDE, (150, 1))
    np.testing.assert_allclose(found.feet[0], (100, *wanted[0]), rtol=0.0, atol=1e-9)  # Newton's rest
    before, after = found.trace.pose[:100, :2], found.smoothed.pose[:, :2]
    assert np.linalg.norm(before - wanted[:100], axis=1).min() > 3e-3
    # 0.1 mm: a start known to 2 mm and a fix known to 10 um, from a robot that is not yet known to stand.
    np.testing.assert_allclose(after, wanted, atol=1e-4)
    assert found.smoothed.covariance is not None
    assert np.sqrt(found.smoothed.covariance[0, 0, 0]) < 1e-4
    np.testing.assert_array_equal(found.smoothed.seq, found.trace.seq)


@pytest.mark.parametrize("name", ["kf", "ekf", "ukf"])
def test_a_replay_is_what_the_localizer_does(name: str) -> None:
    cfg = config_for(name)
    localizer, wanted = build_localizer(cfg, MIRROR), []
    for event in driving(cfg, late_frames=20):
        if isinstance(event, Fixed):
            localizer.fuse_fix(event.fix)
        else:
            s = event.sensors
            localizer.step(s.t, s.imu, s.enc, s.edge, s.gravity)
            if event.at_rest:
                localizer.rest()
            wanted.append(MIRROR.deck_pose(localizer.pose))
    times_s: list[float] = []
    found = replay(cfg, MIRROR, driving(cfg, late_frames=20), on_frame=times_s.append)
    assert times_s == found.trace.t_s.tolist() == [n * FRAME_S for n in range(1, 261)]
    assert found.moving.tolist() == list(range(STILL_FRAMES + 1, 261))
    assert found.trace.seq.tolist() == list(range(1, 261))
    # 1e-12 m: the trace goes by way of many poses at once, which drops a point on the surface by other arithmetic.
    np.testing.assert_allclose(found.trace.pose, [(p.x_m, p.y_m, p.heading_rad) for p in wanted], rtol=0.0, atol=1e-12)
    assert found.trace.covariance is not None
    np.testing.assert_allclose(found.trace.covariance[-1], localizer.pose_covariance)
    assert (found.fixes, found.refused, found.first_difference) == (1, 0, None)
    assert found.counts["fixes"] == 1
    assert found.feet[:, 0].tolist() == [180]


@pytest.mark.parametrize("name", ["ekf", "ukf"])
def test_a_late_fix_is_smoothed_as_if_it_had_come_in_time(name: str) -> None:
    cfg = config_for(name)
    first, late = (replay(cfg, MIRROR, driving(cfg, late_frames=n), smooth=True) for n in (0, 60))
    assert first.smoothed is not None
    assert late.smoothed is not None
    # 50 um: the filters are linearised where they are, which a fix of 1 mm changes; a record of what was done twice
    # would be beside it by the whole millimetre.
    np.testing.assert_allclose(late.smoothed.pose[:, :2], first.smoothed.pose[:, :2], atol=5e-5)
    aside = first.smoothed.pose[STILL_FRAMES, :2] - first.trace.pose[0, :2]
    assert np.linalg.norm(aside) > 5e-4  # the fix is seen from the beginning


@pytest.mark.parametrize("name", ["kf", "ekf", "ukf"])
def test_a_fix_that_was_set_aside_is_kept_from_the_localizer(name: str) -> None:
    cfg = config_for(name)
    found = replay(cfg, MIRROR, standing(cfg, was_fused=False, was_set_aside=True))
    without = replay(cfg, MIRROR, [event for event in standing(cfg) if not isinstance(event, Fixed)])
    taken = replay(cfg, MIRROR, standing(cfg, was_fused=False))
    assert (found.fixes, found.set_aside, found.refused, found.first_difference) == (1, 1, 0, None)
    np.testing.assert_array_equal(found.trace.pose, without.trace.pose)
    assert np.abs(found.trace.pose - taken.trace.pose).max() > 1e-4
    assert (taken.refused, taken.first_difference) == (0, (1.0, ""))  # refused in the run, taken now
    assert not taken.feet.size  # it showed the place of nothing


def test_a_fix_that_the_run_took_and_the_replay_refuses() -> None:
    cfg = config_for("ekf", **{"localizer.full_state.fix_gate_nis": 1e-3})
    found = replay(cfg, MIRROR, standing(cfg))
    assert found.refused == 1
    assert found.first_difference is not None
    assert found.first_difference[0] == 1.0
    assert "mm from the estimate" in found.first_difference[1]


def test_four_states_cannot_be_smoothed_and_no_frames_can() -> None:
    assert [has_smoother(config_for(name)) for name in ("kf", "ekf", "ukf")] == [False, True, True]
    found = replay(config_for("ekf"), MIRROR, [], smooth=True)
    assert found.smoothed is not None
    assert len(found.trace.seq) == len(found.smoothed.seq) == 0


# -- the order of events ----------------------------------------------------------------------------------------------


def bare(seq: int) -> Sensors:
    return Sensors(seq, 0.01 * seq, [], [], [], None, (0.0, 0.0), 1.0, ECHO, [])


def given(seq: int, t_s: float, is_fused: bool) -> FixMessage:
    return FixMessage(
        seq=seq, t_s=t_s, point=None, is_fused=is_fused, position_m=(1.0, 2.0, 3.0), covariance_m2=[0.5] * 9, dop=1.25,
        residual_rms_m=1e-6, channels=[1, 4], jump_mm=0.0,
    )  # fmt: skip


def placed(message: Message) -> Placed:
    """On the axis of a recording without a restart."""
    return Placed(message.seq, message.t if isinstance(message, Sensors) else message.t_s, message)


def name_of(event: Event) -> str:
    if isinstance(event, Marked):
        return f"{event.sensors.seq}{' rests' if event.at_rest else ''}"
    return f"fix {event.fix.t_s:g}{'' if event.was_fused else ' refused'}"


FRAMES = [bare(seq) for seq in range(4)]
GIVEN = given(1, 7.0, True)
RESTS = [Rest(seq=seq, t_s=0.0) for seq in range(3)]


@pytest.mark.parametrize(
    ("messages", "wanted"),
    [
        pytest.param([GIVEN, *FRAMES], "0, 1, fix 7, 2, 3", id="before the batch of its frame"),
        pytest.param([*FRAMES[:2], GIVEN, *FRAMES[2:]], "0, 1, fix 7, 2, 3", id="between two batches"),
        pytest.param([RESTS[1], GIVEN, *FRAMES[:3]], "0, 1 rests, fix 7, 2", id="a rest before the fix"),
        pytest.param(
            [given(0, 1.0, False), given(0, 2.0, True), *FRAMES[:2]], "0, fix 1 refused, fix 2, 1", id="in their order"
        ),
        pytest.param(
            [*FRAMES[:2], given(1, 1.0, True), given(2, 2.0, True), RESTS[2]], "0, 1, fix 1", id="of a frame not there"
        ),
        pytest.param([bare(0), given(3, 1.0, True), bare(7)], "0, fix 1, 7", id="where frames are missing"),
    ],
)
def test_a_fix_comes_behind_its_frame(messages: Sequence[Message], wanted: str) -> None:
    assert ", ".join(map(name_of, in_order(map(placed, messages)))) == wanted


def test_a_recorded_fix_is_the_fix_again() -> None:
    message = given(5, 1.5, False)
    fix = Fix(1.5, (1.0, 2.0, 3.0), (0.5,) * 9, 1.25, (1, 4), 1e-6)
    assert list(in_order([placed(bare(5)), placed(message)]))[1] == Fixed(5, 1.5, fix, False)
    message.is_set_aside = True
    assert list(in_order([placed(bare(5)), placed(message)]))[1] == Fixed(5, 1.5, fix, False, was_set_aside=True)


# -- a filter that can be smoothed ------------------------------------------------------------------------------------

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


def assert_smoothed_as_by_hand(filter_: RecordingFilter, name: str) -> None:
    found = filter_.smooth()
    for one, wanted in zip((found.means, found.covariances), by_hand(name), strict=True):
        assert_same(one, wanted)


@pytest.mark.parametrize("chapter", [4096, 5])
@pytest.mark.parametrize("name", sorted(FILTERS))
def test_it_filters_as_the_filter_in_it_and_smooths_as_the_smoother(
    name: str, chapter: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recording_filter, "CHAPTER", chapter)
    filter_, alone = started(name), FILTERS[name](np.ones(N), 2.0 * np.eye(N))
    for z in READINGS:
        filter_.predict(F, Q)
        alone.predict(F, Q)
        assert filter_.update(z, H, R).nis == pytest.approx(alone.update(z, H, R).nis, rel=1e-12)  # rounding
        assert_same(filter_.mean, alone.mean)
        assert_same(filter_.covariance, alone.covariance)
    assert filter_.count == len(READINGS)
    assert_smoothed_as_by_hand(filter_, name)


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
    assert_smoothed_as_by_hand(filter_, "ekf")


# -- figures against a reference --------------------------------------------------------------------------------------


def trace(x_m: list[float], heading_rad: float = 0.0, *, first: int = 0, covariance: FloatArray | None = None) -> Trace:
    k = len(x_m)
    seq = np.arange(first, first + k)
    pose = np.column_stack([x_m, np.zeros(k), np.full(k, heading_rad)])
    t_s = np.array(0.01 * seq, dtype=np.float64)
    return Trace(seq, t_s, pose, np.zeros(k), None if covariance is None else np.tile(covariance, (k, 1, 1)))


def test_the_figures() -> None:
    found = figures(errors_of(trace([0.001, 0.002, 0.003, 0.004], 0.002), trace([0.0] * 4), np.array([1, 3]), [2, 9]))
    expected = {"mean": 2.5, "p50": 2.5, "p99": 3.97, "max": 4.0, "rms": sqrt(7.5)}
    assert found["position_error_mm"] == pytest.approx(expected)
    assert found["moving_error_mm"]["rms"] == pytest.approx(sqrt(10.0))  # of 2 and 4
    assert found["arrival_error_mm"] == pytest.approx({"rms": 3.0, "max": 3.0})
    assert found["heading_error_mrad"]["rms"] == pytest.approx(2.0)
    assert found["nees_mean"] is None


NONE = np.empty(0, dtype=np.int64)


def test_frames_that_both_have_are_compared_with_height_and_the_short_way_round() -> None:
    high = trace([0.003])._replace(height_m=np.array([0.004]))
    assert errors_of(high, trace([0.0]), NONE, NONE).distance_m == pytest.approx([0.005])
    shifted = errors_of(trace([1.0, 2.0, 3.0], first=4), trace([0.0, 0.0, 1.0], first=3), NONE, NONE)
    assert shifted.distance_m.tolist() == [1.0, 1.0]
    turned = errors_of(trace([0.0], pi - 0.01), trace([0.0], -pi + 0.02), NONE, NONE)
    assert turned.turn_rad == pytest.approx([-0.03])


def test_nees_takes_correlations_into_account() -> None:
    covariance = np.array([[4e-6, 0.0, 1e-6], [0.0, 1.0, 0.0], [1e-6, 0.0, 1e-6]])
    errors = errors_of(trace([0.002], 0.001, covariance=covariance), trace([0.0]), NONE, NONE)
    # The inverse of [[4, 1], [1, 1]] is [[1, -1], [-1, 4]] / 3: (2, 1) gives (4 - 4 + 4) / 3.
    assert errors.nees == pytest.approx([4.0 / 3.0])
    singular = errors_of(trace([0.002], covariance=np.zeros((3, 3))), trace([0.0]), NONE, NONE)
    assert figures(singular)["nees_mean"] is None


@pytest.mark.parametrize(("by_m", "is_same"), [(0.0, True), (0.9 * REPRODUCED, True), (1.1 * REPRODUCED, False)])
def test_a_replay_reproduces_up_to_rounding(by_m: float, is_same: bool) -> None:
    found = difference(errors_of(trace([by_m, 0.0]), trace([0.0, 0.0]), NONE, NONE))
    assert (found["reproduced"], found["frames"]) == (is_same, 2)
    assert found["position_mm"] == pytest.approx({"rms": 1e3 * by_m / sqrt(2.0), "max": 1e3 * by_m}, abs=1e-15)
    assert difference(errors_of(trace([0.0], by_m), trace([0.0]), NONE, NONE))["reproduced"] is is_same
    assert not difference(errors_of(trace([1.0]), trace([1.0], first=7), NONE, NONE))["reproduced"]  # no common frame


def judged(*, has_truth: bool, is_smoothed: bool = True, first: int = 0) -> ReplayEvaluation:
    smoothed = trace([0.001, 0.0], first=first) if is_smoothed else None
    replayed = Replayed(
        trace([0.002, 0.002], first=first, covariance=np.eye(3)), np.array([first]), np.empty((0, 3)), smoothed
    )
    truth = trace([0.0, 0.0], first=first) if has_truth else None
    return ReplayEvaluation(replayed, trace([0.004, 0.002], first=first), truth, NONE, MIRROR)


def test_all_are_judged_by_the_truth_where_every_recording_has_one() -> None:
    found = judge([judged(has_truth=True), judged(has_truth=True)])
    assert found["reference"] == "truth"
    means = {name: found[name]["position_error_mm"]["mean"] for name in ("recorded", "replayed", "smoothed")}
    assert means == pytest.approx({"recorded": 3.0, "replayed": 2.0, "smoothed": 0.5})
    assert found["difference"]["position_mm"]["max"] == pytest.approx(2.0)
    assert found["difference"]["frames"] == 4
    found = judge([judged(has_truth=True), judged(has_truth=False)])
    assert found["reference"] == "recorded"
    assert set(found["recorded"]) == {"fix_distance_mm"}
    assert found["replayed"]["position_error_mm"]["max"] == pytest.approx(2.0)
    assert judge([judged(has_truth=False, is_smoothed=False)])["smoothed"] is None


def test_the_table_has_a_column_for_each_estimate() -> None:
    lines = [" ".join(line.split()) for line in table_lines(judge([judged(has_truth=True)]))]
    assert lines[0] == "error against the truth recorded replayed smoothed"
    assert lines[1] == "position mean (mm) 3.0000 2.0000 0.5000"
    assert lines[-3] == "position (mm) 1.4142 2.0000"
    assert "at arrivals rms (mm) - - -" in lines
    assert "NEES, all frames (3 expected) - 4.0e-06 -" in lines
    assert "NEES at arrivals (3 expected) - - -" in lines
    assert lines[-1].startswith("NEES below 3: the errors are smaller than their covariance says")
    lines = [" ".join(line.split()) for line in table_lines(judge([judged(has_truth=False, is_smoothed=False)]))]
    assert lines[:2] == ["error against the recorded estimate recorded replayed", "position mean (mm) - 1.0000"]
    assert "NEES" not in "".join(lines)
    part = judged(has_truth=True)._replace(recorded=trace([0.002, 0.002 + 3e-14]))
    assert list(table_lines(judge([part])))[-3].split()[-1] == "3.0e-11"


def test_the_rows_of_the_csv() -> None:
    head, first, _ = csv_lines([judged(has_truth=False, first=3)])
    assert head.split(",")[:6] == ["part", "seq", "t_s", "x_m", "y_m", "heading_rad"]
    assert head.split(",")[-3:] == ["true_x_m", "true_y_m", "true_heading_rad"]
    assert first == "1,3,0.03,0.002,0.0,0.0,0.001,0.0,0.0,0.004,0.0,0.0,,,"
