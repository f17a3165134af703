"""Pure. Localization error over time with three sigma, and how far each fix moved the estimate."""

from itertools import pairwise
from math import floor, log10

import numpy as np

from ccatp.drawing.axes import Axis, Plot, legend
from ccatp.drawing.colours import BAD, INK, SERIES
from ccatp.drawing.shapes import Area, Dots, FloatArray, Line, Picture
from ccatp.drawing.thinning import Envelope, envelope
from ccatp.reporting.errors import ErrorSeries
from ccatp.reporting.record import WITHIN_MM

_ERROR, _SIGMA, _FIX = SERIES[0], SERIES[1], SERIES[2]
_HEIGHT_WIDE, _HEIGHT_NARROW = 300.0, 250.0
_LEAST_MM = 1e-3  # a micrometre: less is of no interest, and of the noise of the laser


def error_figure(series: ErrorSeries, width: float) -> Picture:
    """Draw the series; where no truth is known, three sigma and the fixes alone.

    Args:
        series: of the run.
        width: of the picture, pixels.
    """
    is_wide = width > 500.0
    left, top, right, bottom = 62.0, 10.0, width - 12.0, _HEIGHT_WIDE if is_wide else _HEIGHT_NARROW
    y = Axis(*_ends(series), bottom, top, is_logarithmic=True)
    begin, end = float(series.t_s[0]), max(float(series.t_s[-1]), float(series.t_s[0]) + 1.0)
    plot = Plot(left, top, right, bottom, Axis(begin / 60.0, end / 60.0, left, right), y, 11.5 if is_wide else 10.5)
    plot.frame("robot time, min", "mm")
    intervals = max(1, int((right - left) / 1.5))
    sigma = envelope(series.t_s, series.sigma3_mm, intervals)
    _band(plot, sigma, _SIGMA)
    entries = [("3 \u03c3 of the estimate", _SIGMA)]
    errors = envelope(series.t_s, series.error_mm, intervals)
    if len(errors.x):
        _band(plot, errors, _ERROR)
        entries = [("true error, least to largest", _ERROR), *entries]
    entries += _draw_fixes(plot, series, is_wide)
    for at_s in series.breaks_s:
        x = plot.x.pixel(at_s / 60.0)
        plot.shapes.append(Line(np.array([[x, top], [x, bottom]]), INK, 1.0, (2.0, 3.0)))
    if y.high >= WITHIN_MM:
        plot.level(WITHIN_MM, BAD)
        entries.append(("10 mm", BAD))
    shapes, height = legend(12.0, bottom + 56.0, entries, plot.size, width - 24.0)
    return Picture(width, bottom + 48.0 + height, (*plot.shapes, *shapes), "localization error over time")


def _ends(series: ErrorSeries) -> tuple[float, float]:
    values = np.concatenate([series.sigma3_mm, series.error_mm[np.isfinite(series.error_mm)], series.fix_mm])
    largest = max(float(values.max()), 0.1)
    usual = (
        np.percentile(series.error_mm[np.isfinite(series.error_mm)], 2) if np.isfinite(series.error_mm).any() else 0.1
    )
    low = 10.0 ** floor(log10(max(min(float(usual), float(series.sigma3_mm.min())), _LEAST_MM)))
    return low, largest * 1.5


def _band(plot: Plot, found: Envelope, colour: str) -> None:
    """From least to largest in each interval, and the mean in it."""
    upper, lower = plot.y.pixels(found.high), plot.y.pixels(found.low)
    x = plot.x.pixels(found.x / 60.0)
    for part in _runs(found.x):
        outline = np.concatenate(
            [np.column_stack([x[part], upper[part]]), np.column_stack([x[part], lower[part]])[::-1]]
        )
        plot.shapes.append(Area(outline, fill=colour, opacity=0.28))
        plot.shapes.append(Line(np.column_stack([x[part], upper[part]]), colour, 1.2))


def _runs(x: FloatArray) -> list[slice]:
    """Stretches without a gap."""
    if len(x) < 2:
        return []
    steps = np.diff(x)
    ends = np.flatnonzero(steps > 10.0 * np.median(steps)) + 1
    bounds = [0, *ends.tolist(), len(x)]
    return [slice(a, b) for a, b in pairwise(bounds) if b - a > 1]


def _draw_fixes(plot: Plot, series: ErrorSeries, is_wide: bool) -> list[tuple[str, str]]:
    entries = []
    for is_fused, colour, name in ((True, _FIX, "fix: correction"), (False, BAD, "fix, not taken")):
        chosen = series.fix_fused == is_fused
        if not chosen.any():
            continue
        x, y = plot.x.pixels(series.fix_t_s[chosen] / 60.0), plot.y.pixels(series.fix_mm[chosen])
        places = np.column_stack([x, y])
        places = np.unique(np.rint(places), axis=0)  # what falls on one pixel is one dot
        plot.shapes.append(Dots(places, 1.6 if is_wide else 1.2, colour))
        entries.append((name, colour))
    return entries
