"""Glue. The study `mote-sizes`: what a batch map of sparse ranges costs, against the number of motes."""

import json
import time
from pathlib import Path
from typing import Any

import numpy as np

from ccatp.config.models import Config
from ccatp.motes.fold_over import find_fold_over
from ccatp.motes.map_batch import BatchSettings
from ccatp.motes.map_model import MapModel
from ccatp.motes.mote_map import map_motes
from ccatp.motes.range_bound import bound_rms_m
from ccatp.motes.range_network import RangeNetwork, build_network, components
from ccatp.motes.rigidity import find_freedom, generic_state
from ccatp.motes.tdoa import MoteRange
from ccatp.radio.rigid_alignment import best_motion
from ccatp.studies.figures import INK, colour, dress, new_figure, save

SIZES = (30, 60, 120, 250, 500, 1000)
NEIGHBOURS = 13.0  # of a mote, on the average, beside those at the rim
REACH_M, SIGMA_M = 5.5, 0.02 / 3.0
_ROBUST = 4.0


def run(cfg: Config, out: Path) -> dict[str, Any]:
    """Map drawn fields of growing size, once each, and write ``result.json``, ``table.md`` and the figure.

    Args:
        cfg: the seed.
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
    found = map_motes(network, BatchSettings(_ROBUST), mirrors=folds.mirrors)
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
