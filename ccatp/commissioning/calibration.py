"""Weighted least squares for wheel radii, wheel base and gyroscope bias over all segments of a drive together.

The unknowns are the parameters and the pose at every fix. The measurements, each with its covariance, are the fixes,
the dead reckoning of each segment, and the change of heading by the gyroscope. The standard deviation of the wheel slip
is chosen so that chi^2 equals the degrees of freedom; all other uncertainties grow with it.
"""

from dataclasses import asdict, dataclass
from math import floor, log10, sqrt
from typing import Any, NamedTuple

import numpy as np

from ccatp.commissioning.calibration_drive import DeadReckonedSegment, RecordedDrive, Segment, WheelParameters, carry
from ccatp.config.models import Config, FullStateConfig, RobotConfig
from ccatp.core import FloatArray
from ccatp.errors import UsageError
from ccatp.mirror.mirror import Mirror
from ccatp.report.html import render

RIGHT, LEFT, BASE, CREEP, BIAS, SCALE = range(6)
PARAMETERS = 6
MIN_SEGMENTS = 4
MIN_TURN_RAD = 1.0
MIN_WAY_M = 0.05
_ROUNDS = 8
_CONVERGED = 1e-4  # of a standard deviation
# Errors of the midpoint rule and of the rounding of samples.
_FLOOR_M, _FLOOR_RAD = 5e-7, 5e-7
_LEAST_SLIP, _MOST_SLIP = 1e-6, 0.2
_LEAST_WAY_RAD = 1e-3  # a wheel that hardly turned in a motion gives no information


class CalibrationError(UsageError):
    """A drive that does not determine the parameters, or a result that must not be used."""


class Estimate(NamedTuple):
    """A value and its standard deviation."""

    value: float
    sigma: float


@dataclass(frozen=True, slots=True)
class Calibration:
    """Result of a drive: mean radius and base in m, bias in rad/s, difference of the radii (right minus left) in m."""

    radius: Estimate
    base: Estimate
    bias: Estimate
    covariance: FloatArray  # of radius, base and bias, shape (3, 3)
    radius_difference_m: Estimate
    gyroscope_scale: Estimate
    creep: Estimate
    slip_sigma: float  # of the slip of a wheel in one motion, share of its travel; 0 if chi^2 needs none
    chi2: float  # of all residuals, with ``slip_sigma``
    degrees: int
    segments: int


def calibrate(mirror: Mirror, drive: RecordedDrive, cfg: Config) -> Calibration:
    """Estimate the parameters.

    The iteration starts at the configured radius and base, which are not measurements. The scale of the gyroscope and
    the downhill drift (creep, share of the travel) have prior mean 0 and the configured standard deviations. Raises
    CalibrationError: too few segments, or all turns or travels are too small.
    """
    _check(drive, cfg.robot)
    problem = _Problem(mirror, drive, cfg.localizer.full_state)
    x = _first_guess(mirror, drive, cfg.robot)
    slip = 0.0
    # The slip and the solution depend on each other: two iterations are enough.
    for _ in range(2):
        x = problem.solve(x, slip).x
        slip = problem.fitting_slip(x)
    solution = problem.solve(x, slip)
    excess = max(1.0, solution.chi2 / solution.degrees)
    x, P = solution.x[:PARAMETERS], solution.covariance * excess
    pick = np.zeros((4, PARAMETERS))
    pick[0, [RIGHT, LEFT]] = 0.5
    pick[1, BASE] = pick[2, BIAS] = pick[3, RIGHT] = 1.0
    pick[3, LEFT] = -1.0
    values, covariance = pick @ x, pick @ P @ pick.T
    radius, base, bias, difference = (Estimate(float(v), sqrt(covariance[k, k])) for k, v in enumerate(values))
    gyro_scale, creep = (Estimate(float(x[k]), sqrt(P[k, k])) for k in (SCALE, CREEP))
    return Calibration(
        radius, base, bias, covariance[:3, :3], difference, gyro_scale, creep, slip,
        solution.chi2, solution.degrees, len(drive.segments),
    )  # fmt: skip


def _check(drive: RecordedDrive, robot: RobotConfig) -> None:
    if len(drive.segments) < MIN_SEGMENTS:
        raise CalibrationError(
            f"the drive has {len(drive.segments)} legs with a fix at each end, {MIN_SEGMENTS} are needed"
            + (f" ({drive.left_out} are not used)" if drive.left_out else "")
            + "; drive again"
        )
    turns = [
        robot.wheel_radius_m / robot.wheel_base_m * abs(float((s.right_rad - s.left_rad).sum())) for s in drive.segments
    ]
    ways = [0.5 * robot.wheel_radius_m * abs(float((s.right_rad + s.left_rad).sum())) for s in drive.segments]
    if max(turns) < MIN_TURN_RAD:
        raise CalibrationError("the drive has no turn by more than a radian: it does not show the wheel base")
    if max(ways) < MIN_WAY_M:
        raise CalibrationError("the drive has no way of more than 50 mm: it does not show the wheel radius")


class _Solution(NamedTuple):
    x: FloatArray
    covariance: FloatArray
    chi2: float
    degrees: int


class _Problem(NamedTuple):
    mirror: Mirror
    drive: RecordedDrive
    priors: FullStateConfig

    def solve(self, x: FloatArray, slip_sigma: float) -> _Solution:
        for _ in range(_ROUNDS):
            rows, residuals = self._whitened(x, self._carried(x), slip_sigma)
            step, *_ = np.linalg.lstsq(rows, residuals, rcond=None)
            x = x + step
            if float(np.sum((rows @ step) ** 2)) < _CONVERGED**2:
                break
        rows, residuals = self._whitened(x, self._carried(x), slip_sigma)
        # The columns differ by orders of magnitude: scale them before the inversion.
        scale = 1.0 / np.sqrt((rows * rows).sum(axis=0))
        covariance = np.linalg.inv((rows * scale).T @ (rows * scale)) * np.outer(scale, scale)
        degrees = rows.shape[0] - rows.shape[1]
        return _Solution(x, covariance[:PARAMETERS, :PARAMETERS], float(residuals @ residuals), degrees)

    def fitting_slip(self, x: FloatArray) -> float:
        """Slip at which chi^2, linearised at ``x``, equals the degrees of freedom; chi^2 decreases with slip."""
        carried = self._carried(x)

        def excess(slip_sigma: float) -> float:
            rows, residuals = self._whitened(x, carried, slip_sigma)
            step, *_ = np.linalg.lstsq(rows, residuals, rcond=None)
            left = residuals - rows @ step
            return float(np.sum(left**2)) - int(rows.shape[0] - rows.shape[1])

        if excess(0.0) <= 0.0:
            return 0.0
        low, high = _LEAST_SLIP, _MOST_SLIP
        while high > 1.02 * low:
            middle = sqrt(low * high)
            low, high = (middle, high) if excess(middle) > 0.0 else (low, middle)
        return high

    def _carried(self, x: FloatArray) -> list[DeadReckonedSegment]:
        wheels = WheelParameters(*x[[RIGHT, LEFT, BASE, CREEP]].tolist())
        starts = x[PARAMETERS:].reshape(-1, 3)
        return [
            carry(self.mirror, segment, starts[start], wheels)
            for segment, start in zip(self.drive.segments, self.drive.starts, strict=True)
        ]

    def _whitened(
        self, x: FloatArray, carried: list[DeadReckonedSegment], slip_sigma: float
    ) -> tuple[FloatArray, FloatArray]:
        """Whitened Jacobian and residuals (measured minus predicted from ``x``)."""
        drive, size = self.drive, len(x)
        rows, residuals = [], []

        def add(jacobian: FloatArray, residual: FloatArray, covariance: FloatArray) -> None:
            whitener = np.linalg.inv(np.linalg.cholesky(covariance))
            rows.append(whitener @ jacobian)
            residuals.append(whitener @ residual)

        for k, place in enumerate(drive.places):
            at = PARAMETERS + 3 * k
            jacobian = np.zeros((2, size))
            jacobian[:, at : at + 2] = np.eye(2)
            add(jacobian, np.array((place.x_m, place.y_m)) - x[at : at + 2], place.covariance_m2)
        for k, (segment, led) in enumerate(zip(drive.segments, carried, strict=True)):
            at = PARAMETERS + 3 * drive.starts[k]
            jacobian = np.zeros((3, size))
            jacobian[:, at + 3 : at + 6] = np.eye(3)
            jacobian[:, at : at + 3] = -led.of_start
            jacobian[:, [RIGHT, LEFT, BASE, CREEP]] = -led.of_wheels
            add(jacobian, led.end - x[at + 3 : at + 6], _process_covariance(drive, segment, led, slip_sigma))
            add(*_gyro_row(drive, k, led, x))
        for index, sigma in ((SCALE, self.priors.gyroscope_scale_sigma), (CREEP, self.priors.creep_sigma)):
            jacobian = np.zeros((1, size))
            jacobian[0, index] = 1.0
            add(jacobian, -x[[index]], np.array([[sigma**2]]))
        return np.vstack(rows), np.concatenate(residuals)


def _first_guess(mirror: Mirror, drive: RecordedDrive, robot: RobotConfig) -> FloatArray:
    """Positions from the fixes, headings from the wheels; the first one turns the first segment to the second fix.

    After a segment that was left out, the longest segment of those that follow it gives the heading.
    """
    wheels = WheelParameters(robot.wheel_radius_m, robot.wheel_radius_m, robot.wheel_base_m, 0.0)
    poses = np.zeros((len(drive.places), 3))
    poses[:, :2] = [(place.x_m, place.y_m) for place in drive.places]
    for number, chain in enumerate(drive.chains):
        segments, first = [drive.segments[j] for j in chain], drive.starts[chain[0]]
        lengths_m = np.linalg.norm(np.diff(poses[first : first + len(chain) + 1, :2], axis=0), axis=1)
        at = int(np.argmax(lengths_m)) if number else 0
        turned_rad = sum(carry(mirror, segments[j], poses[first + j], wheels).end[2] for j in range(at))
        went = carry(mirror, segments[at], poses[first + at], wheels).end[:2] - poses[first + at, :2]
        seen = poses[first + at + 1, :2] - poses[first + at, :2]
        poses[first, 2] = np.arctan2(seen[1], seen[0]) - np.arctan2(went[1], went[0]) - turned_rad
        for j, segment in enumerate(segments):
            poses[first + j + 1, 2] = carry(mirror, segment, poses[first + j], wheels).end[2]
    return np.concatenate((wheels, [0.0, 0.0], poses.ravel()))


def _process_covariance(
    drive: RecordedDrive, segment: Segment, carried: DeadReckonedSegment, slip_sigma: float
) -> FloatArray:
    """Covariance of the end pose of a segment: encoder noise and slip of each motion, independent for each wheel."""
    frame_s = segment.duration_s / len(segment.right_rad)
    shares = []
    for first, last in segment.motions:
        noise = drive.encoder_sigma_rad_s**2 * drive.encoder_period_s * (last - first) * frame_s
        noise += drive.quantum_rad**2 / 6.0  # two uniform errors of half a count, q^2 / 12 each
        for turned in (segment.right_rad, segment.left_rad):
            way_rad = float(np.abs(turned[first:last]).sum())
            shares.append(slip_sigma**2 + noise / max(way_rad, _LEAST_WAY_RAD) ** 2)
    floor = np.diag((_FLOOR_M**2, _FLOOR_M**2, _FLOOR_RAD**2))
    covariance: FloatArray = carried.of_slip @ np.diag(shares) @ carried.of_slip.T + floor
    return covariance


def _gyro_row(
    drive: RecordedDrive, k: int, carried: DeadReckonedSegment, x: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Integrated gyroscope rate: (1 + scale) (change of heading - part of the surface's curvature) + bias * time."""
    segment = drive.segments[k]
    at = PARAMETERS + 3 * drive.starts[k]
    start_rad, end_rad = float(x[at + 2]), float(x[at + 5])
    curvature_rad = float(carried.end[2]) - start_rad - carried.turn_rad
    turned_rad = end_rad - start_rad - curvature_rad
    jacobian = np.zeros((1, len(x)))
    jacobian[0, at + 5], jacobian[0, at + 2] = 1.0 + x[SCALE], -1.0 - x[SCALE]
    jacobian[0, SCALE], jacobian[0, BIAS] = turned_rad, segment.gyro_s
    expected = (1.0 + x[SCALE]) * turned_rad + x[BIAS] * segment.gyro_s
    period_s = segment.gyro_s / max(segment.gyro_samples, 1)
    variance = (drive.gyro_sigma_rad_s * period_s) ** 2 * segment.gyro_samples + _FLOOR_RAD**2
    return jacobian, np.array([segment.gyro_rad - expected]), np.array([[variance]])


# The daemon refuses a robot whose own figures differ from the configuration by more than this.
MOST_DIFFERENCE = 0.05
# Largest relative standard deviation: a measuring tape is as accurate.
MOST_SIGMA = 0.01
SHOWN_SLIP = 1e-4


class CalibrationRow(NamedTuple):
    """One key of the configuration; values in the unit of the key."""

    key: str
    configured: float
    found: float
    sigma: float

    @property
    def rounded(self) -> float:
        """The value found, rounded to the second significant digit of its standard deviation."""
        return round(self.found, 1 - floor(log10(self.sigma)))


def rows(cfg: Config, found: Calibration) -> tuple[CalibrationRow, CalibrationRow, CalibrationRow]:
    """The configured value and the result of the drive for each key."""
    return (
        CalibrationRow("robot.wheel_radius_m", cfg.robot.wheel_radius_m, *found.radius),
        CalibrationRow("robot.wheel_base_m", cfg.robot.wheel_base_m, *found.base),
        CalibrationRow("localizer.gyroscope_bias_rad_s", cfg.localizer.gyroscope_bias_rad_s, *found.bias),
    )


def check_usable(table: tuple[CalibrationRow, ...]) -> None:
    """Raise CalibrationError if a length is too uncertain, or differs too much from the configured one, to be used."""
    for row in table[:2]:
        if row.sigma > MOST_SIGMA * row.found:
            raise CalibrationError(
                f"{row.key}: {row.found:.6g} +- {row.sigma:.2g} is no better than a measuring tape; "
                "drive more rounds (--rounds), or find out why the wheels slip"
            )
        if abs(row.found - row.configured) > MOST_DIFFERENCE * row.configured:
            raise CalibrationError(
                f"{row.key}: the drive shows {row.found:.6g}, {row.configured:.6g} is configured, more than "
                f"{MOST_DIFFERENCE:.0%} apart: another robot, or a wheel that is not in order; nothing is written"
            )


def lines(table: tuple[CalibrationRow, ...], found: Calibration) -> list[str]:
    """The result as lines of text."""
    return render("calibration.txt", table=table, found=found, shown_slip=SHOWN_SLIP).splitlines()


def as_json(table: tuple[CalibrationRow, ...], found: Calibration) -> dict[str, Any]:
    """For ``--json``."""
    parameters = {row.key: {"configured": row.configured, "found": row.found, "sigma": row.sigma} for row in table}
    others = {name: value for name, value in asdict(found).items() if name not in {"radius", "base", "bias"}}
    return {"parameters": parameters, **others, "covariance": found.covariance.tolist()}
