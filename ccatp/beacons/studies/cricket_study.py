"""The studies `cricket` and `mote-sizes` of motes that map themselves.

`cricket`: reproduces figures 9 to 14 of Patil et al. and compares better methods. `mote-sizes`: computing time of a
batch map from sparse ranges as a function of the number of motes.
"""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ccatp.beacons.config.load import load_radio_config
from ccatp.beacons.cricket.map_fit import MapFitSettings, MapModel, bound_rms_m
from ccatp.beacons.cricket.mote_map import map_motes
from ccatp.beacons.cricket.range_network import MoteRange, RangeNetwork, build_network, components
from ccatp.beacons.cricket.rigidity import find_fold_over, find_freedom, generic_state
from ccatp.beacons.rigid_motion import best_motion
from ccatp.beacons.studies.mote_runs import look_ahead, percentiles, run_batch, run_filter, simulate_field
from ccatp.config.models import Config
from ccatp.core import FloatArray
from ccatp.studies.campaign import Cell, CellResult, Factors, Job, JobOutcome, Study
from ccatp.studies.results import LIMIT, FigureRow, Measure, band, colour, draw_ranges, plot, write_analysis

UPDATES = 300  # in figures 11 and 12, as read from the figures
SHOWN = 30  # updates after which figure 14 has converged
_ENDLESS_M = 1e-6  # a target that is never reached, so that all updates are done
_PLAIN = {
    "cricket.phase2.pools": False,
    "cricket.phase2.linearisations": 1,
    "cricket.phase2.gate_probability": 1.0 - 1e-15,
}
_PRINTED = {"cricket.phase2.prior": "printed"}
_LATE = {"cricket.sim.latency_s": 0.0003}  # 10 cm: the pulse is detected a few periods late


class Case(NamedTuple):
    """A row of the study; ``method`` is ``ekf`` or ``batch``, ``keys`` override ``configs/cricket.toml``."""

    figure: str
    method: str
    keys: Mapping[str, object]


def _filter(figure: str, pairs: str, **keys: object) -> Case:
    long = {"cricket.phase2.max_updates": UPDATES, "cricket.phase2.target_rms_m": _ENDLESS_M}
    return Case(figure, "ekf", {"cricket.phase2.pairs": pairs, **long, **keys})


def _batch(
    figure: str, repeats: int, keys: Mapping[str, object] = {}, *, shapes: bool = True, second: bool = False
) -> Case:
    uses = {"cricket.batch.uses_shapes": shapes, "cricket.batch.uses_phase2": second, "cricket.phase2.max_updates": 15}
    return Case(figure, "batch", {"cricket.ranging.repeats": repeats, **uses, **keys})


CASES = {
    "zigzag-printed": _filter("10 to 12", "zigzag", **_PLAIN),
    "zigzag-p0-99": _filter("eq. 25", "zigzag", **_PLAIN, **_PRINTED),
    "zigzag-pooled": _filter("better", "zigzag"),
    "adjacent-printed": _filter("13, 14", "adjacent", **_PLAIN),
    "all-printed": _filter("13, 14", "all", **_PLAIN),
    "all-p0-99": _filter("eq. 25", "all", **_PLAIN, **_PRINTED),
    "all-pooled": _filter("better", "all"),
    "batch-45-once": _batch("better", 1),
    "batch-45": _batch("better", 60),
    "batch-45-no-shapes": _batch("better", 60, shapes=False),
    "batch-45-and-15": _batch("better", 60, second=True),
    "batch-late": _batch("fault", 60, _LATE, second=True),
    "batch-late-offset": _batch("better", 60, {**_LATE, "cricket.batch.estimates_offset": True}, second=True),
}


def run_job(job: Job) -> JobOutcome:
    """Map one simulated field of one case."""
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
        **{name: getattr(run, name) for name in ("rms_m", "phase1_rms_m", "expected_rms_m", "nees")},
        "bound_m": bound_m,
        "rank_deficiency": deficiency,
        "is_unique": is_unique,
        "spent_s": spent_s,
        "nis": float(run.nis.mean()) if run.nis.size else None,
    }
    arrays = {name: getattr(run, name) for name in ("trace_m", "expected_trace_m", "positions_m", "true_m")}
    return JobOutcome(values, arrays)


def combine(factors: Factors, outcomes: Sequence[JobOutcome]) -> JobOutcome:
    """Median and 10 to 90 % of a case, and its traces."""
    case, runs = CASES[str(factors["case"])], [outcome.values for outcome in outcomes]
    rms = np.array([run["rms_m"] for run in runs])
    traces = np.array([outcome.arrays["trace_m"] for outcome in outcomes])
    phase1_m = [run["phase1_rms_m"] for run in runs if run["phase1_rms_m"] is not None]
    bound_m = next((run["bound_m"] for run in runs if run["bound_m"] is not None), None)
    total = float(np.sqrt(np.mean(rms**2)))
    shown_m = float(np.median(traces[:, SHOWN])) if traces.shape[1] > SHOWN else None
    values = {
        "figure": case.figure,
        "method": case.method,
        "rms_m": percentiles(rms.tolist()),
        "rms_of_all_m": total,
        "phase1_rms_m": float(np.median(phase1_m)) if phase1_m else None,
        "rms_at_30_m": shown_m,
        # The error of the paper is the root mean square of coordinates; ours is that of positions.
        "coordinate_rms_at_30_m": None if shown_m is None else float(shown_m / np.sqrt(2.0)),
        "expected_rms_m": float(np.median([run["expected_rms_m"] for run in runs])),
        "bound_m": bound_m,
        "nees": None if runs[0]["nees"] is None else float(np.mean([run["nees"] for run in runs])),
        "ratio": None if bound_m is None else total / bound_m,
        "rank_deficiency": max(run["rank_deficiency"] for run in runs),
        "is_unique": all(run["is_unique"] for run in runs),
        "spent_ms": 1e3 * float(np.median([run["spent_s"] for run in runs])),
    }
    arrays = {
        "rms_m": rms,
        "trace_m": np.percentile(traces, (10, 50, 90), axis=0),
        "expected_trace_m": np.median([outcome.arrays["expected_trace_m"] for outcome in outcomes], axis=0),
        "positions_m": np.array([outcome.arrays["positions_m"] for outcome in outcomes]),
        "true_m": np.asarray(outcomes[0].arrays["true_m"]),
    }
    return JobOutcome(values, arrays)


# -- figures ----------------------------------------------------------------------------------------------------------

_CLOUD = 200  # largest number of runs shown as dots
_FEW = ("zigzag-printed", "zigzag-p0-99", "zigzag-pooled")
_MANY = ("adjacent-printed", "all-printed", "all-p0-99", "all-pooled")
_TRACES = (
    ("figure_11_12", _FEW, "Few measurements: five pairs in a zigzag", 0.15),
    ("figure_14", _MANY, "Many measurements: nine adjacent pairs, or all fifteen", 0.005),
)
_MAPS = (("zigzag-printed", "figures 9, 10: five pairs"), ("all-printed", "figure 13: fifteen pairs"))


def draw(cells: Sequence[CellResult], out: Path) -> None:
    """Errors against updates (figures 11, 12, 14), maps of many runs (9, 10, 13), comparison of all methods."""
    found = {str(cell.factors["case"]): cell for cell in cells}
    for stem, names, title, goal_m in _TRACES:
        if shown := [name for name in names if name in found]:
            _draw_traces(found, shown, title, goal_m, out / stem)
    if maps := [(name, title) for name, title in _MAPS if name in found]:
        _draw_maps(found, maps, out / "figure_9_10_13")
    draw_ranges([FigureRow(str(cell.factors["case"]), cell) for cell in cells], [WAYS], "All ways", out / "ways")


def _draw_traces(found: Mapping[str, CellResult], names: Sequence[str], title: str, goal_m: float, stem: Path) -> None:
    with plot(stem, 8.5, 5.2, legend=3) as (axes,):
        for number, name in enumerate(names):
            ends, shade = found[name].arrays["trace_m"], colour(number)
            updates = np.arange(ends.shape[1])
            band(axes, updates, ends, shade, label=name)
            axes.plot(updates, found[name].arrays["expected_trace_m"], color=shade, linewidth=1.0, linestyle="--")
        axes.axhline(goal_m, color=LIMIT, linewidth=0.9, linestyle=":", label=f"published: {1e3 * goal_m:g} mm")
        axes.set(xlabel="updates", ylabel="root mean square error of a place, m", yscale="log")
        axes.set_title(f"{title}\nmedian, 10 to 90 %; dashed: what the filter expects")


def _draw_maps(found: Mapping[str, CellResult], maps: Sequence[tuple[str, str]], stem: Path) -> None:
    with plot(stem, 4.6 * len(maps), 6.4, 1, len(maps), legend=2) as panels:
        for axes, (name, title) in zip(panels, maps, strict=True):
            true, places = found[name].arrays["true_m"], found[name].arrays["positions_m"][:_CLOUD]
            for mote in range(len(true)):
                axes.plot(*places[:, mote].T, ".", color=colour(0), markersize=2.5, alpha=0.35)
            axes.plot(*true.T, "o", color=colour(1), markersize=8, fillstyle="none", label="true")
            axes.plot([], [], ".", color=colour(0), label=f"mapped, {len(places)} runs")
            axes.set(xlabel="x, m", ylabel="y, m", aspect="equal", xlim=(-1.2, 6.2), ylim=(-0.2, 9.2), title=title)


WAYS = Measure(
    "root mean square error of a place, m: median (dot), 10 to 90 % (bar), Cramér-Rao bound (mark)",
    ("rms_m.p10", "rms_m.p90"),
    "rms_m.p50",
    "bound_m",
)


STUDY = Study(
    cells=lambda: [Cell({"case": name}) for name in CASES],
    run_job=run_job,
    combine=combine,
    columns="""
        figure phase1_rms_m
        rms_m: p10 p50 p90
        rms_at_30_m coordinate_rms_at_30_m expected_rms_m bound_m ratio nees rank_deficiency is_unique spent_ms
    """,
    draw=draw,
    mirrors=(),
    runs=200,
)

# -- mote-sizes -------------------------------------------------------------------------------------------------------

SIZES = (30, 60, 120, 250, 500, 1000)
NEIGHBOURS = 13.0  # mean number for a mote inside the field
REACH_M, SIGMA_M = 5.5, 0.02 / 3.0
_ROBUST = 4.0


def run_sizes(cfg: Config, out: Path) -> dict[str, Any]:
    """Map random fields of increasing size, once each, and write the files and the figure."""
    began_s = time.perf_counter()
    cells = [_sized_cell(size, cfg.run.seed) for size in SIZES]
    arrays = {key: np.array([cell[key] for cell in cells], dtype=np.float64) for key in cells[0]}  # None is NaN
    result = write_analysis("mote-sizes", cells, " ".join(list(cells[0])[3:]), out, began_s, arrays=arrays)
    with plot(out / "mote_sizes", 6.5, 4.2, legend=2) as (axes,):
        for number, (key, label) in enumerate((("map_s", "map"), ("outlook_s", "rank and folds, before"))):
            motes, times_s = [cell["motes"] for cell in cells], [cell[key] for cell in cells]
            axes.loglog(motes, times_s, "o-", color=colour(number), label=label)
        axes.set(xlabel="motes", ylabel="time, s")
        axes.set_title(f"Batch map of sparse ranges, {NEIGHBOURS:g} neighbours a mote")
    return result


def drawn_network(size: int, rng: np.random.Generator) -> tuple[RangeNetwork, FloatArray]:
    """A random square field with ranges between near motes: its largest connected part, and true positions (n, 2)."""
    side_m = REACH_M * np.sqrt(np.pi * size / NEIGHBOURS)
    places = rng.uniform(0.0, side_m, (size, 2))
    distances = np.linalg.norm(places[:, None] - places[None], axis=2)
    pairs = np.column_stack(np.nonzero(np.triu(distances < REACH_M, 1)))
    labels = components(size, pairs)
    pairs = pairs[labels[pairs[:, 0]] == np.bincount(labels).argmax()]
    noise = rng.normal(0.0, SIGMA_M, len(pairs))
    rows = [
        MoteRange(f"M{i}", f"M{j}", float(distances[i, j] + error), SIGMA_M)
        for (i, j), error in zip(pairs.tolist(), noise, strict=True)
    ]
    network = build_network(rows, 2)
    return network, places[[int(name[1:]) for name in network.names]]


def _sized_cell(size: int, seed: int) -> dict[str, Any]:
    network, true_m = drawn_network(size, np.random.default_rng((seed, size)))
    model = MapModel(network)
    rng = np.random.default_rng(0)
    began_s = time.perf_counter()
    folds = find_fold_over(network, rng)
    freedom = find_freedom(model, generic_state(model, rng))
    looked_s = time.perf_counter()
    found = map_motes(network, MapFitSettings(_ROBUST), mirrors=folds.mirrors)
    mapped_s = time.perf_counter()
    in_doubt = found.doubtful(folds.mirrors)
    sure = [mote for mote in range(network.count) if mote not in in_doubt]
    of_all, of_sure = (
        best_motion(places, true, mirrors=True).moved(places) - true
        for places, true in ((found.positions_m, true_m), (found.positions_m[sure], true_m[sure]))
    )
    return {
        "motes": network.count,
        "ranges": len(network.ranges_m),
        "runs": 1,
        "outlook_s": looked_s - began_s,
        "map_s": mapped_s - looked_s,
        "error_median_m": float(np.median(np.linalg.norm(of_all, axis=1))),
        "motes_in_doubt": len(in_doubt),
        "rms_of_others_m": float(np.sqrt((of_sure**2).sum(axis=1).mean())),
        "bound_m": bound_rms_m(model, true_m, sure, aligned=True),
        "rank_deficiency": freedom.deficiency,
        "cost_per_dof": found.variance_factor,
    }
