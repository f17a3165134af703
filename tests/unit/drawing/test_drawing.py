"""Pictures: scales, axes, thinned lines, and the same shapes as SVG, PNG and PDF."""

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

from ccatp.report.drawing import (
    LEVELS,
    Area,
    Boxes,
    ColourScale,
    Dots,
    Drawing,
    Plot,
    PlotAxis,
    PolyLine,
    Shape,
    TextShape,
    colour_bar,
    envelope,
    legend,
    number_text,
    svg_of,
    thinned,
    ticks,
)
from ccatp.report.plots import PictureError, write_figures, write_svg

PIXEL_SHAPES: tuple[Shape, ...] = (
    Boxes(np.array([[0.0, 0.0, 50.0, 100.0]]), "#ff0000"),
    Area(np.array([[60.0, 10.0], [90.0, 10.0], [90.0, 40.0], [60.0, 40.0]]), "#0000ff", "#000000", 2.0),
    PolyLine(np.array([[55.0, 60.0], [95.0, 60.0], [np.nan, np.nan], [55.0, 70.0], [95.0, 70.0]]), "#00ff00", 6.0),
    Dots(np.array([[75.0, 90.0]]), 8.0, "#ff00ff", titles=("a < b",), edge="#ffffff"),
    Dots(np.array([[20.0, 20.0]]), 8.0, "#000000", "cross"),
    Dots(np.array([[20.0, 60.0]]), 8.0, "#000000", "ring"),
    PolyLine(np.array([[5.0, 95.0], [45.0, 95.0]]), "#000000", 2.0, dash=(4.0, 2.0), opacity=0.5),
    TextShape(50.0, 50.0, "1 < 2 & $3", anchor="middle", is_bold=True, turn_deg=90.0),
)  # fmt: skip
PICTURE = Drawing(100.0, 100.0, PIXEL_SHAPES, 'a "picture"')
SVG = "{http://www.w3.org/2000/svg}"


@pytest.mark.parametrize(
    ("low", "high", "most", "expected"),
    [
        (0.0, 1.0, 5, [0.0, 0.2, 0.4, 0.6, 0.8, 1.0]),
        (-3.0, 3.0, 3, [-2.0, 0.0, 2.0]),
        (0.0, 3600.0, 8, [0.0, 500.0, 1000.0, 1500.0, 2000.0, 2500.0, 3000.0, 3500.0]),
        (0.1, 0.100001, 2, [0.1, 0.1000005, 0.100001]),
    ],
)
def test_ticks_are_round(low: float, high: float, most: int, expected: list[float]) -> None:
    assert ticks(low, high, most) == pytest.approx(expected)


def test_an_axis() -> None:
    axis = PlotAxis(0.0, 10.0, 100.0, 0.0)
    assert axis.pixels(np.array([0.0, 5.0, 10.0])) == pytest.approx([100.0, 50.0, 0.0])
    log = PlotAxis(0.01, 100.0, 0.0, 400.0, is_logarithmic=True)
    assert log.pixels(np.array([0.001, 0.01, 1.0, 100.0])) == pytest.approx([0.0, 0.0, 200.0, 400.0])
    assert log.ticks() == pytest.approx([0.01, 0.1, 1.0, 10.0, 100.0])
    assert number_text(-0.5) == "\u22120.5"


def test_a_colour_scale() -> None:
    scale = ColourScale(-1.0, 1.0, ("#000000", "#808080", "#ffffff"))
    assert scale.levels(np.array([-9.0, -1.0, 0.0, 0.999, 9.0])).tolist() == [0, 0, 32, LEVELS - 1, LEVELS - 1]
    palette = scale.palette()
    assert (palette[0], palette[-1], len(palette)) == ("#000000", "#ffffff", LEVELS)
    assert scale.colour(-5.0) == "#000000"


def test_a_thinned_line_stays_near() -> None:
    t = np.linspace(0.0, 20.0, 5001)
    line = np.column_stack([40.0 * t, 100.0 * np.sin(t)])
    line[2500] = np.nan
    short = thinned(line, 0.5)
    assert len(short) < 400
    assert np.isnan(short).any(axis=1).sum() == 1
    assert (short[0] == line[0]).all()
    assert (short[-1] == line[-1]).all()
    good = short[~np.isnan(short).any(axis=1)]
    # Sampled ten times finer than a pixel, so that linear interpolation is as good as the sine.
    assert np.abs(np.interp(line[:, 0], good[:, 0], good[:, 1]) - line[:, 1])[~np.isnan(line[:, 0])].max() < 1.5
    assert len(thinned(np.empty((0, 2)), 1.0)) == 0
    assert len(thinned(np.full((2, 2), np.nan), 1.0)) == 0


def test_a_robot_that_stands_adds_nothing() -> None:
    standing = np.vstack([np.tile([[1.0, 1.0]], (1000, 1)), [[5.0, 1.0]], np.tile([[9.0, 1.0]], (1000, 1))])
    assert thinned(standing, 0.5).tolist() == [[1.0, 1.0], [9.0, 1.0]]


def test_an_envelope() -> None:
    x = np.arange(1000.0)
    y = np.where(x == 500.0, 99.0, x % 2)
    y[3] = np.nan
    found = envelope(x, y, 10)
    assert len(found.x) == 10
    assert found.low.tolist() == [0.0] * 10
    assert found.high.tolist() == [1.0] * 5 + [99.0] + [1.0] * 4
    assert found.mean[0] == pytest.approx(49 / 99)
    assert len(envelope(np.empty(0), np.empty(0), 10).x) == 0
    assert envelope(np.array([3.0]), np.array([2.0]), 10).high.tolist() == [2.0]


def test_svg_is_sound_and_alone() -> None:
    root = ET.fromstring(svg_of(PICTURE, is_file=True))
    assert (root.tag, root.get("viewBox"), root.get("aria-label")) == (f"{SVG}svg", "0 0 100 100", 'a "picture"')
    assert root.find(f".//{SVG}title").text == "a < b"  # type: ignore[union-attr]
    assert root.find(f"{SVG}text").text == "1 < 2 & $3"  # type: ignore[union-attr]
    assert not [element for element in root.iter() if any("href" in name for name in element.attrib)]
    paths = [element.get("d") for element in root.iter(f"{SVG}path")]
    assert "M0 0h50v100h-50z" in paths
    assert "M55 60L95 60M55 70L95 70" in paths  # NaN parts it


def test_empty_shapes_leave_nothing() -> None:
    nothing = np.empty((0, 2))
    shapes = (PolyLine(nothing, "#000000"), Dots(nothing, 1.0, "#000000"), Boxes(np.empty((0, 4)), "#000000"))
    assert svg_of(Drawing(1.0, 1.0, shapes, "")).endswith('stroke-linejoin="round"></svg>')


def test_a_plot_and_its_parts() -> None:
    plot = Plot(
        40.0,
        10.0,
        300.0,
        200.0,
        PlotAxis(0.0, 10.0, 40.0, 300.0),
        PlotAxis(0.1, 10.0, 200.0, 10.0, is_logarithmic=True),
    )
    plot.frame("time, s", "mm")
    plot.line(np.array([0.0, 10.0]), np.array([1.0, 1e9]), "#000000")
    plot.level(1.0, "#ff0000")
    texts = [shape.text for shape in plot.shapes if isinstance(shape, TextShape)]
    assert {"time, s", "mm", "0.1", "1", "10"} <= set(texts)
    series = next(shape for shape in plot.shapes if isinstance(shape, PolyLine) and shape.width == 1.4)
    assert series.points.tolist() == [[40.0, 105.0], [300.0, 8.0]]  # what is beyond the end stays at it
    shapes, height = legend(0.0, 10.0, [("one", "#000000"), ("another that is long", "#ffffff")], 10.0, 100.0)
    assert len(shapes) == 4
    assert height == pytest.approx(2 * 16.0)
    upright = colour_bar(ColourScale(0.0, 1.0, ("#000000", "#ffffff")), 0.0, 0.0, 100.0, "mm", 10.0, is_upright=True)
    lowest = next(shape for shape in upright if isinstance(shape, Boxes))
    assert (lowest.fill, lowest.corners[0, 1]) == ("#000000", pytest.approx(100.0 - 100.0 / LEVELS))


def test_png_and_pdf_show_the_same(tmp_path: Path) -> None:
    image = pytest.importorskip("matplotlib.image")
    png, pdf = write_figures(PICTURE, tmp_path / "some.name")
    assert (png.name, pdf.name) == ("some.name.png", "some.name.pdf")
    assert pdf.read_bytes().startswith(b"%PDF")
    pixels = (255 * image.imread(png)[:, :, :3]).round().astype(int)
    assert pixels.shape == (200, 200, 3)
    for (x, y), colour in {
        (5, 40): (255, 0, 0), (75, 25): (0, 0, 255), (80, 60): (0, 255, 0), (80, 70): (0, 255, 0),
        (75, 90): (255, 0, 255), (97, 5): (255, 255, 255), (20, 20): (0, 0, 0), (20, 60): (255, 255, 255),
    }.items():  # fmt: skip
        assert tuple(pixels[2 * y, 2 * x]) == colour, (x, y)
    again, _ = write_figures(PICTURE, tmp_path / "again")
    assert again.read_bytes() == png.read_bytes()


def test_files_that_cannot_be_written_are_told(tmp_path: Path) -> None:
    with pytest.raises(PictureError, match=r"no/a\.svg: cannot be written: No such file or directory"):
        write_svg(PICTURE, tmp_path / "no" / "a.svg")
    pytest.importorskip("matplotlib")
    with pytest.raises(PictureError, match=r"no/a\.png: cannot be written: No such file or directory"):
        write_figures(PICTURE, tmp_path / "no" / "a")
