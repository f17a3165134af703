"""Pure. The displacement of a panel as it was fitted, at any place on it."""

import numpy as np

from ccatp.aligning.modes import FloatArray, quadratic, rigid
from ccatp.aligning.panel_result import PanelResult
from ccatp.mirror.mirror import Mirror


def displacement_m(panel: PanelResult, places_m: FloatArray) -> FloatArray:
    """Along the panel's normal, with its curvatures where they are significant, shape (k,).

    Args:
        panel: the panel.
        places_m: (x, y) in the panel frame, shape (k, 2).
    """
    found = rigid(places_m) @ panel.fit.values
    if panel.shape is not None and panel.shape.is_significant:
        # The rigid fit has taken the mean of the curvatures' part away; so does what is drawn.
        bend = quadratic(places_m)[:, 3:] @ panel.shape.values_1_m
        found += bend - bend.mean()
    return np.asarray(found)


def on_grid_m(mirror: Mirror, panel: PanelResult, cells: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The displacement in a grid of cells over a panel.

    Args:
        mirror: the mirror.
        panel: the panel.
        cells: along each side.

    Returns:
        Edges of the cells along deck x and deck y, shape (cells + 1,) each, and the displacement in their middles,
        rows along x, shape (cells, cells).
    """
    body = mirror.panel(panel.panel)
    x = np.linspace(body.x_m - body.half_x_m, body.x_m + body.half_x_m, cells + 1)
    y = np.linspace(body.y_m - body.half_y_m, body.y_m + body.half_y_m, cells + 1)
    middle_x, middle_y = np.meshgrid((x[1:] + x[:-1]) / 2.0, (y[1:] + y[:-1]) / 2.0)
    deck = np.column_stack([middle_x.ravel(), middle_y.ravel()]).tolist()
    places = np.array([body.from_deck(mirror.surface.point(*place))[:2] for place in deck])
    return x, y, displacement_m(panel, places).reshape(cells, cells)
