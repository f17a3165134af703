"""``ccatp align --points``: the alignment of points that another instrument measured."""

from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ccatp.config.files import read_input
from ccatp.config.load import load_config
from ccatp.config.models import Config
from ccatp.core import FloatArray, Measured, PointId
from ccatp.errors import UsageError
from ccatp.mirror.foreign_points import (
    Assigned,
    Fitted,
    ForeignPoint,
    Frame,
    PointsError,
    assign,
    fit_frame,
    frame_errors,
    variance_factor,
    world_from,
)
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.mirror.mirror_alignment import SurveyResult, survey_result
from ccatp.mirror.point_file import Reading, is_of_coordinate, parse_points
from ccatp.records.run_reader import CONFIG, check_run_dir

_MOST_BYTES = 1 << 24  # a hundred readings of each of 783 points are 5 MB


class PointOptions(NamedTuple):
    """How a file of points is to be read."""

    points: Path
    references: Path | None
    frame: Frame
    unit: str | None
    offset_m: float
    sigma_m: float | None


class AlignedPoints(NamedTuple):
    """The alignment of the points, and what they show of their own uncertainty."""

    cfg: Config
    mirror: Mirror
    assigned: Assigned
    result: SurveyResult
    fitted: Fitted | None
    factor: float

    @property
    def lines(self) -> list[str]:
        """What the points show of themselves, a line each."""
        lines = [f"{len(self.assigned.measured)} targets on {len(self.result.panels)} panels that could be fitted"]
        if self.fitted is not None:
            residual_um = 1e6 * float(np.sqrt(np.mean(self.fitted.residuals_m**2)))
            lines.append(
                f"frame of the instrument: fitted to {len(self.fitted.residuals_m)} reference points, residuals "
                f"{residual_um:.1f} um rms in a coordinate; panels share its uncertainty"
            )
        if self.assigned.repeat_sigma_m is not None:
            lines.append(
                f"repeated readings: {self.assigned.repeats} scatter by {1e6 * self.assigned.repeat_sigma_m:.1f} um "
                f"along the normal, {1e6 * self.assigned.claimed_sigma_m:.1f} um are claimed"
            )
        if self.assigned.by_position:
            lines.append(
                f"{self.assigned.by_position} readings are assigned to panels by position, as their labels name none: "
                "a mirrored axis along which the mirror is symmetric would not show"
            )
        lines += [
            f"point {'/'.join(map(str, point))} is {self.assigned.labels[point]!r} of the file"
            for point in self._mentioned
            if self.assigned.labels[point] != "/".join(map(str, point))
        ]
        if self.factor > 1.0:
            lines.append(
                f"standard deviations are multiplied by {self.factor**0.5:.2f}: the panels' residuals, or the repeated "
                "readings, are larger than claimed"
            )
        return lines

    @property
    def _mentioned(self) -> list[PointId]:
        """Points that warnings name."""
        found = [
            point
            for panel in self.result.panels
            for point in (*panel.outliers, *((panel.deciding,) if panel.deciding is not None else ()))
        ]
        return [*dict.fromkeys(found)]

    @property
    def data(self) -> dict[str, Any]:
        """The same for ``--json``."""
        assigned, fitted = self.assigned, self.fitted
        return {
            "targets": len(assigned.measured),
            "sigma_factor": round(self.factor**0.5, 4),
            "repeated": assigned.repeats,
            "repeat_sigma_um": assigned.repeat_sigma_m and round(1e6 * assigned.repeat_sigma_m, 4),
            "claimed_sigma_um": round(1e6 * assigned.claimed_sigma_m, 4),
            "reference_residuals_um": fitted and (1e6 * fitted.residuals_m).round(4).tolist(),
            "labels": [{**point._asdict(), "label": label} for point, label in assigned.labels.items()],
        }


def align_points(run_dir: Path | None, settings: Mapping[str, object], options: PointOptions) -> AlignedPoints:
    """Align the points of a file; raises ``PointFileError`` or ``PointsError``: they cannot be used."""
    if run_dir is not None:
        check_run_dir(run_dir)
    cfg = load_config(None if run_dir is None else run_dir / CONFIG, settings)
    if options.sigma_m is not None and not is_of_coordinate(options.sigma_m):
        raise UsageError(
            f"--sigma-um: a sigma of {1e6 * options.sigma_m:.3g} um is none of a coordinate; give it in um"
        )
    mirror = build_mirror(cfg.mirror)
    readings = parse_points(_text(options.points), str(options.points), options.unit)
    own = np.array([one.place_m for one in readings])
    fitted, common_errors = None, None
    if options.frame == "own":
        if options.references is None:
            raise UsageError("--frame own: give --references, the world coordinates of points of the file")
        fitted, readings, own = _in_world(options, options.references, readings, own)
        world = own @ fitted.rotation.T + fitted.shift_m
        common_errors = frame_errors(fitted, world)
        turn = fitted.rotation
    else:
        world = world_from(options.frame, mirror, own)
        turn = world_from(options.frame, mirror, np.eye(3)) - world_from(options.frame, mirror, np.zeros((3, 3)))
        turn = turn.T
    points = [
        ForeignPoint(one.label, one.line, (x, y, z), _covariance(one, options, turn))
        for one, (x, y, z) in zip(readings, world.tolist(), strict=True)
    ]
    assigned = assign(mirror, points, options.offset_m)
    shared = _shared(assigned, points, common_errors)
    planned = {one.point.panel for one in assigned.measured}

    def aligned(measured: tuple[Measured, ...]) -> SurveyResult:
        return survey_result(mirror, cfg.align, options.offset_m, measured, planned, shared)

    factor = variance_factor(aligned(assigned.measured), assigned)
    result = aligned(tuple(_scaled(one, factor) for one in assigned.measured))
    return AlignedPoints(cfg, mirror, assigned, result, fitted, factor)


def _in_world(
    options: PointOptions, references: Path, readings: tuple[Reading, ...], own: FloatArray
) -> tuple[Fitted, tuple[Reading, ...], FloatArray]:
    """The fit of the instrument's frame, and the readings that are no references."""
    world = parse_points(_text(references), str(references), options.unit)
    named = {one.label: one.place_m for one in world}
    if len(named) < len(world):
        raise PointsError(f"{references}: a label stands on two lines; give each reference once")
    known = [at for at, one in enumerate(readings) if one.label in named]
    labels = [readings[at].label for at in known]
    if len(set(labels)) < len(labels):
        raise PointsError(f"{options.points}: a reference label stands on two lines; give each reference once")
    fitted = fit_frame(own[known], np.array([named[label] for label in labels]).reshape(-1, 3))
    rest = [at for at in range(len(readings)) if at not in set(known)]
    return fitted, tuple(readings[at] for at in rest), own[rest]


def _text(path: Path) -> str:
    """The text of a file in UTF-8, or in UTF-16 with a byte order mark, as spreadsheets write it."""
    try:
        data = read_input(path, _MOST_BYTES)
        text = data.decode("utf-16" if data.startswith((BOM_UTF16_LE, BOM_UTF16_BE)) else "utf-8-sig")
    except OSError as error:
        raise PointsError(f"{path}: cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise PointsError(f"{path}: is no text in UTF-8; export it as such") from error
    if "\0" in text:
        raise PointsError(f"{path}: is no text in UTF-8; export it as such")
    return text


def _covariance(one: Reading, options: PointOptions, turn: FloatArray) -> FloatArray:
    if options.sigma_m is not None:
        return options.sigma_m**2 * np.eye(3)
    if one.sigmas_m is None:
        raise PointsError(f"{options.points}:{one.line}: no sigma; add columns sx, sy, sz, or give --sigma-um")
    return np.asarray(turn @ np.diag(np.square(one.sigmas_m)) @ turn.T)


def _shared(
    assigned: Assigned, points: list[ForeignPoint], errors: FloatArray | None
) -> dict[PointId, FloatArray] | None:
    """Errors of the frame, which all targets share; those of the first reading stand for all of a target."""
    if errors is None:
        return None
    at_line = {one.line: errors[at] for at, one in enumerate(points)}
    return {one.point: at_line[round(one.fix.t_s)] for one in assigned.measured}


def _scaled(one: Measured, factor: float) -> Measured:
    covariance = tuple(factor * value for value in one.fix.covariance_m2)
    return Measured(one.point, replace(one.fix, covariance_m2=covariance))
