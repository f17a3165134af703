"""Edge. A map of motes as a picture: places with their ellipses, and the error after each update.

Imports matplotlib, which takes a second, only when something is drawn.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ccatp.pictures.figures import GRID, INK, QUIET, dress, new_figure, save_figure
from ccatp.samples import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes


FOUND, TRUE, DOUBT = "#0b3c5d", "#d08c00", "#c0392b"
_CHI2_90 = 4.605  # of two degrees of freedom: the ellipse that holds nine of ten
_LABELLED = 40  # motes up to which each has its name beside it
_VISIBLE = 0.012  # of the width of the map: ellipses that are smaller are drawn larger, and the title says so


class MapPicture(NamedTuple):
    """What is drawn of one map.

    Attributes:
        names, positions_m, covariance_m2: the map; drawn in its first two coordinates.
        true_m: where the motes are, shape (n, d), or None.
        pairs: measured pairs, indices, shape (e, 2).
        doubtful: motes that may be elsewhere.
        title: above the map.
    """

    names: Sequence[str]
    positions_m: FloatArray
    covariance_m2: FloatArray
    true_m: FloatArray | None
    pairs: NDArray[np.intp]
    doubtful: Sequence[int]
    title: str


class Traces(NamedTuple):
    """Error after each update, over runs.

    Attributes:
        low_m, middle_m, high_m: 10, 50 and 90 %, shape (k,).
        expected_m: what the filter expects, median, shape (k,).
        bound_m: Cramér-Rao bound, or None.
        runs: how many.
    """

    low_m: FloatArray
    middle_m: FloatArray
    high_m: FloatArray
    expected_m: FloatArray
    bound_m: float | None
    runs: int


def draw_mote_map(picture: MapPicture, traces: Traces | None, out: Path) -> None:
    """Draw a map, and beside it the errors where there are some.

    Args:
        picture: the map.
        traces: errors against updates, or None.
        out: the file; its suffix tells the format (PNG, PDF, SVG).

    Raises:
        PictureError: the file cannot be written.
    """
    figure = new_figure(11.0 if traces else 6.5, 6.5)
    panels = figure.subplots(1, 2 if traces else 1, squeeze=False)[0]
    draw_places(panels[0], picture)
    if traces is not None:
        draw_traces(panels[1], traces)
    save_figure(figure, out)


def draw_places(axes: "Axes", picture: MapPicture) -> None:
    """Motes, truth, measured pairs and the ellipses that hold nine of ten."""
    places = picture.positions_m[:, :2]
    for i, j in picture.pairs.tolist():
        axes.plot(*places[[i, j]].T, color=GRID, linewidth=0.8, zorder=1)
    grown = _ellipses(axes, picture)
    if picture.true_m is not None:
        axes.plot(*picture.true_m[:, :2].T, "o", color=TRUE, markersize=7, fillstyle="none", label="true", zorder=3)
    axes.plot(*places.T, "x", color=FOUND, markersize=6, label="mapped", zorder=4)
    if len(picture.doubtful):
        axes.plot(
            *places[list(picture.doubtful)].T,
            "s",
            color=DOUBT,
            markersize=11,
            fillstyle="none",
            label="may be elsewhere",
        )
    if len(picture.names) <= _LABELLED:
        for name, place in zip(picture.names, places, strict=True):
            axes.annotate(name, place, textcoords="offset points", xytext=(6, 5), fontsize=7, color=QUIET)
    larger = f", ellipses {grown:g} times larger" if grown > 1.0 else ", 90 % ellipses"
    axes.set_title(picture.title + larger, fontsize=10, color=INK)
    axes.set(xlabel="x, m", ylabel="y, m", aspect="equal")
    axes.margins(0.1)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.09), ncols=3, frameon=False, fontsize=8)
    dress(axes)


def draw_traces(axes: "Axes", traces: Traces, label: str = "", shade: str = FOUND) -> None:
    """Median and the band from 10 to 90 %, what the filter expects, the bound."""
    updates = np.arange(len(traces.middle_m))
    axes.fill_between(updates, traces.low_m, traces.high_m, color=shade, alpha=0.18, linewidth=0)
    axes.plot(updates, traces.middle_m, color=shade, linewidth=1.6, label=f"{label}error, median and 10 to 90 %")
    expected = np.arange(len(traces.expected_m))
    axes.plot(
        expected, traces.expected_m, color=shade, linewidth=1.0, linestyle="--", label=f"{label}expected by the filter"
    )
    if traces.bound_m is not None:
        axes.axhline(
            traces.bound_m, color=QUIET, linewidth=0.9, linestyle=":", label=f"{label}Cramér-Rao bound, all updates"
        )
    axes.set_yscale("log")
    axes.set(xlabel="updates", ylabel="root mean square error, m")
    axes.set_title(f"{traces.runs} runs", fontsize=10, color=INK)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.09), ncols=2, frameon=False, fontsize=8)
    dress(axes)


def _ellipses(axes: "Axes", picture: MapPicture) -> float:
    """Draw them; by what factor, a power of ten, they are larger than they are."""
    from matplotlib.patches import Ellipse  # noqa: PLC0415 - see above

    d = picture.positions_m.shape[1]
    places = picture.positions_m[:, :2]
    blocks = [picture.covariance_m2[row * d : row * d + 2, row * d : row * d + 2] for row in range(len(places))]
    spread = [np.linalg.eigh(block) for block in blocks]
    halves = [np.sqrt(_CHI2_90 * np.maximum(values, 0.0)) for values, _ in spread]
    typical, width = float(np.median([half[1] for half in halves])), float(np.ptp(places, axis=0).max())
    grown = 1.0
    while 0.0 < typical * grown < _VISIBLE * width and grown < 1e6:
        grown *= 10.0
    for place, half, (_, vectors) in zip(places, halves, spread, strict=True):
        angle = float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])))
        size = 2.0 * grown * half
        axes.add_patch(
            Ellipse(place, size[1], size[0], angle=angle, facecolor=FOUND, alpha=0.18, edgecolor=FOUND, zorder=2)
        )
    return grown
