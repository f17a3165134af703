"""Pure. The mirror with the driven path, and each point coloured by how near the robot came at its first arrival."""

from math import ceil

import numpy as np

from ccatp.drawing.colours import BAD, INK, PAPER, PATH, QUIET, SMALL_TO_LARGE, ColourScale
from ccatp.drawing.shapes import Dots, FloatArray, Line, Picture, Shape
from ccatp.drawing.thinning import thinned
from ccatp.reporting.map_frame import MapFrame
from ccatp.reporting.points import Grade, PointVerdict
from ccatp.reporting.record import WITHIN_MM, RunRecord
from ccatp.samples import PointId

_TOLERANCE_PX = 0.6
_KEY_LINE = np.array([(-9.0, 0.0), (9.0, 0.0)])


def driven_path_m(record: RunRecord) -> FloatArray:
    """True path where there is one, else the estimated, deck x, y; shape (k, 2), sessions set apart by NaN."""
    pieces: list[FloatArray] = []
    for session in record.sessions:
        source = session.track.place_m if session.truth is None else session.truth.place_m
        pieces += [source[:, :2], np.full((1, 2), np.nan)]
    return np.concatenate(pieces) if pieces else np.empty((0, 2))


def path_figure(record: RunRecord, verdicts: list[PointVerdict], width: float) -> Picture:
    """Draw the map.

    Args:
        record: the run.
        verdicts: of its points.
        width: of the picture, pixels.
    """
    frame = MapFrame(record.mirror, width)
    frame.draw_panels()
    frame.draw_rim()
    path = driven_path_m(record)
    keys: list[tuple[str, Shape]] = []
    if len(path):
        frame.shapes.append(Line(thinned(frame.pixels(path), _TOLERANCE_PX), PATH, 1.0 if frame.is_wide else 0.7))
        keys.append(("true path" if record.has_truth else "estimated path", Line(_KEY_LINE, PATH, 1.6)))
    frame.draw_base()
    keys.append(("base", Dots(np.zeros((1, 2)), 4.0, INK)))
    scale = _scale(verdicts)
    keys += _draw_points(frame, verdicts, scale)
    return frame.finish(scale, "distance at first arrival, mm", keys, f"{record.mirror.name}: path and arrival errors")


def _scale(verdicts: list[PointVerdict]) -> ColourScale:
    errors = np.array([error for v in verdicts if (error := _shown_mm(v)) is not None])
    # A single far one must not make all others look alike.
    usual = float(np.percentile(errors, 98)) if len(errors) else 1.0
    return ColourScale(0.0, min(WITHIN_MM, max(0.1, ceil(usual * 10) / 10)), SMALL_TO_LARGE)


def _shown_mm(verdict: PointVerdict) -> float | None:
    if verdict.left_mm is None:
        return None
    return verdict.left_mm if verdict.first_mm is None else verdict.first_mm


def _draw_points(frame: MapFrame, verdicts: list[PointVerdict], scale: ColourScale) -> list[tuple[str, Shape]]:
    radius = 4.4 if frame.is_wide else 2.2
    shown = [(v, error) for v in verdicts if (error := _shown_mm(v)) is not None]
    levels = scale.levels(np.array([error for _, error in shown])).tolist()
    palette = scale.palette()
    for level in sorted(set(levels)):
        some = [verdict for (verdict, _), own in zip(shown, levels, strict=True) if own == level]
        frame.shapes.append(_dots(frame, some, radius, palette[level]))
    keys: list[tuple[str, Shape]] = []
    for name, grades, mark, colour in (
        ("beyond 10 mm when measured", (Grade.FAIL,), "ring", BAD),
        ("skipped", (Grade.SKIPPED,), "cross", BAD),
        ("not measured", (Grade.OPEN,), "ring", QUIET),
    ):
        some = [v for v in verdicts if v.grade in grades]
        if not some:
            continue
        if mark == "ring" and colour == BAD:  # around the point's own colour
            frame.shapes.append(_dots(frame, some, radius + 2.0, PAPER, BAD))
            frame.shapes.append(_dots(frame, some, radius, palette[-1]))
            keys.append((name, Dots(np.zeros((1, 2)), 4.0, palette[-1], edge=BAD)))
            continue
        size = 0.8 * radius
        places = frame.pixels(np.array([v.place_m for v in some]))
        titles = tuple(map(_title, some)) if frame.is_wide else ()
        dots = Dots(places, size, colour, "cross" if mark == "cross" else "ring", titles)
        frame.shapes.append(dots)
        keys.append((name, Dots(np.zeros((1, 2)), 4.0, colour, dots.mark)))
    return keys


def _dots(frame: MapFrame, some: list[PointVerdict], radius: float, colour: str, edge: str = PAPER) -> Dots:
    titles = tuple(map(_title, some)) if frame.is_wide else ()
    return Dots(frame.pixels(np.array([v.place_m for v in some])), radius, colour, titles=titles, edge=edge)


def _title(verdict: PointVerdict) -> str:
    parts = [f"{point_text(verdict.point)}: {verdict.grade}"]
    if verdict.first_mm is not None:
        parts.append(f"first {verdict.first_mm:.2f} mm")
    if verdict.left_mm is not None:
        parts.append(f"measured at {verdict.left_mm:.2f} mm")
    return ", ".join(parts)


def point_text(point: PointId) -> str:
    """A point as in the commands: row/column/number."""
    return "/".join(map(str, point))
