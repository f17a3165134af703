"""Figures over time: localization errors, time budget."""

from collections.abc import Mapping, Sequence
from math import floor, log10
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ccatp.core import FloatArray
from ccatp.report import plots
from ccatp.report.findings import KINDS, ErrorSeries, TimeBreakdown
from ccatp.report.plots import BAD, INK, QUIET, SERIES, add_legend, envelope, is_wide
from ccatp.report.record import WITHIN_MM

_LEAST_MM = 1e-3  # smaller errors are below the noise of the laser
_PX_PER_INTERVAL = 0.5  # of series over time; finer than a pixel for zoomed figures
_OF_THE_BUDGET = 0.4  # a few panels are no matter of an hour
_KIND_COLOURS = dict(
    zip(KINDS, (SERIES[1], SERIES[0], SERIES[5], SERIES[2], SERIES[4], SERIES[3], "#6b5b95", QUIET), strict=True)
)


def error_figure(series: ErrorSeries, width_px: float) -> Figure:
    """Localization error (if known), three sigma, and the change of the estimate by each fix, over time; mm."""
    axes = plots.new_plot(width_px, "localization error over time", log="y")
    errors = series.error_mm[np.isfinite(series.error_mm)]
    usual_mm = float(np.percentile(errors, 2)) if len(errors) else 0.1
    low_mm = 10.0 ** floor(log10(max(min(usual_mm, float(series.sigma3_mm.min())), _LEAST_MM)))
    high_mm = 1.5 * max(float(np.concatenate([series.sigma3_mm, errors, series.fix_mm]).max()), 0.1)
    axes.set(ylabel="mm", ylim=(low_mm, high_mm))
    bands = (
        ("true error, least to largest", series.error_mm, SERIES[0]),
        ("3 \u03c3 of the estimate", series.sigma3_mm, SERIES[1]),
    )
    for label, values_mm, colour in bands:
        found = envelope(series.t_s / 60.0, values_mm, max(1, int(width_px / _PX_PER_INTERVAL)))
        if not len(found.x):
            continue
        # The band from the smallest to the largest value of each interval, with a break at long gaps.
        steps = np.diff(found.x)
        gaps = 1 + np.flatnonzero(steps > 10.0 * np.median(steps)) if len(steps) else np.empty(0, dtype=np.int64)
        x, least, largest = (np.insert(values, gaps, np.nan) for values in found[:3])
        ends = np.maximum(least, low_mm), np.maximum(largest, low_mm)
        axes.fill_between(x, *ends, color=colour, alpha=0.28, linewidth=0.0)
        axes.plot(x, largest, color=colour, linewidth=1.0, label=label)
    for is_fused, colour, name in ((True, SERIES[2], "fix: correction"), (False, BAD, "fix, not taken")):
        chosen = series.fix_fused == is_fused
        if chosen.any():
            places = plots.distinct(series.fix_t_s[chosen] / 60.0, np.maximum(series.fix_mm[chosen], low_mm), width_px)
            axes.plot(*places, "o", color=colour, markersize=2.6 if is_wide(width_px) else 1.8, label=name)
    for at_s in series.breaks_s:
        axes.axvline(at_s / 60.0, color=INK, linewidth=0.9, linestyle=":")
    if high_mm >= WITHIN_MM:
        axes.axhline(WITHIN_MM, color=BAD, linewidth=1.0, linestyle="--", label=f"{WITHIN_MM:.0f} mm")
    return over_time(axes, series.t_s)


def time_figure(budgets: Sequence[tuple[str, TimeBreakdown]], budget_s: float, width_px: float) -> Figure:
    """Bars of the times of each run by kind, each above the least times of the same way; a line marks the budget."""
    bars: list[tuple[str, dict[str, float]]] = []
    for name, found in budgets:
        bars += [(name, found.spent_s), *([("least", found.least_s)] if found.least_s is not None else [])]
    height_px = 100.0 + 34.0 * len(bars)
    axes = plots.new_plot(width_px, "where the time went", (height_px, height_px + 40.0))
    totals_s = [sum(parts.values()) for _, parts in bars]
    end_s = max(*totals_s, budget_s) if max(totals_s) > _OF_THE_BUDGET * budget_s else max(totals_s)
    left_s = np.zeros(len(bars))
    for kind in KINDS:
        if not any(kind in parts for _, parts in bars):
            continue
        lengths_s = np.array([parts.get(kind, 0.0) for _, parts in bars])
        drawn = axes.barh(range(len(bars)), lengths_s, 0.75, left_s, color=_KIND_COLOURS[kind], label=kind)
        least_px = 9.0 * (end_s / width_px)  # width of a digit, s
        texts = [f"{length:.0f}" if length > least_px * (len(f"{length:.0f}") + 1) else "" for length in lengths_s]
        axes.bar_label(drawn, texts, label_type="center", color=plots.PAPER, fontsize=8)
        left_s += lengths_s
    small: dict[str, Any] = {"textcoords": "offset points", "va": "center", "fontsize": 8, "color": QUIET}
    for place, total_s in enumerate(totals_s):
        axes.annotate(f"{total_s:.0f} s", (total_s, place), xytext=(4, 0), **small)
    if end_s >= budget_s:
        axes.axvline(budget_s, color=BAD, linewidth=1.1, linestyle="--", label="budget")
    axes.set_yticks(range(len(bars)), [name for name, _ in bars])
    axes.set(xlabel="time, s", xlim=(0.0, end_s * (1.08 if is_wide(width_px) else 1.2)), ylim=(len(bars) - 0.5, -0.5))
    axes.grid(visible=False, axis="y")
    return add_legend(axes)


def distribution_figure(values: Mapping[str, FloatArray], label: str, width_px: float) -> Figure:
    """Cumulative distribution of the values of each run, logarithmic axis; ``label``: name with unit."""
    axes = plots.new_plot(width_px, f"distribution of {label}", (330.0, 300.0), log="x")
    everything = np.maximum(np.concatenate(list(values.values())), _LEAST_MM)
    low, high = 10.0 ** np.floor(np.log10(everything.min())), 10.0 ** np.ceil(np.log10(everything.max() * 1.001))
    for (name, some), colour in zip(values.items(), SERIES, strict=False):
        ordered = np.sort(np.maximum(some, _LEAST_MM))
        share = 100.0 * np.arange(1, len(ordered) + 1) / len(ordered)
        axes.step(ordered, share, where="post", color=colour, linewidth=1.4, label=name)
    axes.set(xlabel=label, ylabel="% of them below", xlim=(low, high), ylim=(0.0, 101.0))
    return add_legend(axes)


def errors_figure(series: Mapping[str, ErrorSeries], width_px: float) -> Figure:
    """The largest localization error of each time, for each run, and three sigma of the estimate, dashed."""
    axes = plots.new_plot(width_px, "largest localization error over time", log="y")
    intervals = max(1, int(width_px / _PX_PER_INTERVAL))
    largest, end_s = 0.01, 6.0
    for (name, found), colour in zip(series.items(), SERIES, strict=False):
        is_known = bool(np.isfinite(found.error_mm).any())
        sigma = envelope(found.t_s / 60.0, found.sigma3_mm, intervals)
        errors = envelope(found.t_s / 60.0, found.error_mm, intervals) if is_known else sigma
        axes.plot(sigma.x, sigma.high, color=colour, linewidth=0.8, linestyle="--", alpha=0.7)
        axes.plot(errors.x, errors.high, color=colour, linewidth=1.1, label=name if is_known else f"{name} (3 \u03c3)")
        largest = max(largest, float(sigma.high.max()), float(errors.high.max()))
        end_s = max(end_s, float(found.t_s[-1]))
    axes.set(xlabel="robot time, min", ylabel="mm", xlim=(0.0, end_s / 60.0), ylim=(_LEAST_MM, 1.5 * largest))
    return add_legend(axes)


def over_time(axes: Axes, t_s: FloatArray) -> Figure:
    """A figure whose axis is the time of the robot."""
    begin_s, end_s = (float(t_s.min()), float(t_s.max())) if len(t_s) else (0.0, 60.0)
    axes.set(xlabel="robot time, min", xlim=(begin_s / 60.0, max(end_s, begin_s + 1.0) / 60.0))
    return add_legend(axes)
