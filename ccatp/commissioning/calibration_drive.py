"""A recorded calibration drive, cut into segments from fix to fix, and dead reckoning over a segment."""

from dataclasses import dataclass, field, replace
from itertools import pairwise
from math import hypot, sqrt
from pathlib import Path
from statistics import median
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ccatp.config.models import Config
from ccatp.core import Fix, FloatArray
from ccatp.estimation.odometry import Terrain, WheelAngle
from ccatp.links.robot_messages import Sensors
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.records.run_reader import Marked, in_order, open_recordings

# The robot is at rest in a frame if no wheel turns by more than both of these: an angle, and a multiple of the standard
# deviation of the frame's summed encoder noise.
LEAST_TURN_RAD = 2e-6
LEAST_TURN_SIGMAS = 6.0
# Encoder noise is estimated from frames in which the wheel turns by less than this.
SLOW_RAD = 3e-5
# Rests shorter than this do not separate motions.
REST_FRAMES = 5
# A part of a drive between two segments that are left out shows its heading only if it is longer than this.
LEAST_WAY_M = 0.05
# Median absolute difference of two normal samples to the standard deviation of one sample.
_MEDIAN_TO_SIGMA = 1.0 / (0.6745 * 2.0**0.5)


@dataclass(frozen=True, slots=True)
class FixedPlace:
    """Position of the robot by a fix, deck frame; covariance of shape (2, 2)."""

    x_m: float
    y_m: float
    covariance_m2: FloatArray


@dataclass(frozen=True, slots=True)
class Segment:
    """Data between two fixes: angle of each wheel in each frame, shape (n,), and the integrated gyroscope rate."""

    right_rad: FloatArray
    left_rad: FloatArray
    motions: tuple[tuple[int, int], ...]  # first and last (exclusive) frame of each; they cover all frames
    gyro_rad: float
    gyro_s: float
    gyro_samples: int
    duration_s: float  # of the frames


@dataclass(frozen=True, slots=True)
class RecordedDrive:
    """A whole drive: places, and the segments from place ``starts[j]`` to the next one.

    Without a segment that was left out these are k + 1 places and the k segments between them. ``left_out``: segments
    in which the robot restarted, its clock stepped, or frames are missing.
    """

    places: tuple[FixedPlace, ...]
    segments: tuple[Segment, ...]
    encoder_sigma_rad_s: float  # of a rate sample; 0 for a counter
    encoder_period_s: float
    quantum_rad: float  # one count of a counter; 0 if the encoder measures the rate
    gyro_sigma_rad_s: float
    starts: tuple[int, ...]
    left_out: int = 0

    @property
    def chains(self) -> list[range]:
        """Segments that follow one another without one that was left out, in their order."""
        cuts = [j for j in range(1, len(self.starts)) if self.starts[j] != self.starts[j - 1] + 1]
        ends = [0, *cuts, len(self.starts)]
        return [range(begin, end) for begin, end in pairwise(ends)] if self.starts else []


@dataclass(slots=True)
class _Open:
    right: list[float] = field(default_factory=list)
    left: list[float] = field(default_factory=list)
    gyro_rad: float = 0.0
    gyro_s: float = 0.0
    gyro_samples: int = 0
    begun_s: float = 0.0
    has_jump: bool = False


class DriveBuilder:
    """Builds a drive from frames and fixes in the order of their arrival."""

    def __init__(self, mirror: Mirror, puck_height_m: float) -> None:
        self._mirror, self._puck_height_m = mirror, puck_height_m
        self._wheels = WheelAngle(), WheelAngle()
        self._places: list[FixedPlace] = []
        self._segments: list[Segment] = []
        self._open = _Open()
        self._scatters: list[float] = []
        self._periods: list[float] = []
        self._samples = 0
        self._gyro_steps: list[float] = []
        self._gyro: tuple[float, float] | None = None
        self._last: int | None = None
        self._t_s = 0.0
        self._starts: list[int] = []
        self._left_out = 0

    def leave_out_leg(self) -> None:
        """Leave out the segment of the next frame: its samples or their times do not go on from those before it."""
        self._open.has_jump = True
        self._gyro = None
        for wheel in self._wheels:
            wheel.restart()

    def frame(self, number: int, sensors: Sensors) -> None:
        """Add a frame by its number in the recording; one that is not newer than the last one is ignored."""
        if self._last is not None and number <= self._last:
            return
        if self._last is not None and number > self._last + 1:
            self.leave_out_leg()
        self._last, self._t_s = number, sensors.t
        right = [(row[0], row[1]) for row in sensors.enc if row[1] is not None]
        left = [(row[0], row[2]) for row in sensors.enc if row[2] is not None]
        for wheel, samples, turned in zip(
            self._wheels, (right, left), (self._open.right, self._open.left), strict=True
        ):
            turned.append(wheel.add([t for t, _ in samples], [rate for _, rate in samples]))
        if len(right) > 1:
            times = [t for t, _ in right]
            if abs(self._open.right[-1]) < SLOW_RAD:
                self._scatters.append(float(np.std([rate for _, rate in right], ddof=1)))
            self._periods.append((times[-1] - times[0]) / (len(times) - 1))
            self._samples = len(times)
        for t_s, _, rate_rad_s in sensors.imu:
            if self._gyro is not None:
                period_s = t_s - self._gyro[0]
                self._open.gyro_rad += rate_rad_s * period_s
                self._open.gyro_s += period_s
                self._open.gyro_samples += 1
                self._gyro_steps.append(abs(rate_rad_s - self._gyro[1]))
            self._gyro = t_s, rate_rad_s

    def fix(self, fix: Fix) -> None:
        """Add a fix of the robot at rest; a second fix without motion in between replaces the first."""
        place = self._place(fix)
        done, self._open = self._open, _Open(begun_s=self._t_s)
        if not self._places:
            self._places.append(place)
            return
        if done.has_jump:
            self._left_out += 1
            self._places.append(place)
            return
        right, left = np.array(done.right), np.array(done.left)
        motions = _motions(right, left, self._rest_rad())
        if not motions:
            # This rest has no segment of its own: keep its gyroscope sum, which contains the bias, for the next one.
            self._places[-1] = place
            self._open = replace(done, right=[], left=[], begun_s=self._t_s)
            return
        self._starts.append(len(self._places) - 1)
        self._places.append(place)
        duration_s = self._t_s - done.begun_s
        self._segments.append(Segment(right, left, motions, done.gyro_rad, done.gyro_s, done.gyro_samples, duration_s))

    def _rest_rad(self) -> float:
        if not self._scatters or self._wheels[0].is_counter:  # a counter at rest has no noise
            return LEAST_TURN_RAD
        noise_rad = median(self._scatters) * median(self._periods) * sqrt(self._samples)
        return max(LEAST_TURN_RAD, LEAST_TURN_SIGMAS * noise_rad)

    def _place(self, fix: Fix) -> FixedPlace:
        x, y, _ = self._mirror.foot_of_puck(fix.position_m, self._puck_height_m)
        axes = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
        turn = np.array([self._mirror.rotate_deck_from_world(axis) for axis in axes]).T
        covariance = turn @ np.array(fix.covariance_m2).reshape(3, 3) @ turn.T
        # Project the covariance onto the tangent plane: the foot of the puck lies on the surface.
        fx, fy = self._mirror.surface.gradient(x, y)
        normal = np.array([-fx, -fy, 1.0]) / np.sqrt(1.0 + fx * fx + fy * fy)
        along = (np.eye(3) - np.outer(normal, normal))[:2]
        return FixedPlace(x, y, along @ covariance @ along.T)

    def build(self) -> RecordedDrive:
        """The drive so far."""
        right, left = self._wheels
        is_counter = right.is_counter or left.is_counter
        quantum = min(right.quantum_rad, left.quantum_rad) if is_counter else 0.0
        kept = self._kept()
        index = {place: k for k, place in enumerate(kept)}
        return RecordedDrive(
            tuple(self._places[k] for k in kept),
            tuple(segment for segment, start in zip(self._segments, self._starts, strict=True) if start in index),
            0.0 if is_counter or not self._scatters else median(self._scatters),
            median(self._periods) if self._periods else 0.0,
            quantum,
            median(self._gyro_steps) * _MEDIAN_TO_SIGMA if self._gyro_steps else 0.0,
            tuple(index[start] for start in self._starts if start in index),
            self._left_out,
        )

    def _kept(self) -> list[int]:
        """The places that determine a pose: where a segment was left out, the heading needs a way on either side."""
        if not self._left_out:
            return list(range(len(self._places)))
        kept: list[int] = []
        chain: list[int] = []
        for place in range(len(self._places)):
            chain.append(place)
            if place in self._starts:
                continue
            first = self._places[chain[0]]
            ways_m = [hypot(self._places[k].x_m - first.x_m, self._places[k].y_m - first.y_m) for k in chain]
            kept += chain if max(ways_m) >= LEAST_WAY_M else []
            chain = []
        return kept


def _motions(right: FloatArray, left: FloatArray, rest_rad: float) -> tuple[tuple[int, int], ...]:
    """Divide the frames into motions at each rest and at each change between turn and travel.

    The motions cover all frames, because wheels at apparent rest still move, by some micrometres in total.
    """
    moving = np.flatnonzero((np.abs(right) > rest_rad) | (np.abs(left) > rest_rad))
    if not len(moving):
        return ()
    is_turn = np.abs(right - left) > np.abs(right + left)
    spans = []
    for run in np.split(moving, np.flatnonzero(np.diff(moving) > REST_FRAMES) + 1):
        spans += _same_kind(is_turn, int(run[0]), int(run[-1]) + 1)
    begins = [0, *(begin for begin, _ in spans[1:])]
    return tuple(zip(begins, [*begins[1:], len(right)], strict=True))


def _same_kind(is_turn: NDArray[np.bool_], first: int, last: int) -> list[tuple[int, int]]:
    """Parts of a motion, each either a turn or a travel; a part of few frames is added to the part before it."""
    cuts = [first, *(at for at in range(first + 1, last) if is_turn[at] != is_turn[at - 1]), last]
    spans: list[tuple[int, int]] = []
    for begin, end in pairwise(cuts):
        is_same = bool(spans) and is_turn[spans[-1][0]] == is_turn[begin]
        if spans and (end - begin <= REST_FRAMES or is_same):
            spans[-1] = (spans[-1][0], end)
        else:
            spans.append((begin, end))
    return spans


# Frames that are integrated in one step: 3 mm at 0.1 m/s, 0.03 rad at 1 rad/s. The relative error of the midpoint rule
# is then 1e-4 of the curvature of the path.
STEP_FRAMES = 3


class WheelParameters(NamedTuple):
    """Radii of the wheels, wheel base, and downhill drift as a share of the travel."""

    right_m: float
    left_m: float
    base_m: float
    creep: float


class DeadReckonedSegment(NamedTuple):
    """End pose of a segment by dead reckoning, and its derivatives."""

    end: FloatArray  # x, y (m), heading (rad), deck frame, shape (3,)
    of_wheels: FloatArray  # derivatives of ``end`` with respect to ``WheelParameters``, shape (3, 4)
    of_start: FloatArray  # with respect to the start pose, shape (3, 3)
    of_slip: FloatArray  # to the slip (share of travel) of right and left wheel in each motion, shape (3, 2 motions)
    turn_rad: float  # change of heading by the wheels; the rest of the change is due to the surface's curvature


_STEPS = np.array((1e-5, 1e-5, 1e-5, 1e-3))  # relative, except for the creep
_TURN_RAD, _GRIP = 1e-5, 1e-4


def carry(mirror: Mirror, segment: Segment, start: FloatArray, wheels: WheelParameters) -> DeadReckonedSegment:
    """Dead reckoning of a segment from x, y (m), heading (rad), deck frame.

    The model is that of the localizer (thesis eqs 2.11, 2.14 on the curved surface): with d = (r_R phi_R + r_L phi_L)/2
    and turn = (r_R phi_R - r_L phi_L)/b the deck position moves by d h(psi + turn/2) + c |d| g, and the heading by
    turn - fy (fxx dx + fxy dy) / ((1 + fx^2) W). The derivatives are finite differences. The arrays have one column for
    each set of parameters: unchanged, each of the four changed, the heading changed, and the slip of either wheel in
    each motion changed. All columns use the surface's slope at the position of the first.
    """
    steps = np.array((*wheels[:3], 1.0)) * _STEPS
    columns = 6 + 2 * len(segment.motions)
    parameters = np.tile(np.array(wheels)[:, None], columns)
    parameters[:, 1:5] += np.diag(steps)
    right_m, left_m, base_m, creep = parameters
    x, y, psi = (np.full(columns, value) for value in start)
    psi[5] += _TURN_RAD
    terrain = Terrain(mirror)
    dx0 = dy0 = turned_rad = 0.0
    for motion, (first, last) in enumerate(segment.motions):
        grip_right, grip_left = np.ones(columns), np.ones(columns)
        grip_right[6 + 2 * motion] += _GRIP
        grip_left[7 + 2 * motion] += _GRIP
        for begin in range(first, last, STEP_FRAMES):
            end = min(begin + STEP_FRAMES, last)
            phi_r, phi_l = float(segment.right_rad[begin:end].sum()), float(segment.left_rad[begin:end].sum())
            if phi_r == phi_l == 0.0:  # a counter at rest
                continue
            right, left = right_m * phi_r * grip_right, left_m * phi_l * grip_left
            d, turn = 0.5 * (right + left), (right - left) / base_m
            # Slope at the middle of the step, extrapolated from the step before.
            fx, fy, fxx, fxy, _, gx, gy = terrain.at(float(x[0]) + 0.5 * dx0, float(y[0]) + 0.5 * dy0)
            s2 = 1.0 + fx * fx
            s, norm = s2**0.5, (s2 + fy * fy) ** 0.5
            ex, ey = -fx * fy / (norm * s), s / norm
            middle = psi + 0.5 * turn
            cosine, sine = np.cos(middle), np.sin(middle)
            drift = creep * np.abs(d)
            dx = d * (cosine / s + sine * ex) + drift * gx
            dy = d * sine * ey + drift * gy
            x, y = x + dx, y + dy
            psi = psi + turn - fy * (fxx * dx + fxy * dy) / (s2 * norm)
            dx0, dy0 = float(dx[0]), float(dy[0])
            turned_rad += float(turn[0])
    ends = np.array([x, y, psi])
    away = ends - ends[:, :1]
    of_start = np.eye(3)
    of_start[:, 2] = away[:, 5] / _TURN_RAD
    return DeadReckonedSegment(ends[:, 0], away[:, 1:5] / steps, of_start, away[:, 6:] / _GRIP, turned_rad)


# A survey has hundreds of legs. The first ones determine the parameters, and the run time grows with their cube.
MAX_FIXES = 60


class ReadDrive(NamedTuple):
    """A drive with mirror and configuration of its run; ``warnings``: what was left out, one line each."""

    drive: RecordedDrive
    mirror: Mirror
    cfg: Config
    warnings: tuple[str, ...]


def read_drive(run_dir: Path) -> ReadDrive:
    """Drive (up to ``MAX_FIXES`` fused fixes) of a run's newest recording.

    Raises RunReadError: no recording can be read. Raises ConfigError: its configuration cannot be used.
    """
    recording = open_recordings(run_dir)[-1]
    cfg = recording.config({})
    mirror = build_mirror(cfg.mirror)
    builder, fixes = DriveBuilder(mirror, cfg.robot.puck_height_m), 0
    steps = {step.number for step in recording.timeline.steps}
    for event in in_order(recording.messages()):
        if isinstance(event, Marked):
            if event.number in steps:
                builder.leave_out_leg()
            builder.frame(event.number, event.sensors)
        elif event.was_fused:
            builder.fix(event.fix)
            fixes += 1
            if fixes == MAX_FIXES:
                break
    drive, warnings = builder.build(), [*recording.notes, *recording.warnings]
    if drive.left_out:
        legs = "1 leg is" if drive.left_out == 1 else f"{drive.left_out} legs are"
        why = "a restart of the robot, a step of its clock or missing frames"
        warnings.append(f"{recording.path}: {legs} not used for the calibration because of {why}")
    return ReadDrive(drive, mirror, cfg, tuple(warnings))
