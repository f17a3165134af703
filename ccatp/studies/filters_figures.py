"""Edge. The figures of the study `filters`."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ccatp.samples import FloatArray
from ccatp.studies.campaign import CellResult
from ccatp.studies.consistency import nees
from ccatp.studies.figures import GRID, INK, LIMIT, QUIET, colour, dress, new_figure, save
from ccatp.studies.mission_cell import first_arrivals, spread_of
from ccatp.studies.mission_job import COLUMN

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Curve = tuple[FloatArray, FloatArray]

_SHOWN_MM = (0.01, 300.0)
_LIMIT_MM = 10.0
_DASHES = ("-", "--", ":")  # curves that coincide stay visible
_CONSISTENT = {"NEES of the pose": 3.0, "NEES of the position": 2.0, "NIS of the fixes": 2.0}


def draw_filters(cells: Sequence[CellResult], out: Path) -> None:
    """Exceedance of localization and arrival errors, stop errors beside their bound, consistency."""
    for mirror in dict.fromkeys(str(cell.factors["mirror"]) for cell in cells):
        there = [cell for cell in cells if cell.factors["mirror"] == mirror]
        _draw_exceedance(there, _localization, f"Localization error on {mirror}", out / f"localization-{mirror}")
        _draw_exceedance(there, _arrival, f"First arrival error on {mirror}", out / f"arrival-{mirror}")
        _draw_bound(there, out / f"bound-{mirror}")
        _draw_consistency(there, out / f"consistency-{mirror}")


def _localization(cell: CellResult) -> Curve:
    values, share = spread_of(cell.arrays, "localization").exceedance()
    return 1e3 * values, share


def _arrival(cell: CellResult) -> Curve:
    rows = first_arrivals(cell.arrays["stops"][:, 1:])
    values = np.sort(rows[:, COLUMN["arrival_m"]])
    return 1e3 * values, 1.0 - np.arange(len(values)) / max(len(values), 1)  # this large or larger: shows the largest


def _draw_exceedance(cells: Sequence[CellResult], curve: Callable[[CellResult], Curve], title: str, stem: Path) -> None:
    worlds, filters = _levels(cells, "world"), _levels(cells, "filter")
    columns = min(2, len(worlds))
    rows = -(-len(worlds) // columns)
    figure = new_figure(4.4 * columns, 3.1 * rows + 0.5)
    panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).ravel()
    lowest = 1.0
    for axes, world in zip(panels, worlds, strict=False):
        for cell in cells:
            if cell.factors["world"] == world:
                name = str(cell.factors["filter"])
                values, share = curve(cell)
                is_seen = share > 0.0
                lowest = min(lowest, float(share[is_seen].min(initial=1.0)))
                axes.loglog(
                    values[is_seen], share[is_seen], color=colour(filters.index(name)), label=name, linewidth=1.6,
                    linestyle=_DASHES[filters.index(name) % len(_DASHES)],
                )  # fmt: skip
        axes.axvline(_LIMIT_MM, color=LIMIT, linewidth=1.0, linestyle=":")
        axes.set(xlim=_SHOWN_MM, title=f"world {world}")
    for axes in panels[len(worlds) :]:
        axes.set_visible(False)
    panels[0].set_ylim(max(lowest, 1e-6) * 0.8, 1.3)
    panels[0].text(_LIMIT_MM * 1.08, 0.9, "10 mm", color=LIMIT, fontsize=8, va="top")
    figure.supxlabel("error, mm", fontsize=9)
    figure.supylabel("share of all that is as large", fontsize=9)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=len(labels), frameon=False, fontsize=9)
    figure.suptitle(title, fontsize=11, x=0.02, ha="left")
    dress(*panels)
    save(figure, stem)


def _draw_bound(cells: Sequence[CellResult], stem: Path) -> None:
    """Rms error at the stops of each filter, and the bound of each world as a line under it."""
    worlds, filters = _levels(cells, "world"), _levels(cells, "filter")
    figure = new_figure(6.4, 3.8)
    axes = figure.subplots()
    for cell in cells:
        bound = cell.values["bound"]
        if bound["rms_mm"] is None:
            continue
        index = filters.index(str(cell.factors["filter"]))
        at = worlds.index(str(cell.factors["world"])) + 0.22 * (index - 0.5 * (len(filters) - 1))
        tight = bound["with_accelerometer"]["rms_mm"]
        axes.plot([at - 0.09, at + 0.09], [bound["rms_mm"]] * 2, color=INK, linewidth=1.5)
        axes.plot([at - 0.09, at + 0.09], [tight] * 2, color=INK, linewidth=1.0, linestyle=":")
        axes.plot([at, at], [bound["rms_mm"], bound["error_rms_mm"]], color=GRID, linewidth=2.0, zorder=1)
        axes.plot(at, bound["error_rms_mm"], "o", color=colour(index), markersize=6)
        axes.annotate(
            f"{bound['ratio']:.3g}", (at, max(bound["error_rms_mm"], bound["rms_mm"])), xytext=(0, 7),
            textcoords="offset points", ha="center", fontsize=7, color=QUIET,
        )  # fmt: skip
    for index, name in enumerate(filters):
        axes.plot([], [], "o", color=colour(index), label=name)
    axes.plot([], [], color=INK, linewidth=1.5, label="posterior Cramér-Rao bound")
    axes.plot([], [], color=INK, linewidth=1.0, linestyle=":", label="with the accelerometer")
    axes.set_yscale("log")
    known = [cell.values["bound"] for cell in cells if cell.values["bound"]["rms_mm"]]
    shown = [bound[name] for bound in known for name in ("rms_mm", "error_rms_mm")] or [1.0]
    axes.set_ylim(10.0 ** np.floor(np.log10(min(shown))), 10.0 ** np.ceil(np.log10(1.5 * max(shown))))
    axes.set_xticks(range(len(worlds)), worlds)
    axes.set(ylabel="rms position error at the stops, mm", title="Stop errors and the least possible; numbers: ratio")
    dress(axes)
    figure.legend(loc="outside lower center", ncols=len(filters) + 2, frameon=False, fontsize=8)
    save(figure, stem)


def _draw_consistency(cells: Sequence[CellResult], stem: Path) -> None:
    """Normalised errors: medians and the middle 90 %, the mean as a dot, what a consistent filter has as a line."""
    worlds, filters = _levels(cells, "world"), _levels(cells, "filter")
    figure = new_figure(9.6, 3.6)
    panels = figure.subplots(1, len(_CONSISTENT), sharey=True)
    for axes, (title, expected) in zip(panels, _CONSISTENT.items(), strict=True):
        for cell in cells:
            index = filters.index(str(cell.factors["filter"]))
            at = worlds.index(str(cell.factors["world"])) + 0.22 * (index - 0.5 * (len(filters) - 1))
            _draw_range(axes, at, _normalised(cell, title), colour(index))
        axes.axhline(expected, color=LIMIT, linewidth=1.0, linestyle=":")
        axes.set_yscale("log")
        axes.set_xticks(range(len(worlds)), worlds)
        axes.set_title(f"{title} (consistent: {expected:g})")
    for index, name in enumerate(filters):
        panels[0].plot([], [], "o", color=colour(index), label=name)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False, fontsize=9)
    panels[0].set_ylabel("mean (dot), 5 to 95 % (bar)")
    dress(*panels)
    save(figure, stem)


def _draw_range(axes: "Axes", at: float, values: FloatArray, shade: str) -> None:
    known = values[np.isfinite(values)]
    if known.size:
        low, high = np.percentile(known, (5.0, 95.0))
        axes.plot([at, at], [max(low, 1e-3), high], color=shade, linewidth=3.0, alpha=0.35, solid_capstyle="round")
        axes.plot(at, known.mean(), "o", color=shade, markersize=5)


def _normalised(cell: CellResult, title: str) -> FloatArray:
    stops = cell.arrays["stops"][:, 1:]
    if title.startswith("NIS"):
        return np.asarray(stops[:, COLUMN["nis"]], dtype=np.float64)
    return nees(first_arrivals(stops), 3 if "pose" in title else 2)


def _levels(cells: Sequence[CellResult], factor: str) -> list[str]:
    return list(dict.fromkeys(str(cell.factors[factor]) for cell in cells))
