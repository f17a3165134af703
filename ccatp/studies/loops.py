"""Glue. The study `loops`: Bode plots, margins and root loci of the controllers, as in figs 3.6 to 3.9 of the thesis.

The thesis judges its two loops on the plant 1/(T s + 1), from speed command to speed. What they close is the way from
speed command to position, which has an integrator more: 1/(s (T s + 1)). The study sets both side by side, without and
with the delay of the link, and beside them every other set of gains of the configuration.
"""

import json
import time
from collections.abc import Sequence
from math import degrees, isfinite
from pathlib import Path
from typing import Any

import numpy as np

from ccatp.config.models import Config
from ccatp.studies.loop_figures import draw_bode, draw_locus
from ccatp.studies.loop_models import (
    GRID_POINTS,
    OMEGA_RAD_S,
    Loop,
    Margins,
    limit_of,
    loops_of,
    margins,
    overshoot,
    response,
)

HEADINGS = (
    "gains", "axis", "plant", "T, s", "delay, frames", "gain margin, dB", "phase margin, deg", "crossover, rad/s",
    "delay margin, s", "least distance from -1", "overshoot, %",
)  # fmt: skip
COLUMNS = (
    "gains", "axis", "plant", "lag_s", "delay_frames", "gain_margin_db", "phase_margin_deg", "gain_crossover_rad_s",
    "delay_margin_s", "modulus_margin", "overshoot_percent",
)  # fmt: skip


def run(cfg: Config, out: Path) -> dict[str, Any]:
    """Analyse every loop of the configuration and write ``result.json``, ``result.npz``, ``table.md`` and the figures.

    Args:
        cfg: sets of gains, wheel lag, frame rate.
        out: directory; made if it is not there.

    Returns:
        What ``result.json`` holds: ``{"study", "cells", "wall_s"}``. A cell is one loop with its margins; what does not
        exist (a gain margin without a phase crossover) is None.

    Raises:
        LoopsError: python-control is not installed.
        OSError: ``out`` cannot be written.
    """
    started_s = time.perf_counter()
    out.mkdir(parents=True, exist_ok=True)
    loops = list(loops_of(cfg))
    cells = [_cell(loop, margins(loop)) for loop in (*loops, *limit_of(cfg))]
    for group in _grouped(loops):
        draw_bode(group, [margins(loop) for loop in group], out)
        draw_locus(group, out)
    _write_arrays(loops, out / "result.npz")
    (out / "table.md").write_text(table(cells), encoding="utf-8")
    result = {"study": "loops", "cells": cells, "wall_s": time.perf_counter() - started_s}
    (out / "result.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    return result


def table(cells: Sequence[dict[str, Any]]) -> str:
    """The cells as a Markdown table."""
    lines = ["| " + " | ".join(HEADINGS) + " |", "|" + "---|" * len(HEADINGS)]
    lines += ["| " + " | ".join(_text(cell[column]) for column in COLUMNS) + " |" for cell in cells]
    return "\n".join(lines) + "\n"


def _cell(loop: Loop, found: Margins) -> dict[str, Any]:
    figures = {
        "gain_margin_db": found.gain_db,
        "phase_margin_deg": degrees(found.phase_rad),
        "modulus_margin": found.modulus,
        "gain_crossover_rad_s": found.gain_crossover_rad_s,
        "phase_crossover_rad_s": found.phase_crossover_rad_s,
        "delay_margin_s": found.delay_s,
        "overshoot_percent": 100.0 * overshoot(loop),
    }
    return {
        "gains": loop.gains,
        "axis": loop.axis,
        "plant": loop.plant,
        "lag_s": loop.lag_s,
        "delay_frames": loop.delay_frames,
        "runs": 1,
        "is_stable": found.is_stable,
        **{name: value if isfinite(value) else None for name, value in figures.items()},
    }


def _grouped(loops: Sequence[Loop]) -> list[list[Loop]]:
    """Loops that share a figure: one set of gains, one axis."""
    groups: dict[tuple[str, str], list[Loop]] = {}
    for loop in loops:
        groups.setdefault((loop.gains, loop.axis), []).append(loop)
    return list(groups.values())


def _write_arrays(loops: Sequence[Loop], path: Path) -> None:
    """Frequency responses: magnitude and phase (rad), one row for each cell without a limit, in their order."""
    omega = np.geomspace(*OMEGA_RAD_S, GRID_POINTS)
    responses = [response(loop, omega) for loop in loops]
    names = [f"{loop.gains}/{loop.axis}/{loop.plant}/{loop.delay_frames}" for loop in loops]
    magnitude, phase = (np.array(part) for part in zip(*responses, strict=True))
    np.savez_compressed(path, omega_rad_s=omega, loop=np.array(names), magnitude=magnitude, phase_rad=phase)


def _text(value: object) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
