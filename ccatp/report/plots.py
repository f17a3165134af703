"""Figures by matplotlib for reports, pictures and studies: colours, layout, files, SVG for a page, shorter series.

matplotlib takes a second to import, so it is imported only where something is drawn.
"""

import json
import re
from collections.abc import Sequence
from io import StringIO
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, cast
from xml.etree import ElementTree as ET

import numpy as np

from ccatp.core import FloatArray
from ccatp.errors import UsageError

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK, QUIET, GRID, PAPER = "#1f2933", "#5f6c7b", "#e3e8ed", "#ffffff"
PANEL, SEAM, PATH, BAD, GOOD = "#f1f4f7", "#c5ced8", "#8fa3b8", "#c93f3f", "#1d7a55"
# The colours also differ in lightness, for colour-blind readers and for printers.
SERIES = ("#123f6d", "#e0902f", "#1d8a99", "#a8577e", "#8a96a3", "#5b7f2b")
SMALL_TO_LARGE = ("#123f6d", "#1d8a99", "#f0b429")
BELOW_TO_ABOVE = ("#2f6aa5", "#a9cbe3", "#f7f7f5", "#f3c08c", "#c25a28")

WIDE, NARROW = 880.0, 380.0  # of the figures of a page, px: on a screen or paper, and on a phone
PX_PER_IN = 96.0  # of CSS
FONT = "system-ui, 'Segoe UI', 'DejaVu Sans', Helvetica, Arial, sans-serif"
SVG = "http://www.w3.org/2000/svg"
_XLINK = "http://www.w3.org/1999/xlink"
_TOOLTIPS = "tooltips|"
_PT_PER_IN = 72.0  # of SVG files
_RASTER_DPI = 144.0  # of images in an SVG


class PictureError(UsageError):
    """A picture that cannot be drawn or written."""


def check_drawing(folder: Path) -> None:
    """Check that matplotlib is installed and make the folder of the figures; PictureError: one of these fails."""
    new_figure(1.0, 1.0)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        TemporaryFile(dir=folder).close()
    except OSError as error:
        raise PictureError(f"{folder}: cannot be written: {error.strerror}; choose another folder") from error


# -- layout -----------------------------------------------------------------------------------------------------------


def new_figure(width_in: float, height_in: float, dpi: float = 160.0) -> "Figure":
    """A figure without a window."""
    from matplotlib.figure import Figure  # noqa: PLC0415 - takes a second

    return Figure(figsize=(width_in, height_in), dpi=dpi, facecolor="white", layout="constrained")


def dress(*panels: "Axes", grid: Literal["major", "both"] = "major") -> None:
    """Draw the grid behind the data, frames in a light colour, small labels."""
    for axes in panels:
        axes.grid(True, which=grid, color=GRID, linewidth=0.6)
        axes.set_axisbelow(True)
        axes.tick_params(which="both", labelsize=8, color=QUIET, labelcolor=INK)
        axes.title.set_fontsize(9)
        for label in (axes.xaxis.label, axes.yaxis.label):
            label.set_fontsize(9)
        for side in axes.spines.values():
            side.set_color(GRID)


def new_plot(width_px: float, title: str, heights_px: tuple[float, float] = (370.0, 320.0), log: str = "") -> "Axes":
    """A figure of a page with one plot, its height for a screen or for a phone; the title is its description.

    ``log`` names a logarithmic axis, x or y; its labels are plain numbers at the decades.
    """
    from matplotlib.ticker import NullFormatter  # noqa: PLC0415

    height_px = heights_px[0] if is_wide(width_px) else heights_px[1]
    figure = new_figure(width_px / PX_PER_IN, height_px / PX_PER_IN, PX_PER_IN)
    figure.set_label(title)
    axes = figure.subplots()
    dress(axes)
    if log:
        axes.set(**{f"{log}scale": "log"})
        axis = axes.xaxis if log == "x" else axes.yaxis
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())
    return axes


def is_wide(width_px: float) -> bool:
    """Whether the layout is for a screen or paper, not for a phone."""
    return width_px > NARROW


def add_legend(axes: "Axes") -> "Figure":
    """Add the legend below the plot; return the complete figure."""
    figure = cast("Figure", axes.get_figure())
    handles, labels = axes.get_legend_handles_labels()
    columns = min(len(labels), 5) if is_wide(figure.bbox.width / figure.dpi * PX_PER_IN) else 2
    if handles:
        figure.legend(
            handles, labels, ncols=columns, frameon=False, fontsize=8, labelcolor=INK, columnspacing=1.2,
            handlelength=1.6, borderpad=0.2, loc="outside lower left",
        )  # fmt: skip
    return figure


def add_tooltips(artist: "Artist", titles: Sequence[str]) -> None:
    """Set the tooltip of each mark of a collection or a line of markers, in their order."""
    artist.set_gid(_TOOLTIPS + "|".join(title.replace("|", "/") for title in titles))


def ellipse_outline(covariance: FloatArray, sigmas: float) -> FloatArray:
    """Outline of the region within ``sigmas`` standard deviations of the origin, shape (61, 2)."""
    values, vectors = np.linalg.eigh(covariance)
    angle = np.linspace(0.0, 2.0 * np.pi, 61)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    return np.asarray(sigmas * (circle * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)


# -- files ------------------------------------------------------------------------------------------------------------


def save_figure(figure: "Figure", path: Path, dpi: float | None = None) -> None:
    """Write a figure as PNG, PDF or SVG, by the suffix; the file contains no date.

    ``dpi``: pixels per inch, by default the figure's own. Raises PictureError: not writable, or an unknown format.
    """
    undated: dict[str, dict[str, Any]] = {".png": {"Software": None}, ".pdf": {"CreationDate": None}}
    try:
        if path.suffix.lower() == ".svg":
            path.write_text(svg_of(figure, is_file=True) + "\n", encoding="utf-8")
        else:
            arrange(figure)
            figure.savefig(path, dpi=dpi or "figure", metadata=undated.get(path.suffix.lower()))
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) and error.strerror else error
        raise PictureError(f"{path}: cannot be written: {why}") from error


def arrange(figure: "Figure") -> None:
    """Give every part of a complete figure its place, once: saving would draw all of it a second time to do so."""
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.execute(figure)
        figure.set_layout_engine(None)


def svg_of(figure: "Figure", *, is_file: bool = False) -> str:
    """The figure as an ``svg`` element that shrinks with its page; with ``is_file``, as a document with a size.

    It has no external resources and no date. Its ids are unique among figures with other titles or widths.
    """
    from matplotlib import rc_context  # noqa: PLC0415

    arrange(figure)
    title = str(figure.get_label())
    salt = f"{title} {figure.get_figwidth():g}"
    text = StringIO()
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": salt}):
        figure.savefig(
            text, format="svg", dpi=_RASTER_DPI, metadata=dict.fromkeys(("Date", "Creator", "Format", "Type"))
        )
    root = ET.fromstring(re.sub("<style.*?</style>", "", text.getvalue()))  # noqa: S314 - from matplotlib
    for element in root.iter():
        _shorten(element)
    if not is_file:
        del root.attrib["width"], root.attrib["height"]
        root.set("data-axes", json.dumps(_axes_of(figure)))
    style = f"font-family:{FONT};stroke-linejoin:round;stroke-linecap:butt"
    root.attrib.update({"role": "img", "aria-label": title, "style": style})
    ET.register_namespace("", SVG)
    ET.register_namespace("xlink", _XLINK)
    return ET.tostring(root, encoding="unicode")


def _axes_of(figure: "Figure") -> list[dict[str, Any]]:
    """The x and the y axis of the first plot, with their ends in the ``svg`` element, for the pointer's readout."""
    axes, box = figure.axes[0], figure.axes[0].get_position()
    places = (
        (axes.xaxis, axes.get_xlim(), figure.get_figwidth() * box.intervalx),
        (axes.yaxis, axes.get_ylim(), figure.get_figheight() * (1.0 - box.intervaly)),
    )
    return [
        {
            "label": axis.get_label_text(),
            "log": axis.get_scale() == "log",
            "values": [float(f"{value:.7g}") for value in values],
            "ends": (_PT_PER_IN * ends_in).round(2).tolist(),
        }
        for axis, values, ends_in in places
    ]


def _shorten(element: ET.Element) -> None:
    """Hundredths of a point, the font of the page, no ids that nothing refers to, and titles where there are some."""
    gid = element.get("id", "")
    if element.tag == f"{{{SVG}}}g" and gid:
        del element.attrib["id"]
        if gid.startswith(_TOOLTIPS):
            _add_titles(element, gid.removeprefix(_TOOLTIPS).split("|"))
    element.text = (element.text or "").strip() or None
    element.tail = None
    for name in [key for key in ("d", "x", "y", "transform", "style") if key in element.attrib]:
        element.set(name, re.sub(r"(\.\d\d)\d+| ?font-family:[^;]*;?", r"\1", element.attrib[name]))


def _add_titles(group: ET.Element, titles: Sequence[str]) -> None:
    defined = {id(one) for defs in group.iter(f"{{{SVG}}}defs") for one in defs.iter()}
    drawn = (f"{{{SVG}}}use", f"{{{SVG}}}path")
    marks = [one for one in group.iter() if one.tag in drawn and id(one) not in defined]
    # A mark outside the picture is not written, so its title would be assigned to another mark.
    for mark, title in zip(marks, titles if len(marks) == len(titles) else (), strict=False):
        ET.SubElement(mark, f"{{{SVG}}}title").text = title


# -- shorter series without a visible change --------------------------------------------------------------------------


class Envelope(NamedTuple):
    """Least and largest value in each interval that has any: centres x, least y, largest y, mean y; shape (k,)."""

    x: FloatArray
    low: FloatArray
    high: FloatArray
    mean: FloatArray


def envelope(x: FloatArray, y: FloatArray, intervals: int) -> Envelope:
    """Reduce a series to intervals of equal length (at least 1); values that are not finite are left out."""
    is_good = np.isfinite(x) & np.isfinite(y)
    x, y = x[is_good], y[is_good]
    if not len(x):
        return Envelope(*[np.empty(0)] * 4)
    low, high = float(x.min()), float(x.max())
    width = (high - low) / intervals or 1.0
    index = np.minimum(((x - low) / width).astype(np.int64), intervals - 1)
    order = np.argsort(index, kind="stable")
    found, starts, counts = np.unique(index[order], return_index=True, return_counts=True)
    sorted_y = y[order]
    return Envelope(
        low + (found + 0.5) * width,
        np.minimum.reduceat(sorted_y, starts),
        np.maximum.reduceat(sorted_y, starts),
        np.add.reduceat(sorted_y, starts) / counts,
    )


def distinct(x: FloatArray, y: FloatArray, width_px: float) -> tuple[FloatArray, FloatArray]:
    """Marks without those at the same pixel as another one, for a figure of that width."""
    if not len(x):
        return x, y
    points = np.column_stack([x, y])
    step = np.maximum(np.ptp(points, axis=0), 1e-12) / (0.5 * width_px)
    _, first = np.unique(np.rint(points / step), axis=0, return_index=True)
    return x[np.sort(first)], y[np.sort(first)]
