"""Figures of one survey or of two: localization error over time, where the time went, distributions of errors."""

from collections.abc import Mapping, Sequence
from math import floor, log10
from typing import TYPE_CHECKING

import numpy as np

from ccatp.core import FloatArray
from ccatp.report.findings import KINDS, ErrorSeries, TimeBreakdown
from ccatp.report.plots import (
    BAD,
    INK,
    PAPER,
    QUIET,
    SERIES,
    Envelope,
    add_legend,
    distinct,
    envelope,
    is_wide,
    new_plot,
    set_log_axis,
)
from ccatp.report.record import WITHIN_MM

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_ERROR, _SIGMA, _FIX = SERIES[0], SERIES[1], SERIES[2]
_LEAST_MM = 1e-3  # a micrometre: less is of no interest, and of the noise of the laser
_PX_PER_INTERVAL = 2.0
_OF_THE_BUDGET = 0.4  # a few panels are no matter of an hour
_KIND_COLOURS = dict(
    zip(KINDS, (SERIES[1], SERIES[0], SERIES[5], SERIES[2], SERIES[4], SERIES[3], "#6b5b95", QUIET), strict=True)
)


def error_figure(series: ErrorSeries, width_px: float) -> "Figure":
    """Localization error and three sigma over time, and how far each fix moved the estimate; mm, logarithmic.

    Where no truth is known, three sigma and the fixes alone.
    """
    figure, axes = new_plot(width_px, "localization error over time")
    set_log_axis(axes, "y")
    low_mm, high_mm = _ends_mm(series)
    begin_s, end_s = float(series.t_s[0]), max(float(series.t_s[-1]), float(series.t_s[0]) + 1.0)
    axes.set(xlabel="robot time, min", ylabel="mm", xlim=(begin_s / 60.0, end_s / 60.0), ylim=(low_mm, high_mm))
    intervals = max(1, int(width_px / _PX_PER_INTERVAL))
    errors = envelope(series.t_s / 60.0, series.error_mm, intervals)
    if len(errors.x):
        _draw_band(axes, errors, _ERROR, "true error, least to largest", low_mm)
    sigma = envelope(series.t_s / 60.0, series.sigma3_mm, intervals)
    _draw_band(axes, sigma, _SIGMA, "3 \u03c3 of the estimate", low_mm)
    for is_fused, colour, name in ((True, _FIX, "fix: correction"), (False, BAD, "fix, not taken")):
        chosen = series.fix_fused == is_fused
        if chosen.any():
            places = distinct(series.fix_t_s[chosen] / 60.0, np.maximum(series.fix_mm[chosen], low_mm), width_px)
            axes.plot(*places, "o", color=colour, markersize=2.6 if is_wide(width_px) else 1.8, label=name)
    for at_s in series.breaks_s:
        axes.axvline(at_s / 60.0, color=INK, linewidth=0.9, linestyle=":")
    if high_mm >= WITHIN_MM:
        axes.axhline(WITHIN_MM, color=BAD, linewidth=1.0, linestyle="--", label=f"{WITHIN_MM:.0f} mm")
    add_legend(axes)
    return figure


def _ends_mm(series: ErrorSeries) -> tuple[float, float]:
    errors = series.error_mm[np.isfinite(series.error_mm)]
    largest = max(float(np.concatenate([series.sigma3_mm, errors, series.fix_mm]).max()), 0.1)
    usual = float(np.percentile(errors, 2)) if len(errors) else 0.1
    return 10.0 ** floor(log10(max(min(usual, float(series.sigma3_mm.min())), _LEAST_MM))), largest * 1.5


def _draw_band(axes: "Axes", found: Envelope, colour: str, label: str, low: float) -> None:
    """From the least to the largest of each interval; parted where there is nothing for a long time."""
    steps = np.diff(found.x)
    gaps = 1 + np.flatnonzero(steps > 10.0 * np.median(steps)) if len(steps) else np.empty(0, dtype=np.int64)
    x, least, largest = (np.insert(values, gaps, np.nan) for values in found[:3])
    axes.fill_between(x, np.maximum(least, low), np.maximum(largest, low), color=colour, alpha=0.28, linewidth=0.0)
    axes.plot(x, largest, color=colour, linewidth=1.0, label=label)


def time_figure(budgets: Sequence[tuple[str, TimeBreakdown]], budget_s: float, width_px: float) -> "Figure":
    """Where the time went, as bars: what runs took, each above the least that its way takes.

    Args:
        budget_s: what a mission may take; marked where it is near.
    """
    bars: list[tuple[str, dict[str, float]]] = []
    for name, found in budgets:
        bars += [(name, found.spent_s), *([("least", found.least_s)] if found.least_s is not None else [])]
    height_px = 100.0 + 34.0 * len(bars)
    figure, axes = new_plot(width_px, "where the time went", (height_px, height_px + 40.0))
    totals_s = [sum(parts.values()) for _, parts in bars]
    end_s = max(*totals_s, budget_s) if max(totals_s) > _OF_THE_BUDGET * budget_s else max(totals_s)
    left_s = np.zeros(len(bars))
    for kind in KINDS:
        if not any(kind in parts for _, parts in bars):
            continue
        lengths_s = np.array([parts.get(kind, 0.0) for _, parts in bars])
        drawn = axes.barh(range(len(bars)), lengths_s, 0.75, left_s, color=_KIND_COLOURS[kind], label=kind)
        least_px = 9.0 * (end_s / width_px)  # a digit
        texts = [f"{length:.0f}" if length > least_px * (len(f"{length:.0f}") + 1) else "" for length in lengths_s]
        axes.bar_label(drawn, texts, label_type="center", color=PAPER, fontsize=8)
        left_s += lengths_s
    for place, total_s in enumerate(totals_s):
        axes.annotate(
            f"{total_s:.0f} s", (total_s, place), xytext=(4, 0), textcoords="offset points", va="center", fontsize=8,
            color=QUIET,
        )  # fmt: skip
    if end_s >= budget_s:
        axes.axvline(budget_s, color=BAD, linewidth=1.1, linestyle="--", label="budget")
    axes.set_yticks(range(len(bars)), [name for name, _ in bars])
    axes.set(xlabel="time, s", xlim=(0.0, end_s * (1.08 if is_wide(width_px) else 1.2)), ylim=(len(bars) - 0.5, -0.5))
    axes.grid(visible=False, axis="y")
    add_legend(axes)
    return figure


def distribution_figure(values: Mapping[str, FloatArray], label: str, width_px: float) -> "Figure":
    """Share of the values of each run below each number, logarithmic; ``label`` names them with their unit."""
    figure, axes = new_plot(width_px, f"distribution of {label}", (330.0, 300.0))
    set_log_axis(axes, "x")
    everything = np.maximum(np.concatenate(list(values.values())), _LEAST_MM)
    low, high = 10.0 ** np.floor(np.log10(everything.min())), 10.0 ** np.ceil(np.log10(everything.max() * 1.001))
    for (name, some), colour in zip(values.items(), SERIES, strict=False):
        ordered = np.sort(np.maximum(some, _LEAST_MM))
        share = 100.0 * np.arange(1, len(ordered) + 1) / len(ordered)
        axes.step(ordered, share, where="post", color=colour, linewidth=1.4, label=name)
    axes.set(xlabel=label, ylabel="% of them below", xlim=(low, high), ylim=(0.0, 101.0))
    add_legend(axes)
    return figure


def errors_figure(series: Mapping[str, ErrorSeries], width_px: float) -> "Figure":
    """The largest localization error of each time, for each run, and three sigma of the estimate, dashed."""
    figure, axes = new_plot(width_px, "largest localization error over time")
    set_log_axis(axes, "y")
    intervals = max(1, int(width_px / _PX_PER_INTERVAL))
    largest, end_s = 0.01, 6.0
    for (name, found), colour in zip(series.items(), SERIES, strict=False):
        is_known = bool(np.isfinite(found.error_mm).any())
        values = found.error_mm if is_known else found.sigma3_mm
        sigma = envelope(found.t_s / 60.0, found.sigma3_mm, intervals)
        errors = envelope(found.t_s / 60.0, values, intervals)
        axes.plot(sigma.x, sigma.high, color=colour, linewidth=0.8, linestyle="--", alpha=0.7)
        axes.plot(errors.x, errors.high, color=colour, linewidth=1.1, label=name if is_known else f"{name} (3 \u03c3)")
        largest = max(largest, float(sigma.high.max()), float(errors.high.max()))
        end_s = max(end_s, float(found.t_s[-1]))
    limits = {"xlim": (0.0, end_s / 60.0), "ylim": (_LEAST_MM, 1.5 * largest)}
    axes.set(xlabel="robot time, min", ylabel="mm", **limits)
    add_legend(axes)
    return figure
