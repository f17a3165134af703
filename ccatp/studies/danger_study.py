"""The study `danger`: false edges and overrun of the thesis's edge rule and of the daemon's.

A cell is a mirror (width of the gaps), a speed and a way of crossing: an angle to the seam's normal, or a quarter turn
in place whose sensors move at that speed. Both rules judge the same transits; each stops its own drives to the rim.

The figures of the study `danger`: false edges and overrun against speed and way of crossing.
"""

from collections.abc import Sequence
from math import radians, sqrt
from pathlib import Path
from typing import Any

import numpy as np

from ccatp.core import FloatArray
from ccatp.mirror.mirror import build_mirror
from ccatp.report.plots import dress, new_figure
from ccatp.studies.campaign import Cell, CellResult, Column, Factors, Job, JobOutcome, Study
from ccatp.studies.danger_drives import RULES, EdgeErrors, drive_to_rim, transit
from ccatp.studies.figures import colour, save

_TITLES = {"thesis": "off for 0.1 s (thesis)", "shipped": "travel against the map (ours)"}

_MARGIN_M_S = 0.02


def draw_danger(
    results: Sequence[CellResult], speeds_m_s: Sequence[float], crossings: Sequence[int | str], out: Path
) -> None:
    """Draw ``danger_false_edges_<mirror>`` and ``danger_overrun_<mirror>``, one panel per rule."""
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


SPEEDS_M_S = (0.05, 0.10, 0.15, 0.20)
CROSSINGS: tuple[int | str, ...] = (0, 15, 30, 45, 60, "turn")
TURN = "turn"
_DRIVES = 25  # of each kind in a job
# What a good localizer gives the rules in a disturbed world.
_ERRORS = EdgeErrors(position_m=1.5e-3, heading_rad=2e-3)
_TRANSITS, _RIM = 3, 4  # streams of random numbers of a seed
_Z_95 = 1.96  # quantiles of the normal distribution
_RESAMPLES = 2000


def cells() -> Sequence[Cell]:
    """Speeds times ways of crossing; the engine crosses them with the mirrors."""
    return [Cell({"speed_m_s": v_m_s, "crossing": way}) for v_m_s in SPEEDS_M_S for way in CROSSINGS]


def run_job(job: Job) -> JobOutcome:
    """So many transits, and as many drives to the rim for each rule."""
    cfg, v_m_s, way = job.cfg, float(job.factors["speed_m_s"]), job.factors["crossing"]
    mirror = build_mirror(cfg.mirror)
    angle_rad = None if way == TURN else radians(float(way))
    seed = cfg.run.seed
    found = [
        transit(mirror, cfg, v_m_s, angle_rad, _ERRORS, np.random.default_rng([seed, _TRANSITS, k]))
        for k in range(_DRIVES)
    ]
    false_edges = np.sum(found, axis=0)
    values: dict[str, Any] = {"transits": len(found)}
    arrays: dict[str, FloatArray] = {}
    for k, name in enumerate(RULES):
        values[name] = {"false_edges": int(false_edges[k])}
        if angle_rad is not None:
            # The same draws for both rules: what differs is the rule.
            drives = [
                drive_to_rim(mirror, cfg, v_m_s, angle_rad, name, _ERRORS, np.random.default_rng([seed, _RIM, k]))
                for k in range(_DRIVES)
            ]
            values[name]["falls"] = sum(drive.has_fallen for drive in drives)
            arrays[f"{name}_overrun_m"] = np.array([drive.sensor_m for drive in drives])
    return JobOutcome(values, arrays)


def combine(factors: Factors, outcomes: Sequence[JobOutcome]) -> JobOutcome:
    """Probability of a false edge per transit with its interval, and the distribution of the overrun."""
    del factors
    transits = sum(outcome.values["transits"] for outcome in outcomes)
    values: dict[str, Any] = {"transits": transits}
    arrays: dict[str, FloatArray] = {}
    for name in RULES:
        false_edges = sum(outcome.values[name]["false_edges"] for outcome in outcomes)
        low, high = wilson(false_edges, transits)
        values[name] = {
            "false_edges": false_edges,
            "false_edge_probability": false_edges / transits,
            "false_edge_low": low,
            "false_edge_high": high,
        }
        key = f"{name}_overrun_m"
        kept = [outcome.arrays[key] for outcome in outcomes if key in outcome.arrays]
        if kept:
            arrays[key] = np.concatenate(kept)
            values[name] |= _overrun_figures(arrays[key])
            values[name]["falls"] = sum(outcome.values[name]["falls"] for outcome in outcomes)
    return JobOutcome(values, arrays)


def wilson(hits: int, of: int) -> tuple[float, float]:
    """95 % interval of a probability after ``hits`` out of ``of`` (Wilson 1927); sensible for 0 hits, too.

    Raises:
        ValueError: no trials, or more hits than trials.
    """
    if not 0 <= hits <= of or of == 0:
        raise ValueError(f"{hits} hits out of {of} trials have no probability: count again")
    p, z2 = hits / of, _Z_95 * _Z_95
    centre = (p + z2 / (2.0 * of)) / (1.0 + z2 / of)
    half = _Z_95 / (1.0 + z2 / of) * sqrt(p * (1.0 - p) / of + z2 / (4.0 * of * of))
    return max(centre - half, 0.0), min(centre + half, 1.0)


def bootstrap(values: FloatArray, q: float) -> tuple[float, float]:
    """95 % interval of a quantile by resampling with a fixed seed.

    Args:
        values: the sample, shape (k,).
        q: the quantile, 0 to 1.
    """
    drawn = np.random.default_rng(0).choice(values, (_RESAMPLES, values.size))
    low, high = np.quantile(np.quantile(drawn, q, axis=1), (0.025, 0.975)).tolist()
    return low, high


def _overrun_figures(overrun_m: FloatArray) -> dict[str, Any]:
    low, high = bootstrap(overrun_m, 0.95)
    return {
        "overrun_mean_mm": 1e3 * float(np.mean(overrun_m)),
        "overrun_p95_mm": 1e3 * float(np.quantile(overrun_m, 0.95)),
        "overrun_p95_low_mm": 1e3 * low,
        "overrun_p95_high_mm": 1e3 * high,
        "overrun_max_mm": 1e3 * float(np.max(overrun_m)),
        "drives": overrun_m.size,
    }


def draw(results: Sequence[CellResult], out: Path) -> None:
    """Figures ``danger_false_edges_<mirror>`` and ``danger_overrun_<mirror>``."""
    draw_danger(results, SPEEDS_M_S, CROSSINGS, out)


def _columns() -> list[Column]:
    columns = [Column("transits", "transits")]
    for name in RULES:
        columns += [
            Column(f"{name}: false edges", f"{name}.false_edges"),
            Column("per transit", f"{name}.false_edge_probability", ".3f"),
            Column("95 % low", f"{name}.false_edge_low", ".3f"),
            Column("high", f"{name}.false_edge_high", ".3f"),
            Column("overrun mean, mm", f"{name}.overrun_mean_mm", ".1f"),
            Column("95 % of drives, mm", f"{name}.overrun_p95_mm", ".1f"),
            Column("max, mm", f"{name}.overrun_max_mm", ".1f"),
            Column("falls", f"{name}.falls"),
        ]
    return columns


STUDY = Study(
    name="danger",
    title="False edges and overrun of the thesis's edge rule and of the daemon's",
    cells=cells,
    run_job=run_job,
    combine=combine,
    columns=_columns(),
    draw=draw,
    defaults={"run.world": "hard"},
    mirrors=("fyst-m1", "thesis-m1"),
    runs=12,
)
