"""The study `cricket`: figures 9 to 14 of Patil et al. again, and better ways beside them, at their cost.

Figures of the study `cricket`, as PNG and PDF.
"""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ccatp.config.load import load_radio_config
from ccatp.report.plots import INK, QUIET, dress, new_figure
from ccatp.studies.campaign import Cell, CellResult, Column, Factors, Job, JobOutcome, Study
from ccatp.studies.figures import LIMIT, colour, save
from ccatp.studies.mote_runs import look_ahead, run_batch, run_filter, simulate_field

if TYPE_CHECKING:
    from matplotlib.axes import Axes


_POOR = ("zigzag-printed", "zigzag-p0-99", "zigzag-pooled")
_FULL = ("adjacent-printed", "all-printed", "all-p0-99", "all-pooled")
_MAPS = (("zigzag-printed", "figures 9, 10: five pairs"), ("all-printed", "figure 13: fifteen pairs"))
_CLOUD = 200  # runs shown as dots


def draw_cricket(cells: Sequence[CellResult], out: Path) -> None:
    """Traces (figures 11, 12, 14), clouds of maps (9, 10, 13), all ways beside each other."""
    found = {str(cell.factors["case"]): cell for cell in cells}
    for stem, names, title, goal_m in (
        ("figure_11_12", _POOR, "Few measurements: five pairs in a zigzag", 0.15),
        ("figure_14", _FULL, "Many measurements: nine adjacent pairs, or all fifteen", 0.005),
    ):
        shown = [name for name in names if name in found]
        if shown:
            _draw_traces(found, shown, title, goal_m, out / stem)
    maps = [(name, title) for name, title in _MAPS if name in found]
    if maps:
        _draw_maps(found, maps, out / "figure_9_10_13")
    _draw_ways(cells, out / "ways")


def _draw_traces(found: Mapping[str, CellResult], names: Sequence[str], title: str, goal_m: float, stem: Path) -> None:
    figure = new_figure(8.5, 5.2)
    axes = figure.subplots()
    for number, name in enumerate(names):
        low, middle, high = found[name].arrays["trace_m"]
        updates, shade = np.arange(len(middle)), colour(number)
        axes.fill_between(updates, low, high, color=shade, alpha=0.13, linewidth=0)
        axes.plot(updates, middle, color=shade, linewidth=1.7, label=name)
        axes.plot(updates, found[name].arrays["expected_trace_m"], color=shade, linewidth=1.0, linestyle="--")
    axes.axhline(goal_m, color=LIMIT, linewidth=0.9, linestyle=":", label=f"published: {1e3 * goal_m:g} mm")
    axes.set_yscale("log")
    axes.set(xlabel="updates", ylabel="root mean square error of a place, m")
    axes.set_title(f"{title}\nmedian, 10 to 90 %; dashed: what the filter expects", color=INK)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=3, frameon=False, fontsize=8)
    dress(axes)
    save(figure, stem)


def _draw_maps(found: Mapping[str, CellResult], maps: Sequence[tuple[str, str]], stem: Path) -> None:
    figure = new_figure(4.6 * len(maps), 6.4)
    panels = figure.subplots(1, len(maps), squeeze=False)[0]
    for axes, (name, title) in zip(panels, maps, strict=True):
        cell = found[name]
        true, places = cell.arrays["true_m"], cell.arrays["positions_m"][:_CLOUD]
        for mote in range(len(true)):
            axes.plot(*places[:, mote].T, ".", color=colour(0), markersize=2.5, alpha=0.35)
        axes.plot(*true.T, "o", color=colour(1), markersize=8, fillstyle="none", label="true")
        axes.plot([], [], ".", color=colour(0), label=f"mapped, {len(places)} runs")
        axes.set_title(title, color=INK)
        axes.set(xlabel="x, m", ylabel="y, m", aspect="equal", xlim=(-1.2, 6.2), ylim=(-0.2, 9.2))
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.09), ncols=2, frameon=False, fontsize=8)
    dress(*panels)
    save(figure, stem)


def _draw_ways(cells: Sequence[CellResult], stem: Path) -> None:
    figure = new_figure(8.5, 0.36 * len(cells) + 1.7)
    axes = figure.subplots()
    for row, cell in enumerate(cells):
        _draw_way(axes, row, cell)
    axes.set_yticks(range(len(cells)), [str(cell.factors["case"]) for cell in cells])
    axes.set_ylim(len(cells) - 0.5, -0.5)
    axes.set_xscale("log")
    axes.set_xlabel("root mean square error of a place, m: median (dot), 10 to 90 % (bar), Cramér-Rao bound (line)")
    dress(axes)
    save(figure, stem)


def _draw_way(axes: "Axes", row: int, cell: CellResult) -> None:
    rms, bound_m = cell.values["rms_m"], cell.values["bound_m"]
    shade = colour(0 if cell.values["method"] == "ekf" else 2)
    axes.plot([rms["p10"], rms["p90"]], [row, row], color=shade, linewidth=4.0, alpha=0.35, solid_capstyle="butt")
    axes.plot(rms["p50"], row, "o", color=shade, markersize=5)
    if bound_m is not None:
        axes.plot([bound_m, bound_m], [row - 0.3, row + 0.3], color=QUIET, linewidth=1.4)


UPDATES = 300  # of figures 11 and 12 as we read them
SHOWN = 30  # updates within which figure 14 comes down
_ENDLESS_M = 1e-6  # a target that is never reached: the figures go on
_PLAIN = {
    "cricket.phase2.pools": False,
    "cricket.phase2.linearisations": 1,
    "cricket.phase2.gate_probability": 1.0 - 1e-15,
}
_LATE = {"cricket.sim.latency_s": 0.0003}  # 10 cm: a pulse that is detected a few periods late


class Case(NamedTuple):
    """A row of the study.

    Attributes:
        method: ``ekf`` or ``batch``.
        keys: of the configuration, over ``configs/cricket.toml``.
    """

    figure: str
    method: str
    keys: Mapping[str, object]


def _filter(pairs: str, **keys: object) -> dict[str, object]:
    return {
        "cricket.phase2.pairs": pairs,
        "cricket.phase2.max_updates": UPDATES,
        "cricket.phase2.target_rms_m": _ENDLESS_M,
        **keys,
    }


def _batch(repeats: int, *, shapes: bool = True, second: bool = False) -> dict[str, object]:
    return {
        "cricket.ranging.repeats": repeats,
        "cricket.batch.uses_shapes": shapes,
        "cricket.batch.uses_phase2": second,
        "cricket.phase2.max_updates": 15,
    }


CASES = {
    "zigzag-printed": Case("10 to 12", "ekf", {**_filter("zigzag"), **_PLAIN}),
    "zigzag-p0-99": Case("eq. 25", "ekf", {**_filter("zigzag"), **_PLAIN, "cricket.phase2.prior": "printed"}),
    "zigzag-pooled": Case("better", "ekf", _filter("zigzag")),
    "adjacent-printed": Case("13, 14", "ekf", {**_filter("adjacent"), **_PLAIN}),
    "all-printed": Case("13, 14", "ekf", {**_filter("all"), **_PLAIN}),
    "all-p0-99": Case("eq. 25", "ekf", {**_filter("all"), **_PLAIN, "cricket.phase2.prior": "printed"}),
    "all-pooled": Case("better", "ekf", _filter("all")),
    "batch-45-once": Case("better", "batch", _batch(1)),
    "batch-45": Case("better", "batch", _batch(60)),
    "batch-45-no-shapes": Case("better", "batch", _batch(60, shapes=False)),
    "batch-45-and-15": Case("better", "batch", _batch(60, second=True)),
    "batch-late": Case("fault", "batch", {**_batch(60, second=True), **_LATE}),
    "batch-late-offset": Case(
        "better", "batch", {**_batch(60, second=True), **_LATE, "cricket.batch.estimates_offset": True}
    ),
}


def run_job(job: Job) -> JobOutcome:
    """One field of one case."""
    case = CASES[str(job.factors["case"])]
    cfg = load_radio_config(None, {"system": "cricket", **case.keys}).cricket
    field = simulate_field(cfg, job.seed)
    began_s = time.perf_counter()
    run = run_filter(cfg, field) if case.method == "ekf" else run_batch(cfg, field)
    spent_s = time.perf_counter() - began_s
    bound_m, deficiency, is_unique = None, 0, True
    if job.seed == job.cfg.run.seed or case.method == "ekf":
        outlook = look_ahead(cfg, field, case.method)
        bound_m, deficiency, is_unique = outlook.bound_rms_m, outlook.freedom.deficiency, outlook.folds.is_unique
    values = {
        "rms_m": run.rms_m,
        "phase1_rms_m": run.phase1_rms_m,
        "expected_rms_m": run.expected_rms_m,
        "bound_m": bound_m,
        "rank_deficiency": deficiency,
        "is_unique": is_unique,
        "spent_s": spent_s,
        "nis": float(run.nis.mean()) if run.nis.size else None,
    }
    errors = run.positions_m - run.true_m
    arrays = {
        "trace_m": run.trace_m,
        "expected_trace_m": run.expected_trace_m,
        "errors_m": errors,
        "positions_m": run.positions_m,
        "true_m": run.true_m,
    }
    return JobOutcome(values, arrays)


def combine(factors: Factors, outcomes: Sequence[JobOutcome]) -> JobOutcome:
    """Median and 10 to 90 % of a case, and its traces."""
    case = CASES[str(factors["case"])]
    rms = np.array([outcome.values["rms_m"] for outcome in outcomes])
    traces = np.array([outcome.arrays["trace_m"] for outcome in outcomes])
    laid = [outcome.values["phase1_rms_m"] for outcome in outcomes if outcome.values["phase1_rms_m"] is not None]
    bounds = [outcome.values["bound_m"] for outcome in outcomes if outcome.values["bound_m"] is not None]
    low, middle, high = np.percentile(rms, (10, 50, 90))
    bound_m = bounds[0] if bounds else None
    total = float(np.sqrt(np.mean(rms**2)))
    values = {
        "figure": case.figure,
        "method": case.method,
        "rms_m": {"p10": low, "p50": middle, "p90": high},
        "rms_of_all_m": total,
        "phase1_rms_m": float(np.median(laid)) if laid else None,
        "rms_at_30_m": float(np.median(traces[:, SHOWN])) if traces.shape[1] > SHOWN else None,
        # The paper's error is of a coordinate, root(mean e^2) over all of them; ours of a place.
        "coordinate_rms_at_30_m": float(np.median(traces[:, SHOWN]) / np.sqrt(2.0))
        if traces.shape[1] > SHOWN
        else None,
        "expected_rms_m": float(np.median([outcome.values["expected_rms_m"] for outcome in outcomes])),
        "bound_m": bound_m,
        "ratio": None if bound_m is None else total / bound_m,
        "rank_deficiency": max(outcome.values["rank_deficiency"] for outcome in outcomes),
        "is_unique": all(outcome.values["is_unique"] for outcome in outcomes),
        "spent_ms": 1e3 * float(np.median([outcome.values["spent_s"] for outcome in outcomes])),
    }
    expected = np.array([outcome.arrays["expected_trace_m"] for outcome in outcomes])
    arrays = {
        "rms_m": rms,
        "trace_m": np.percentile(traces, (10, 50, 90), axis=0),
        "expected_trace_m": np.median(expected, axis=0),
        "positions_m": np.array([outcome.arrays["positions_m"] for outcome in outcomes]),
        "true_m": np.asarray(outcomes[0].arrays["true_m"]),
    }
    return JobOutcome(values, arrays)


def draw(cells: Sequence[CellResult], out: Path) -> None:
    """Figures 9 to 14, and the ways beside each other."""
    draw_cricket(cells, out)


STUDY = Study(
    name="cricket",
    title="self-mapping of ultrasonic motes: the published figures, and better ways",
    cells=lambda: [Cell({"case": name}) for name in CASES],
    run_job=run_job,
    combine=combine,
    columns=(
        Column("figure", "figure"),
        Column("after phase 1, m", "phase1_rms_m", ".4f"),
        Column("p10, m", "rms_m.p10", ".4f"),
        Column("median, m", "rms_m.p50", ".4f"),
        Column("p90, m", "rms_m.p90", ".4f"),
        Column("median after 30 updates, m", "rms_at_30_m", ".4f"),
        Column("of a coordinate, m", "coordinate_rms_at_30_m", ".4f"),
        Column("expected, m", "expected_rms_m", ".4f"),
        Column("bound, m", "bound_m", ".4f"),
        Column("rms of all / bound", "ratio", ".2f"),
        Column("rank deficiency", "rank_deficiency"),
        Column("unique", "is_unique"),
        Column("cost, ms", "spent_ms", ".0f"),
    ),
    draw=draw,
    mirrors=(),
    runs=200,
)
