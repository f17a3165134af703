"""From the fixes of surveys to their network, and from the network to better fixes."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ccatp.config.models import AlignConfig, EtalonConfig
from ccatp.core import GOOD, UNCHECKED, UNRELIABLE, FloatArray, Measured, PointId
from ccatp.mirror.mirror import Mirror
from ccatp.mirror.network_adjustment import NetworkResult, calibrate
from ccatp.mirror.network_model import SurveyLengths

_SOLVED = 4  # lengths of a point
_CHECKED = 5  # lengths of a point that can contradict each other
_HOUR_S = 3600.0


class CommonErrors(NamedTuple):
    """Errors of the points by the network, (3, r) each: change per independent error of standard deviation 1.

    The first ``by_survey`` errors differ between surveys (noise of the lengths, scale, drift); the others come from
    the priors, and are equal in surveys by the same network.
    """

    of_point: Mapping[PointId, FloatArray]
    by_survey: int


class RefinedSurvey(NamedTuple):
    """The fixes of one survey by the adjusted network, their common errors, and how many had no lengths."""

    measured: tuple[Measured, ...]
    common: CommonErrors
    unchanged: int


class CalibratedSurveys(NamedTuple):
    """The network of surveys in the order of measuring, and their fixes by it. ``channels``: of its columns."""

    network: NetworkResult
    channels: tuple[int, ...]
    surveys: tuple[RefinedSurvey, ...]
    points: tuple[tuple[PointId, float], ...]  # of the rows of the network: point and time, s


def calibrate_surveys(
    mirror: Mirror, etalon: EtalonConfig, cfg: AlignConfig, surveys: Sequence[Sequence[Measured]]
) -> CalibratedSurveys | None:
    """Adjust the network by the lengths of surveys in the order of measuring; None without any lengths."""
    channels = tuple(mirror.channels)
    column = {channel: at for at, channel in enumerate(channels)}
    chosen = [[one for one in survey if _has_lengths(one, column)] for survey in surveys]
    rows = [one for survey in chosen for one in survey]
    if not rows:
        return None
    lengths = np.full((len(rows), len(channels)), np.nan)
    for at, one in enumerate(rows):
        for channel, length_m in zip((*one.fix.channels, *one.fix.left_out), one.fix.lengths_m, strict=True):
            lengths[at, column[channel]] = length_m
    collimators = np.array(mirror.collimators_m, dtype=np.float64)
    start = np.array([one.fix.position_m for one in rows])
    distances = np.linalg.norm(start[:, None] - collimators, axis=2)
    given = SurveyLengths(
        lengths_m=lengths,
        sigmas_m=etalon.length_sigma_m + etalon.length_sigma_per_m * distances,
        collimators_m=collimators,
        start_m=start,
        hours=np.concatenate([_hours(survey) for survey in chosen]),
        survey=np.repeat(np.arange(len(surveys)), [len(survey) for survey in chosen]),
    )
    network = calibrate(given, etalon, cfg.network, cfg.false_alarm)
    row_of = iter(range(len(rows)))
    refined = tuple(_refined(survey, column, network, row_of) for survey in surveys)
    return CalibratedSurveys(network, channels, refined, tuple((one.point, one.fix.t_s) for one in rows))


def _has_lengths(one: Measured, column: Mapping[int, int]) -> bool:
    """Whether its lengths are recorded (not in old databases), and are of collimators that the mirror has."""
    fix = one.fix
    named = (*fix.channels, *fix.left_out)
    return len(named) == len(fix.lengths_m) >= _SOLVED and column.keys() >= set(named)


def _hours(survey: Sequence[Measured]) -> FloatArray:
    """Times from the middle; a clock that was set back, as by a restart of the robot, goes on from there."""
    t_s = np.array([one.fix.t_s for one in survey])
    if not len(t_s):
        return t_s
    passed = np.concatenate([[0.0], np.cumsum(np.maximum(np.diff(t_s), 0.0))])
    return np.asarray((passed - 0.5 * passed[-1]) / _HOUR_S)


def _refined(
    survey: Sequence[Measured], column: Mapping[int, int], network: NetworkResult, row_of: Iterator[int]
) -> RefinedSurvey:
    adjusted = network.adjustment
    by_survey = _root(adjusted.by_survey, adjusted.prior)
    by_priors = _root(adjusted.covariance - adjusted.by_survey, adjusted.prior)
    roots = np.hstack([by_survey, by_priors])
    found, common = [], {}
    for one in survey:
        if not _has_lengths(one, column):
            found.append(one)
            continue
        row = next(row_of)
        is_used = np.isfinite(network.given.lengths_m[row]) & ~network.bad_lengths[row]
        metrology = GOOD if is_used.sum() >= _CHECKED else UNCHECKED
        x, y, z = adjusted.points_m[row].tolist()
        common[one.point] = adjusted.moves[row] @ roots
        channels = np.flatnonzero(is_used).tolist()
        fix = replace(
            one.fix,
            position_m=(x, y, z),
            covariance_m2=tuple(adjusted.noise_m2[row].ravel().tolist()),
            metrology=UNRELIABLE if network.bad_points[row] else metrology,
            residual_rms_m=float(np.sqrt(np.mean(adjusted.residuals_m[row, channels] ** 2))),
        )
        found.append(Measured(one.point, fix))
    return RefinedSurvey(tuple(found), CommonErrors(common, by_survey.shape[1]), len(survey) - len(common))


def _root(covariance: FloatArray, prior: FloatArray) -> FloatArray:
    """A matrix R with R R^T = covariance, which may be singular; computed in units of the prior sigmas."""
    unit = np.sqrt(prior)
    values, axes = np.linalg.eigh(covariance / unit[:, None] / unit)
    return np.asarray(unit[:, None] * axes * np.sqrt(np.maximum(values, 0.0)))
