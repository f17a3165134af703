"""Edge. The figures of the study `danger`: false edges and overrun against speed and way of crossing."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ccatp.studies.campaign import CellResult
from ccatp.studies.danger_drives import RULES
from ccatp.studies.figures import colour, dress, new_figure, save

_TITLES = {"thesis": "off for 0.1 s (thesis)", "shipped": "travel against the map (ours)"}

_MARGIN_M_S = 0.02


def draw_danger(
    results: Sequence[CellResult], speeds_m_s: Sequence[float], crossings: Sequence[int | str], out: Path
) -> None:
    """Draw ``danger_false_edges_<mirror>`` and ``danger_overrun_<mirror>``, one panel per rule.

    Args:
        results: cells.
        speeds_m_s, crossings: levels of the factors, in the order of the axis and of the lines.
        out: directory.
    """
    for mirror in dict.fromkeys(str(result.factors["mirror"]) for result in results):
        mine = {
            (result.factors["speed_m_s"], result.factors["crossing"]): result
            for result in results
            if result.factors["mirror"] == mirror
        }
        _draw_false_edges(mirror, mine, speeds_m_s, crossings, out)
        _draw_overrun(mirror, mine, speeds_m_s, crossings, out)


def _draw_false_edges(
    mirror: str, cells: dict[Any, CellResult], speeds: Sequence[float], crossings: Sequence[int | str], out: Path
) -> None:
    figure = new_figure(9.0, 3.8)
    panels = figure.subplots(1, len(RULES), sharey=True)
    for axes, rule in zip(panels, RULES, strict=True):
        for k, way in enumerate(crossings):
            known = [v for v in speeds if (v, way) in cells]
            figures = [cells[v, way].values[rule] for v in known]
            p = np.array([one["false_edge_probability"] for one in figures])
            low = np.array([one["false_edge_low"] for one in figures])
            high = np.array([one["false_edge_high"] for one in figures])
            # Side by side, so that intervals at the same speed can be told apart.
            at = np.array(known) + 0.0035 * (k - 0.5 * (len(crossings) - 1))
            bars = np.maximum(np.vstack([p - low, high - p]), 0.0)
            label = "turning in place" if isinstance(way, str) else f"{way}°"
            axes.errorbar(at, p, bars, color=colour(k), marker="o", markersize=4, linewidth=1.2, capsize=2, label=label)
        axes.set_title(_TITLES[rule], fontsize=10)
        axes.set_xlabel("speed of the robot, in turns of the sensors, m/s", fontsize=9)
        axes.set_xticks(list(speeds))
        axes.set_xlim(min(speeds) - _MARGIN_M_S, max(speeds) + _MARGIN_M_S)
        axes.set_ylim(-0.03, 1.03)
    panels[0].set_ylabel("false edges per transit (95 %)", fontsize=9)
    figure.legend(
        *panels[0].get_legend_handles_labels(),
        loc="outside lower center",
        ncols=len(crossings),
        frameon=False,
        fontsize=8,
    )
    figure.suptitle(f"A seam taken for an edge, {mirror}", fontsize=11)
    dress(*panels)
    save(figure, out / f"danger_false_edges_{mirror}")


def _draw_overrun(
    mirror: str, cells: dict[Any, CellResult], speeds: Sequence[float], crossings: Sequence[int | str], out: Path
) -> None:
    angles = [way for way in crossings if not isinstance(way, str)]
    figure = new_figure(9.0, 3.8)
    panels = figure.subplots(1, len(RULES), sharey=True)
    for axes, rule in zip(panels, RULES, strict=True):
        for k, way in enumerate(angles):
            known = [v for v in speeds if (v, way) in cells]
            samples = [1e3 * cells[v, way].arrays[f"{rule}_overrun_m"] for v in known]
            at = np.array(known) + 0.0045 * (k - 0.5 * (len(angles) - 1))
            boxes = axes.boxplot(
                samples, positions=at, widths=0.004, whis=(0, 100), manage_ticks=False, patch_artist=True
            )
            for box in boxes["boxes"]:
                box.set(facecolor=colour(k), edgecolor=colour(k))
            for part in (*boxes["whiskers"], *boxes["caps"]):
                part.set_color(colour(k))
            for line in boxes["medians"]:
                line.set_color("white")
            axes.plot([], [], "s", color=colour(k), label=f"{way}°")
        axes.axhline(0.0, color="black", linewidth=0.8)
        axes.set_title(_TITLES[rule], fontsize=10)
        axes.set_xlabel("speed, m/s", fontsize=9)
        axes.set_xticks(list(speeds))
        axes.set_xlim(min(speeds) - _MARGIN_M_S, max(speeds) + _MARGIN_M_S)
    panels[0].set_ylabel("furthest sensor beyond the rim, mm", fontsize=9)
    figure.legend(
        *panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=len(angles), frameon=False, fontsize=8
    )
    figure.suptitle(f"Where a drive over the rim ends: quartiles and range, {mirror}", fontsize=11)
    dress(*panels)
    save(figure, out / f"danger_overrun_{mirror}")
