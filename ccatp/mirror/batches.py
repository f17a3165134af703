"""Pure. Many poses at once, for those who keep track of a robot: the same transforms on arrays."""

from collections.abc import Sequence
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from ccatp.mirror.mirror import Mirror
from ccatp.mirror.panels import Panel
from ccatp.mirror.surface import Surface
from ccatp.samples import FloatArray, PanelId, PanelPose

# Along the panel's normal down to the surface. It starts at the sag of some mm, on which the slope hardly changes: the
# first step of Newton's leaves 2e-7 m, the second less than rounding.
_DROP_STEPS = 2


def deck_poses(mirror: Mirror, poses: Sequence[PanelPose]) -> FloatArray:
    """``Mirror.deck_pose`` of many.

    Args:
        mirror: the mirror.
        poses: k poses in panel frames.

    Returns:
        Rows of deck x, y (m), heading (rad) and height of the surface there (m), shape (k, 4).
    """
    places = np.array([[p.x_m for p in poses], [p.y_m for p in poses], [p.heading_rad for p in poses]]).T
    return _by_runs(mirror, [p.panel for p in poses], places)


def deck_rows(mirror: Mirror, panels: NDArray[np.int64], places: FloatArray) -> FloatArray:
    """The same of poses that are arrays already.

    Args:
        mirror: the mirror.
        panels: row and column of each, shape (k, 2).
        places: x, y (m) and heading (rad) in the frames of these panels, shape (k, 3).
    """
    return _by_runs(mirror, [PanelId(row, col) for row, col in panels.tolist()], places)


def _by_runs(mirror: Mirror, panels: Sequence[PanelId], places: FloatArray) -> FloatArray:
    rows = np.empty((len(panels), 4))
    start = 0
    for panel, run in groupby(panels):
        end = start + sum(1 for _ in run)
        rows[start:end] = _on_panel(mirror.surface, mirror.panel(panel), places[start:end])
        start = end
    return rows


def _on_panel(surface: Surface, panel: Panel, places: FloatArray) -> FloatArray:
    axes = np.array(panel.axes)
    points = np.array(panel.origin) + places[:, :2] @ axes[:2]
    for _ in range(_DROP_STEPS):
        x, y, z = points.T
        fx, fy = surface.gradients(x, y)
        gap = (surface.heights_m(x, y) - z) / (axes[2, 2] - fx * axes[2, 0] - fy * axes[2, 1])
        points += gap[:, None] * axes[2]
    x, y, z = points.T
    fx, fy = surface.gradients(x, y)
    e1 = np.column_stack([np.ones_like(fx), np.zeros_like(fx), fx]) / np.sqrt(1.0 + fx * fx)[:, None]
    n = np.column_stack([-fx, -fy, np.ones_like(fx)]) / np.sqrt(1.0 + fx * fx + fy * fy)[:, None]
    # The heading lies in the tangent plane at the robot and projects on (cos, sin, 0) of the panel frame.
    flat = np.cos(places[:, 2, None]) * axes[0] + np.sin(places[:, 2, None]) * axes[1]
    h = flat - ((flat * n).sum(axis=1) / (n @ axes[2]))[:, None] * axes[2]
    heading = np.arctan2((h * np.cross(n, e1)).sum(axis=1), (h * e1).sum(axis=1))
    return np.column_stack([x, y, heading, z])
