"""Edge. The figures of the study `thesis`, each after one of the thesis's: 2.9 to 2.12, 3.10 and 3.11."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ccatp.studies.campaign import CellResult
from ccatp.studies.figures import INK, LIMIT, QUIET, colour, dress, new_figure, save
from ccatp.studies.spread import Spread

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_NUMBERS = {"normal": ("2.9", "2.10", "3.10"), "twice": ("2.11", "2.12", "3.11")}
_LIMIT_MM = 10.0
_BIN_MM = 1.0


def draw_thesis(
    results: Sequence[CellResult], published: Mapping[str, Mapping[str, Mapping[str, float]]], out: Path
) -> None:
    """Draw the figures of both noises.

    * ``trajectory_<noise>``: true and estimated way of the first run, the thesis's system with both readings.
    * ``localization_<noise>``: cumulative distribution of the localization error, every cell.
    * ``waypoints_<noise>``: the waypoint errors of all runs, and their histogram.

    Args:
        results: cells.
        published: the thesis's figures by noise and quantity.
        out: directory.
    """
    for noise, numbers in _NUMBERS.items():
        mine = [result for result in results if result.factors["noise"] == noise]
        nearest = [r for r in mine if r.factors["noise_is_variance"] and r.factors["period_error"]][:1]
        if mine:
            title = f"{noise} noise, as fig. {numbers[1]}"
            _draw_localization(mine, published[noise]["localization"], title, out / f"localization_{noise}")
        for result in nearest:
            _draw_trajectory(result, f"{noise} noise, as fig. {numbers[0]}", out / f"trajectory_{noise}")
            title = f"{noise} noise, as fig. {numbers[2]}"
            _draw_waypoints(result, published[noise]["waypoint"], title, out / f"waypoints_{noise}")


def _draw_trajectory(result: CellResult, title: str, stem: Path) -> None:
    track = np.asarray(result.arrays["track"], dtype=np.float64)
    figure = new_figure(6.4, 6.0)
    axes = figure.subplots()
    axes.plot(track[:, 1], track[:, 2], color=colour(0), linewidth=1.6, label="true")
    axes.plot(track[:, 3], track[:, 4], color=colour(1), linewidth=0.9, linestyle="--", label="estimated")
    axes.set_aspect("equal")
    axes.set_xlabel("x, m")
    axes.set_ylabel("y, m")
    axes.set_title(f"Way of one run, {title}")
    axes.legend(frameon=False, fontsize=8)
    dress(axes)
    save(figure, stem)


def _draw_localization(results: Sequence[CellResult], published: Mapping[str, float], title: str, stem: Path) -> None:
    figure = new_figure(7.2, 5.2)
    axes = figure.subplots()
    for k, result in enumerate(results):
        values, beyond = Spread.from_arrays(dict(result.arrays), "localization").exceedance()
        is_ours = result.factors["system"] == "ours"
        axes.semilogx(
            1e3 * values,
            1.0 - beyond,
            color=colour(k),
            linestyle=":" if is_ours else "-",
            linewidth=1.5,
            label=_reading(result.factors),
        )
    axes.plot(
        [_LIMIT_MM, published["max"]], [published["within_10mm_fraction"], 1.0], "x", color=INK, label="published"
    )
    axes.axvline(_LIMIT_MM, color=LIMIT, linewidth=0.9)
    axes.set_xlim(0.01, 100.0)
    axes.set_xlabel("distance between true and estimated position, mm")
    axes.set_ylabel("share of all instants below")
    axes.set_title(f"Localization error, {title}")
    figure.legend(loc="outside lower center", ncols=2, frameon=False, fontsize=8)
    dress(axes)
    save(figure, stem)


def _draw_waypoints(result: CellResult, published: Mapping[str, float], title: str, stem: Path) -> None:
    errors = 1e3 * np.asarray(result.arrays["waypoint_m"])
    figure = new_figure(9.0, 3.6)
    left, right = figure.subplots(1, 2, width_ratios=(2, 1), sharey=True)
    left.plot(np.arange(1, errors.size + 1), errors, ".", color=colour(0), markersize=4)
    right.hist(errors, bins=np.arange(0.0, max(errors.max(initial=0.0), _LIMIT_MM) + _BIN_MM, _BIN_MM),
               orientation="horizontal", color=colour(0))  # fmt: skip
    for axes in (left, right):
        _mark(axes, published)
    left.set_xlabel("waypoint, one run after the other")
    left.set_ylabel("distance of the stop, mm")
    right.set_xlabel("waypoints")
    within = float(np.mean(errors < _LIMIT_MM)) if errors.size else float("nan")
    figure.suptitle(
        f"Waypoint error, {title}: {100.0 * within:.1f} % below 1 cm "
        f"(published {100.0 * published['within_10mm_fraction']:.2f} %)",
        fontsize=10,
    )
    right.legend(frameon=False, fontsize=7)
    dress(left, right)
    save(figure, stem)


def _mark(axes: "Axes", published: Mapping[str, float]) -> None:
    axes.axhline(_LIMIT_MM, color=LIMIT, linewidth=0.9, label="1 cm")
    axes.axhline(published["mean"], color=QUIET, linewidth=0.9, linestyle="--", label="published mean")
    axes.axhline(published["max"], color=QUIET, linewidth=0.9, linestyle=":", label="published largest")


def _reading(factors: Mapping[str, Any]) -> str:
    who = "ekf, shipped control" if factors["system"] == "ours" else "kf, thesis's control"
    noise = "variances" if factors["noise_is_variance"] else "standard deviations"
    late = 100.0 * float(factors["period_error"])
    return f"{who}: {noise}{f', period {late:.1f} % long' if late else ''}"
