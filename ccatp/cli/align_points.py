"""``ccatp align --points``: the alignment of points that another instrument measured."""

from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.special import chdtr

from ccatp.config.files import read_input
from ccatp.config.load import load_config
from ccatp.config.models import Config
from ccatp.core import FloatArray, Measured, PointId
from ccatp.errors import UsageError
from ccatp.mirror.foreign_points import (
    Assigned,
    CommonFigure,
    Fitted,
    ForeignPoint,
    Frame,
    OffHeight,
    PointsError,
    assign,
    common_figure,
    fit_frame,
    frame_errors,
    world_from,
)
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.mirror.mirror_alignment import SurveyResult, survey_result
from ccatp.mirror.point_file import Reading, is_of_coordinate, parse_points
from ccatp.records.run_reader import CONFIG, check_run_dir

_CAUTIOUS = 2.0
_MOST_BYTES = 1 << 24  # a hundred readings of each of 783 points are 5 MB
_NAMED = 12  # largest number of panels, and of points, that a line names


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
    figure: CommonFigure | None

    @property
    def factor(self) -> float:
        """By which the claimed standard deviations are multiplied."""
        repeats = self.assigned.repeats
        return self.result.sigma_factor * (1.0 if repeats is None else repeats.excess**0.5)

    @property
    def lines(self) -> list[str]:
        """What the points show of themselves, a line each."""
        lines = [f"{len(self.assigned.labels)} targets on {len(self.result.panels)} panels that could be fitted"]
        if self.fitted is not None:
            residual_um = 1e6 * float(np.sqrt(np.mean(self.fitted.residuals_m**2)))
            lengths_um = 1e6 * np.linalg.norm(self.fitted.residuals_m, axis=1)
            worst = int(np.argmax(lengths_um))
            lines.append(
                f"frame of the instrument: fitted to {len(self.fitted.residuals_m)} reference points, residuals "
                f"{residual_um:.1f} um rms in a coordinate, the largest {lengths_um[worst]:.1f} um at "
                f"{self.fitted.labels[worst]}; panels share its uncertainty"
            )
        lines += [_off_line(one) for one in self.assigned.off_height]
        if (figure := self.figure) is not None:
            lines.append(
                f"the panels have in common {1e3 * figure.common_m:.3f} mm rms ({1e3 * figure.mean_m:+.3f} mm in the "
                f"mean), and {1e3 * figure.own_m:.3f} mm rms of their own: check the target's offset, and frame and "
                "scale of the instrument; the moves contain it, the standard deviations do not"
            )
        if (repeats := self.assigned.repeats) is not None:
            lines.append(
                f"repeated readings: {repeats.readings} scatter by {1e6 * repeats.sigma_m:.1f} um along the normal, "
                f"{1e6 * repeats.claimed_m:.1f} um are claimed"
                + (f"; standard deviations are multiplied by {repeats.excess**0.5:.2f}" if repeats.excess > 1.0 else "")
            )
            if repeats.shift_m:
                lines.append(
                    f"the readings of a panel are shifted together by {1e6 * repeats.shift_m:.1f} um from one to the "
                    "next: two nights, or two frames; align each on its own. All panels share the uncertainty"
                )
        if self.assigned.contradictions:
            lines.append(self._contradictions)
        chi2 = sum(panel.fit.chi2 for panel in self.result.panels)
        dof = sum(panel.fit.dof for panel in self.result.panels)
        # Sigmas that are twice too large are a cautious statement; beyond that they have another unit or meaning.
        if dof > 0 and chi2 < dof / _CAUTIOUS**2 and float(chdtr(dof, chi2)) < self.cfg.align.false_alarm:
            lines.append(
                f"the points scatter about the panels by {np.sqrt(chi2 / dof):.2g} times their standard deviations: "
                "these seem to be too large; check their unit, and of how many sigmas they are"
            )
        if self.assigned.copies:
            lines.append(f"{self.assigned.copies} readings are copies of others to the last digit, and count once")
        if self.assigned.by_position:
            lines.append(
                f"{self.assigned.by_position} readings are assigned to panels by position, as no label names their "
                "panel: a mirrored axis along which the mirror is symmetric would not show"
            )
        lines += [
            f"point {'/'.join(map(str, point))} is {self.assigned.labels[point]!r} of the file"
            for point in self._mentioned
            if self.assigned.labels[point] != "/".join(map(str, point))
        ]
        if self.assigned.row_first:
            lines.append("names as 12281 are read as telescope, mirror, row, column, number: so the points lie on them")
        return lines

    @property
    def _contradictions(self) -> str:
        """Points whose readings contradict each other, and which of these readings are not used."""
        unused = defaultdict[PointId, list[int]](list)
        lines = defaultdict[PointId, list[int]](list)
        for one in self.assigned.measured:
            lines[one.point].append(round(one.fix.t_s))
        for panel in self.result.panels:
            own = iter([line for point in sorted(set(panel.deviations.points)) for line in lines[point]])
            for point, line, kept in zip(panel.deviations.points, own, panel.is_kept, strict=True):
                if not kept:
                    unused[point].append(line)
        found = self.assigned.contradictions
        names = [
            f"{'/'.join(map(str, point))} by {1e6 * range_m:.1f} um (lines {', '.join(map(str, lines[point]))}; "
            f"{'not used: ' + ', '.join(map(str, unused[point])) if unused[point] else 'all used'})"
            for point, range_m in found.items()
        ]
        more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
        return (
            f"readings of a point contradict each other, and each counts on its own: {', '.join(names[:_NAMED])}{more}"
        )

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
        assigned, fitted, repeats = self.assigned, self.fitted, self.assigned.repeats
        return {
            "targets": len(assigned.labels),
            "sigma_factor": round(self.factor, 4),
            "repeated": repeats.readings if repeats else 0,
            "repeat_sigma_um": repeats and round(1e6 * repeats.sigma_m, 4),
            "claimed_sigma_um": round(1e6 * repeats.claimed_m, 4) if repeats else 0.0,
            "repeat_shift_um": repeats and round(1e6 * repeats.shift_m, 4),
            "reference_residuals_um": fitted and (1e6 * fitted.residuals_m).round(4).tolist(),
            "contradictions": [
                {**point._asdict(), "range_um": round(1e6 * range_m, 4)}
                for point, range_m in assigned.contradictions.items()
            ],
            "off_height": [
                {
                    "off_um": round(1e6 * one.off_m, 1),
                    "panels": [panel._asdict() for panel in one.panels],
                    "points": [point._asdict() for point in one.points],
                }
                for one in assigned.off_height
            ],
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
    assigned = assign(mirror, points, options.offset_m, cfg.align.false_alarm)
    repeats = assigned.repeats
    measured = tuple(_scaled(one, 1.0 if repeats is None else repeats.excess) for one in assigned.measured)
    planned = {one.point.panel for one in measured}
    shared = _shared(assigned, points, common_errors)
    result = survey_result(mirror, cfg.align, options.offset_m, measured, planned, shared, assigned.readings)
    figure = common_figure(mirror, result, cfg.align.false_alarm)
    return AlignedPoints(cfg, mirror, assigned, result, fitted, figure)


def _off_line(one: OffHeight) -> str:
    """What lies too high or too low, and why that may be."""
    panels = [f"{row}/{col}" for row, col in one.panels]
    points = [f"{row}/{col}/{number}" for row, col, number in one.points]
    names = [
        f"{kind}{'s' if len(some) > 1 else ''} {', '.join(some[:_NAMED])}"
        + (f" and {len(some) - _NAMED} more" if len(some) > _NAMED else "")
        for kind, some in (("panel", panels), ("point", points))
        if some
    ]
    return (
        f"{1e3 * abs(one.off_m):.2f} mm {'higher' if one.off_m > 0 else 'lower'} than the target's offset says: "
        f"{' and '.join(names)}; another target nest, or a wrong offset? a panel is hardly so far off, and its moves "
        "contain it; give these points in a file of their own with their offset"
    )


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
    fitted = fit_frame(own[known], np.array([named[label] for label in labels]).reshape(-1, 3), labels)
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
    """Errors that all targets share: of the frame (those of the first reading stand for all of a target), of shifts."""
    if errors is None:
        return dict(assigned.shifts) or None
    at_line = {one.line: errors[at] for at, one in enumerate(points)}
    frame = {one.point: at_line[round(one.fix.t_s)] for one in assigned.measured}
    return {
        point: np.hstack([of_frame, assigned.shifts.get(point, np.zeros((3, 0)))]) for point, of_frame in frame.items()
    }


def _scaled(one: Measured, factor: float) -> Measured:
    covariance = tuple(factor * value for value in one.fix.covariance_m2)
    return Measured(one.point, replace(one.fix, covariance_m2=covariance))
