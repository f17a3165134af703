"""Edge. Figures of the radio studies: errors over time, printed values beside ours."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ccatp.studies.campaign import CellResult
from ccatp.studies.figures import INK, LIMIT, QUIET, colour, dress, new_figure, save

_POINT_S = 1.0  # between the points of a curve: ten steps of 0.1 s


def draw_errors(results: Sequence[CellResult], name: str, label: str, keys: Sequence[str], stem: Path) -> None:
    """Median over the runs of an error over time, with 10 to 90 %; a panel for each level of the first key.

    Args:
        results: cells with the array ``name`` of shape (runs, points).
        name: of the array.
        label: of the axis.
        keys: factors that tell the cells apart; the first one makes the panels.
        stem: file without suffix.
    """
    shown = [result for result in results if name in result.arrays]
    if not shown:
        return
    groups = list(dict.fromkeys(result.factors[keys[0]] for result in shown))
    figure = new_figure(5.2 * len(groups) + 0.5, 4.2)
    panels = figure.subplots(1, len(groups), sharey=True, squeeze=False)[0]
    for axes, group in zip(panels, groups, strict=True):
        cells = [result for result in shown if result.factors[keys[0]] == group]
        for index, result in enumerate(cells):
            low, median, high = _quantiles(result.arrays[name])
            time_s = np.arange(median.size) * _POINT_S
            line = {"color": colour(index), "linestyle": "-" if index < 6 else "--"}
            axes.plot(time_s, median, linewidth=1.4, label=_named(result, keys[1:]), **line)
            axes.fill_between(time_s, low, high, color=colour(index), alpha=0.08, linewidth=0)
        axes.set(xlabel="time, s", title=f"{keys[0]}: {group}", ylim=(0.0, None))
        axes.legend(frameon=False, fontsize=7)
    panels[0].set_ylabel(label)
    dress(*panels)
    save(figure, stem)


def draw_cases(results: Sequence[CellResult], names: Sequence[str], stem: Path) -> None:
    """Bars of the printed errors and of ours, for pose and beacons of each case."""
    figure = new_figure(3.4 * len(results) + 0.4, 3.8)
    panels = figure.subplots(1, len(results), sharey=True, squeeze=False)[0]
    shown = [name for name in names if name != "heading_rad"]
    for axes, result in zip(panels, results, strict=True):
        ours = [result.values["pose_m"], *(result.values["beacon_rmse_m"].get(n, np.nan) for n in shown[1:])]
        printed = [result.values["printed"][name] for name in shown]
        at = np.arange(len(shown))
        axes.bar(at - 0.2, printed, 0.38, color=QUIET, label="2017, printed")
        axes.bar(at + 0.2, ours, 0.38, color=colour(0), label="ours, mean of the runs")
        axes.set_xticks(at, ["pose", *(name.replace("beacon", "b") for name in shown[1:])])
        axes.set(title=f"case {result.factors['case']}")
    panels[0].set_ylabel("RMSE, m")
    panels[-1].legend(frameon=False, fontsize=8)
    dress(*panels)
    save(figure, stem)


def draw_signals(results: Sequence[CellResult], ranges_m: Sequence[float], corners: Sequence[str], stem: Path) -> None:
    """Level over range and error of the bearing by beacon: printed, model, ours."""
    figure = new_figure(10.0, 4.0)
    left, right = figure.subplots(1, 2)
    conditions = list(dict.fromkeys(result.factors["condition"] for result in results))
    by_key = {(result.factors["condition"], result.factors["place"]): result.values for result in results}
    for index, condition in enumerate(conditions):
        rows = [by_key.get((condition, f"{range_m:g} m")) for range_m in ranges_m]
        if all(rows):
            _draw_levels(left, [row for row in rows if row], index, str(condition))
        bars = [by_key.get((condition, corner)) for corner in corners]
        if all(bars):
            at = np.arange(len(corners)) + 0.2 * (index - 1)
            heights = [row["bearing_rms_deg"] for row in bars if row]
            right.bar(at, heights, 0.18, color=colour(index), label=f"ours, RMS: {condition}")
    first = [by_key.get((conditions[0], corner)) for corner in corners]
    printed = [row["printed"]["bearing_error_deg"] for row in first if row]
    right.plot(np.arange(len(printed)), printed, "x", color=LIMIT, markersize=8, markeredgewidth=2, label="2017")
    right.set_xticks(np.arange(len(corners)), list(corners))
    right.set(ylabel="error of the bearing, deg", title="bearing of the strongest reading")
    left.set(xlabel="range, m", ylabel="level, dBm", title="mean level of a scan")
    for axes in (left, right):
        axes.legend(frameon=False, fontsize=7)
    dress(left, right)
    save(figure, stem)


def _draw_levels(axes: Any, rows: Sequence[Any], index: int, condition: str) -> None:
    ranges = [row["range_m"] for row in rows]
    if index == 0:
        axes.plot(ranges, [row["model_dbm"] for row in rows], color=INK, linewidth=1.2, label="model")
        printed = [row["printed"]["level_dbm"] for row in rows]
        axes.plot(ranges, printed, "x", color=LIMIT, markersize=8, markeredgewidth=2, label="2017")
    levels, sigmas = ([row[key] for row in rows] for key in ("level_dbm", "level_sigma_db"))
    shifted = [range_m + 0.03 * (index - 1) for range_m in ranges]
    axes.errorbar(
        shifted, levels, sigmas, fmt="o", color=colour(index), markersize=4, capsize=2, label=f"ours: {condition}"
    )


def _quantiles(runs: Any) -> tuple[Any, Any, Any]:
    """10, 50 and 90 % over the runs; NaN where none has an estimate yet."""
    known = np.isfinite(runs).any(axis=0)
    found = np.full((3, runs.shape[1]), np.nan)
    found[:, known] = np.nanquantile(runs[:, known], (0.1, 0.5, 0.9), axis=0)
    return found[0], found[1], found[2]


def _named(result: CellResult, keys: Sequence[str]) -> str:
    return ", ".join(f"every {result.factors[k]}" if k == "every" else str(result.factors[k]) for k in keys)
