"""The study `mote-sizes`: what a batch map of sparse ranges costs, against the number of motes.

Many self-mappings of one configuration, put together: errors, bound, what is free, traces.

What is drawn of a campaign of self-mappings: its first map, and the errors of all runs.
"""

import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ccatp.beacons.cricket.map_fit import MapFitSettings, MapModel, bound_rms_m
from ccatp.beacons.cricket.mote_map import map_motes
from ccatp.beacons.cricket.range_network import MoteRange, RangeNetwork, build_network, components
from ccatp.beacons.cricket.rigidity import find_fold_over, find_freedom, generic_state
from ccatp.config.beacon_models import CricketConfig
from ccatp.config.models import Config
from ccatp.core import FloatArray
from ccatp.filters.metrics import aligned_rms_m, best_motion, rms_m
from ccatp.report.beacon_plots import MapPicture, Traces
from ccatp.report.plots import INK, dress, new_figure
from ccatp.studies.figures import colour, save
from ccatp.studies.mote_runs import (
    MoteOutlook,
    MoteRun,
    SimulatedField,
    look_ahead,
    run_batch,
    run_filter,
    simulate_field,
)

SIZES = (30, 60, 120, 250, 500, 1000)
NEIGHBOURS = 13.0  # of a mote, on the average, beside those at the rim
REACH_M, SIGMA_M = 5.5, 0.02 / 3.0
_ROBUST = 4.0


def run(cfg: Config, out: Path) -> dict[str, Any]:
    """Map drawn fields of growing size, once each, and write ``result.json``, ``table.md`` and the figure.

    Args:
        out: directory; made if it is not there.

    Raises:
        OSError: ``out`` cannot be written.
    """
    began_s = time.perf_counter()
    out.mkdir(parents=True, exist_ok=True)
    cells = [_cell(size, cfg.run.seed) for size in SIZES]
    result = {"study": "mote-sizes", "cells": cells, "wall_s": time.perf_counter() - began_s}
    (out / "result.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    (out / "table.md").write_text(_table(cells), encoding="utf-8")
    _draw(cells, out / "mote_sizes")
    return result


def drawn_network(size: int, rng: np.random.Generator) -> tuple[RangeNetwork, np.ndarray]:
    """A square field with ranges between motes that are near each other: its largest connected part, and the truth."""
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


def _cell(size: int, seed: int) -> dict[str, Any]:
    network, true_m = drawn_network(size, np.random.default_rng((seed, size)))
    model = MapModel(network)
    rng = np.random.default_rng(0)
    began_s = time.perf_counter()
    folds = find_fold_over(network, rng)
    freedom = find_freedom(model, generic_state(model, rng))
    looked_s = time.perf_counter()
    found = map_motes(network, MapFitSettings(_ROBUST), mirrors=folds.mirrors)
    mapped_s = time.perf_counter()
    errors = np.linalg.norm(
        best_motion(found.positions_m, true_m, mirrors=True).moved(found.positions_m) - true_m, axis=1
    )
    in_doubt = {mote for _, motes in folds.mirrors for mote in motes} | {
        mote for fold in found.folds for mote in fold.motes
    }
    sure = [mote for mote in range(network.count) if mote not in in_doubt]
    held = (
        best_motion(found.positions_m[sure], true_m[sure], mirrors=True).moved(found.positions_m[sure]) - true_m[sure]
    )
    return {
        "motes": network.count,
        "ranges": len(network.ranges_m),
        "runs": 1,
        "outlook_s": looked_s - began_s,
        "map_s": mapped_s - looked_s,
        "error_median_m": float(np.median(errors)),
        "motes_in_doubt": len(in_doubt),
        "rms_of_others_m": float(np.sqrt((held**2).sum(axis=1).mean())),
        "bound_m": bound_rms_m(model, true_m, sure, aligned=True),
        "rank_deficiency": freedom.deficiency,
        "cost_per_dof": found.variance_factor,
    }


def _table(cells: list[dict[str, Any]]) -> str:
    heads = list(cells[0])
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    lines += ["| " + " | ".join(_text(cell[head]) for head in heads) + " |" for cell in cells]
    return "\n".join(lines) + "\n"


def _text(value: object) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _draw(cells: list[dict[str, Any]], stem: Path) -> None:
    figure = new_figure(6.5, 4.2)
    axes = figure.subplots()
    motes = [cell["motes"] for cell in cells]
    for number, (key, label) in enumerate((("map_s", "map"), ("outlook_s", "rank and folds, before"))):
        axes.loglog(motes, [cell[key] for cell in cells], "o-", color=colour(number), label=label)
    axes.set(xlabel="motes", ylabel="time, s")
    axes.set_title(f"Batch map of sparse ranges, {NEIGHBOURS:g} neighbours a mote", color=INK)
    axes.legend(frameon=False, fontsize=8)
    dress(axes)
    save(figure, stem)


METHODS = ("ekf", "batch")


class MoteCampaign(NamedTuple):
    """Runs of one configuration.

    Attributes:
        method: ``ekf`` or ``batch``.
        outlook: of the first seed's graph, bounds at the median number of updates.
    """

    method: str
    runs: tuple[MoteRun, ...]
    outlook: MoteOutlook
    field: SimulatedField


def run_campaign(
    cfg: CricketConfig, method: str, seeds: Sequence[int], tell: Callable[[int], None] = lambda _: None
) -> MoteCampaign:
    """Map the motes once for each seed.

    Args:
        method: ``ekf`` or ``batch``.

    Raises:
        MappingError: a field of which no map can be made.
    """
    field = simulate_field(cfg, seeds[0])
    outlook = look_ahead(cfg, field, method)
    runs = []
    for done, seed in enumerate(seeds, start=1):
        drawn = field if seed == seeds[0] else simulate_field(cfg, seed)
        # Drawn layouts differ from seed to seed, and so do their folds.
        known = outlook if cfg.layout != "random" or seed == seeds[0] else look_ahead(cfg, drawn, method)
        runs.append(run_filter(cfg, drawn) if method == "ekf" else run_batch(cfg, drawn, known))
        tell(done)
    if method == "ekf":
        updates = int(np.median([run.iterations for run in runs]))
        outlook = look_ahead(cfg, field, method, max(updates, 1))
    return MoteCampaign(method, tuple(runs), outlook, field)


def campaign_data(campaign: MoteCampaign) -> dict[str, Any]:
    """What ``ccatp radio map --json`` prints."""
    runs, outlook = campaign.runs, campaign.outlook
    laid = [run.phase1_rms_m for run in runs if run.phase1_rms_m is not None]
    return {
        "rms_m": percentiles([run.rms_m for run in runs]),
        "crlb_m": outlook.bound_rms_m,
        "rank_deficiency": outlook.freedom.deficiency,
        "fold_over_risk": not outlook.folds.is_unique,
        "phase1_rms_m": float(np.median(laid)) if laid else None,
        "iterations": int(np.median([run.iterations for run in runs])),
        "method": campaign.method,
        "seeds": len(runs),
        "motes": len(runs[0].names),
        "frame": "aligned" if runs[0].is_aligned else "surveyed",
        "rms_of_all_m": float(np.sqrt(np.mean([run.rms_m**2 for run in runs]))),
        "motes_in_doubt": int(np.median([len(run.doubtful) for run in runs])),
        "rms_of_others_m": float(np.median([sure_rms_m(run) for run in runs])),
        "expected_rms_m": float(np.median([run.expected_rms_m for run in runs])),
        "offset_m": float(np.median([run.offset_m for run in runs])),
        "scale": 1.0 + float(np.median([run.scale for run in runs])),
        "free_directions": [*outlook.freedom.frame, *outlook.freedom.flexes, *outlook.freedom.calibration],
        "warnings": list(outlook.folds.warnings),
    }


def sure_rms_m(run: MoteRun) -> float:
    """Error of the motes that are not in doubt, in the frame of the run; not a number where there are too few."""
    sure = [row for row in range(len(run.names)) if row not in run.doubtful]
    found, true = run.positions_m[sure], run.true_m[sure]
    if not run.is_aligned:
        return rms_m(found, true)
    return aligned_rms_m(found, true, mirrors=True) if len(sure) > true.shape[1] else float("nan")


def percentiles(values: Sequence[float]) -> dict[str, float]:
    """10, 50 and 90 %."""
    low, middle, high = np.percentile(values, (10, 50, 90))
    return {"p10": float(low), "p50": float(middle), "p90": float(high)}


def traces_of(runs: Sequence[MoteRun]) -> tuple[FloatArray, FloatArray]:
    """Errors and expected errors by update, shape (runs, k) each; a run that ended early stays where it was."""
    longest = max(len(run.trace_m) for run in runs)

    def padded(traces: Sequence[FloatArray]) -> FloatArray:
        return np.array([np.pad(trace, (0, longest - len(trace)), mode="edge") for trace in traces])

    return padded([run.trace_m for run in runs]), padded([run.expected_trace_m for run in runs])


_LINED = 100  # motes up to which the measured pairs are drawn


def pictured(campaign: MoteCampaign, seed: int) -> tuple[MapPicture, Traces | None]:
    """The map of the first run, and of the filter the errors against updates."""
    run = campaign.runs[0]
    title = f"{campaign.method}, {len(run.names)} motes, seed {seed}, error {1e3 * run.rms_m:.3g} mm"
    positions_m, covariance_m2 = run.positions_m, run.covariance_m2
    if run.is_aligned:  # its frame is its own: moved onto the truth, for the eye
        motion = best_motion(run.positions_m, run.true_m, mirrors=True)
        positions_m, covariance_m2 = motion.moved(positions_m), motion.turned_map(covariance_m2)
    pairs = np.array(_pairs(campaign, run), dtype=np.intp).reshape(-1, 2)
    picture = MapPicture(run.names, positions_m, covariance_m2, run.true_m, pairs, run.doubtful, title)
    if campaign.method != "ekf":
        return picture, None
    errors, expected = traces_of(campaign.runs)
    low, middle, high = np.percentile(errors, (10, 50, 90), axis=0)
    bound_m = campaign.outlook.bound_rms_m
    return picture, Traces(low, middle, high, np.median(expected, axis=0), bound_m, len(campaign.runs))


def _pairs(campaign: MoteCampaign, run: MoteRun) -> list[tuple[int, int]]:
    """Pairs of motes of the map that ranged, in phase 2 for the filter, in phase 1 for the batch."""
    field = campaign.field
    if len(run.names) > _LINED:
        return []
    row = {name: number for number, name in enumerate(run.names)}
    names = field.plan.names
    if campaign.method == "ekf":
        ends = {(names[i], names[j]) for i, j, _, _ in field.second}
    else:
        ends = {(reading.first, reading.second) for reading in field.first}
    return sorted((row[a], row[b]) for a, b in ends if a in row and b in row)
