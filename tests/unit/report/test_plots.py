"""Figures: what is drawn, shorter series, SVG for a page, files, the map of a run."""

import re
import xml.etree.ElementTree as ET
from collections.abc import Callable
from math import hypot
from pathlib import Path

import numpy as np
import pytest

from ccatp.core import DeckPose, PanelId, PointId
from ccatp.mirror.mirror import Mirror
from ccatp.records.run_reader import RunReadError
from ccatp.records.summary import measured_error_m
from ccatp.report.figures import error_figure, time_figure
from ccatp.report.findings import ErrorSeries, Grade, PointVerdict, TimeBreakdown, point_verdicts
from ccatp.report.mirror_map import MAP_WIDTH_PX, draw_from_run_dir, record_map, run_map
from ccatp.report.plots import (
    NARROW,
    SVG,
    WIDE,
    PictureError,
    add_legend,
    add_tooltips,
    envelope,
    new_plot,
    save_figure,
    svg_of,
)
from ccatp.report.record import read_record

PNG = b"\x89PNG\r\n\x1a\n"


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


@pytest.mark.parametrize("width_px", [WIDE, NARROW])
def test_svg_is_alone_small_and_has_tooltips(width_px: float) -> None:
    axes = new_plot(width_px, 'a "picture"')
    (marks,) = axes.plot([0.0, 1.0], [2.0, 3.0], "o", label="1 < 2")
    t = np.linspace(0.0, 1.0, 100_001)
    axes.plot(t, np.sin(20.0 * t))
    add_tooltips(marks, ["a < b", "c|d"])
    figure = add_legend(axes)
    text = svg_of(figure)
    assert len(text) < 40_000
    root = ET.fromstring(text)
    assert (root.tag, root.get("aria-label"), root.get("role")) == (f"{{{SVG}}}svg", 'a "picture"', "img")
    assert root.get("width") is None
    assert root.get("viewBox", "").split()[2] == f"{0.75 * width_px:g}"
    assert [title.text for title in root.iter(f"{{{SVG}}}title")] == ["a < b", "c/d"]
    assert "1 < 2" in [element.text for element in root.iter(f"{{{SVG}}}text")]
    references = [value for element in root.iter() for name, value in element.attrib.items() if name.endswith("href")]
    ids = [element.get("id") for element in root.iter() if element.get("id")]
    assert references
    assert all(value.startswith("#") and value[1:] in ids for value in references)
    assert len(ids) == len(set(ids))
    assert not {"metadata", "style"} & {element.tag.partition("}")[2] for element in root.iter()}
    assert svg_of(figure) == text
    assert ET.fromstring(svg_of(figure, is_file=True)).get("width") is not None
    other = new_plot(width_px, "another")
    other.plot([0.0, 1.0], [2.0, 3.0], "o")
    others = {element.get("id") for element in ET.fromstring(svg_of(add_legend(other))).iter()}
    assert not others.intersection(ids)


def test_files(tmp_path: Path) -> None:
    axes = new_plot(WIDE, "title")
    axes.plot([0.0, 1.0], [2.0, 3.0])
    for suffix, start in ((".png", PNG), (".pdf", b"%PDF"), (".svg", b"<svg ")):
        one, other = tmp_path / f"one{suffix}", tmp_path / f"other{suffix}"
        save_figure(add_legend(axes), one)
        save_figure(add_legend(axes), other)
        assert one.read_bytes().startswith(start)
        assert one.read_bytes() == other.read_bytes()
        with pytest.raises(PictureError, match=rf"no/a\{suffix}: cannot be written: No such file or directory"):
            save_figure(add_legend(axes), tmp_path / "no" / f"a{suffix}")


def verdict(place_m: tuple[float, float], left_mm: float | None, grade: Grade, number: int = 1) -> PointVerdict:
    return PointVerdict(PointId(5, 5, number), place_m, None, left_mm, grade, "")


def test_a_map_of_a_run_shows_what_it_is_given(mirror: Mirror) -> None:
    points = [
        verdict((0.0, 0.0), 1.0, Grade.GOOD, 1),
        verdict((0.5, 0.0), 55.0, Grade.FAIL, 2),
        verdict((0.0, 0.5), None, Grade.SKIPPED, 3),
        verdict((0.5, 0.5), None, Grade.OPEN, 4),
    ]
    path_m = np.array([(0.0, 0.0), (0.5, 0.0), (np.nan, np.nan), (1.0, 1.0), (2.0, 1.0)])
    figure = run_map(mirror, path_m, points, WIDE, "title")
    axes, bar = figure.axes
    labels = axes.get_legend_handles_labels()[1]
    assert labels == ["driven path", "base", "beyond 10 mm", "skipped", "not measured"]
    np.testing.assert_array_equal(axes.lines[0].get_xydata(), path_m)
    errors = axes.collections[-1]
    assert errors.get_array().tolist() == [1.0, 55.0]  # type: ignore[union-attr]
    assert (errors.norm.vmin, errors.norm.vmax) == (0.0, 10.0)
    assert bar.get_ylabel() == "arrival error, mm"
    low, high = mirror.rim.vertices.min(axis=0), mirror.rim.vertices.max(axis=0)
    assert axes.get_xlim()[0] < low[0] < high[0] < axes.get_xlim()[1]
    shown = {title.text for title in ET.fromstring(svg_of(figure)).iter(f"{{{SVG}}}title")}
    reported = ("pass, measured at 1.00 mm", "fail, measured at 55.00 mm", "skipped", "not measured")
    assert shown == {f"5/5/{number}: {text}" for number, text in enumerate(reported, 1)}
    phone = ET.fromstring(svg_of(run_map(mirror, path_m, points, NARROW, "title")))
    assert not list(phone.iter(f"{{{SVG}}}title"))
    for some in ([], [verdict((0.0, 0.0), 0.0, Grade.GOOD)]):
        assert len(run_map(mirror, np.empty((0, 2)), some, WIDE, "title").axes) == 2


def series(error_mm: float) -> ErrorSeries:
    t_s = np.arange(600.0)
    fixes = np.array([100.0, 200.0])
    return ErrorSeries(t_s, t_s * 0 + 3.0, t_s * 0 + error_mm, (300.0,), fixes, fixes / 100.0, np.array([True, False]))


@pytest.mark.parametrize(
    ("error_mm", "known", "limit"),
    [
        (1.0, ["true error, least to largest"], []),
        (20.0, ["true error, least to largest"], ["10 mm"]),
        (np.nan, [], []),
    ],
)
def test_errors_over_time(error_mm: float, known: list[str], limit: list[str]) -> None:
    (axes,) = error_figure(series(error_mm), WIDE).axes
    labels = axes.get_legend_handles_labels()[1]
    assert labels == [*known, "3 \u03c3 of the estimate", "fix: correction", "fix, not taken", *limit]
    assert axes.get_xlim() == pytest.approx((0.0, 599.0 / 60.0))
    assert axes.get_yscale() == "log"
    assert [5.0, 5.0] in [np.asarray(line.get_xdata()).tolist() for line in axes.lines]  # a new session


def test_where_the_time_went() -> None:
    budget = TimeBreakdown({"turn": 40.0, "drive": 60.0}, {"turn": 30.0, "drive": 50.0}, {}, True, "all")
    (axes,) = time_figure([("this run", budget)], 3600.0, WIDE).axes
    assert [label.get_text() for label in axes.get_yticklabels()] == ["this run", "least"]
    widths = [[bar.get_width() for bar in bars] for bars in axes.containers]
    assert widths == [[40.0, 30.0], [60.0, 50.0]]
    assert {"100 s", "80 s", "60"} <= {text.get_text() for text in axes.texts}
    assert "budget" not in axes.get_legend_handles_labels()[1]
    (axes,) = time_figure([("this run", budget)], 120.0, WIDE).axes
    assert "budget" in axes.get_legend_handles_labels()[1]


# -- map of a run directory -------------------------------------------------------------------------------------------

HEIGHT_M = 0.05


def test_a_run_directory_becomes_a_picture(run_dir: Path) -> None:
    found = read_record(run_dir)
    figure = record_map(found, WIDE)
    axes = figure.axes[0]
    assert re.fullmatch(r"fyst-m1: 9 of 9 points in \d min \d\d s", str(figure.get_label()))
    assert "simulation, world hard  ·  seed 1  ·  filter ekf  ·  arrival error: mean" in axes.get_title(loc="left")
    path_m, truth = np.asarray(axes.lines[0].get_xydata()), found.sessions[0].truth
    assert truth is not None  # which is drawn, not the estimate
    np.testing.assert_array_equal(path_m, [*truth.place[:, :2], [np.nan, np.nan]])
    assert axes.collections[-1].get_array().tolist() == [one.left_mm for one in point_verdicts(found)]  # type: ignore[union-attr]
    for name in ("summary.json", "telemetry.mcap"):  # as after kill -9
        (run_dir / name).unlink()
    draw_from_run_dir(run_dir, run_dir / "map.png")
    picture = (run_dir / "map.png").read_bytes()
    assert (picture[:8], int.from_bytes(picture[16:20], "big")) == (PNG, MAP_WIDTH_PX)


def test_arrival_error_is_the_distance_of_foot_and_point(mirror: Mirror) -> None:
    point = mirror.point_ids(PanelId(2, 3))[7]
    x, y = mirror.point_on_deck(point)
    here, off = (mirror.puck_world(DeckPose(x + ahead, y, 0.0), HEIGHT_M) for ahead in (0.0, 2e-3))
    # foot_of_puck converges to 1e-10 m
    assert measured_error_m(mirror, point, here, HEIGHT_M) == pytest.approx(0.0, abs=1e-9)
    rise = mirror.surface.height_m(x + 2e-3, y) - mirror.surface.height_m(x, y)
    assert measured_error_m(mirror, point, off, HEIGHT_M) == pytest.approx(hypot(2e-3, rise), abs=1e-9)


def test_what_cannot_be_drawn_is_said_in_one_line(tmp_path: Path, without: Callable[..., Path], run_dir: Path) -> None:
    with pytest.raises(RunReadError, match=r"no config\.toml there"):
        draw_from_run_dir(tmp_path, tmp_path / "map.png")
    for out in (tmp_path / "nowhere" / "map.png", tmp_path / "map.what"):
        with pytest.raises(PictureError, match="cannot be written"):
            draw_from_run_dir(run_dir, out)
    with pytest.raises(PictureError, match=r"no mission\.sqlite there"):
        draw_from_run_dir(without("mission.sqlite"), tmp_path / "map.png")
