"""A laser tracker that measures the targets of a whole mirror in a frame of its own, and the alignment of its file."""

import json
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ccatp.cli.align_points import PointOptions, align_points
from ccatp.core import FloatArray, PanelId
from ccatp.mirror.mirror import Mirror
from ccatp.mirror.panel_modes import surface_under
from ccatp.report.alignment import config_data, result_data
from tests.support.scenario import world_of

SIGMA_M = 15e-6
_SIDE_M = (-0.28, 0.0, 0.28)


class Instrument(NamedTuple):
    """Height of the targets; standard deviations of a session's frame (turn, shift) and scale; share of lost points."""

    offset_m: float = 0.01905
    turn_rad: float = 50e-6
    shift_m: float = 3e-4
    scale: float = 5e-6
    lost: float = 0.02
    settings: tuple[tuple[str, object], ...] = ()


class Places(NamedTuple):
    """The targets of a mirror: feet and normals (n, 9, 3), places in the panels (n, 9, 2), normals of the panels."""

    mirror: Mirror
    panels: tuple[PanelId, ...]
    feet_m: FloatArray
    normals: FloatArray
    places_m: FloatArray
    axes: FloatArray


@cache
def places_of(name: str, panels: int | None = None) -> Places:
    """The targets of the first panels of a mirror, of all without a number."""
    mirror = world_of(name).mirror
    chosen = tuple(sorted(mirror.panels))[:panels]
    grid = np.array([(x, y) for y in _SIDE_M for x in _SIDE_M])
    feet, normals, axes = [], [], []
    for panel in chosen:
        deck, own = surface_under(mirror, panel, grid.tolist())
        feet.append([mirror.world_from_deck(mirror.surface.point(x, y)) for x, y in deck.tolist()])
        normals.append([mirror.rotate_world_from_deck((x, y, z)) for x, y, z in own.tolist()])
        axes.append(mirror.rotate_world_from_deck(mirror.panel(panel).axes[2]))
    return Places(mirror, chosen, np.array(feet), np.array(normals), np.tile(grid, (len(chosen), 1, 1)), np.array(axes))


def measured(
    file: Path, places: Places, displaced_m: FloatArray, instrument: Instrument, rng: np.random.Generator
) -> Path:
    """Measure the targets, whose panels are displaced along their normals (n, 9), and write file and alignment."""
    points = places.feet_m + instrument.offset_m * places.normals + displaced_m[:, :, None] * places.axes[:, None, :]
    turn, shift = rng.normal(0.0, instrument.turn_rad, 3), rng.normal(0.0, instrument.shift_m, 3)
    points = points * (1.0 + rng.normal(0.0, instrument.scale)) + np.cross(turn, points) + shift
    points += rng.normal(0.0, SIGMA_M, points.shape)
    lines = [
        f"{panel.row}/{panel.col},{x:.5f},{y:.5f},{z:.5f}"
        for panel, own in zip(places.panels, (1e3 * points).tolist(), strict=True)
        for x, y, z in own
        if rng.random() >= instrument.lost
    ]
    rng.shuffle(lines)
    file.write_text("\n".join(lines), encoding="utf-8")
    options = PointOptions(file, None, "world", None, instrument.offset_m, SIGMA_M)
    found = align_points(None, {"run.mirror": places.mirror.name, **dict(instrument.settings)}, options)
    data = {**result_data(found.result, None), "config": config_data(found.cfg), "points_file": str(file)}
    written = file.with_suffix(".json")
    written.write_text(json.dumps(data), encoding="utf-8")
    return written
