"""Figures: what is drawn, shorter series, SVG for a page, files, the map of a run."""

import json
import xml.etree.ElementTree as ET
from math import hypot
from pathlib import Path

import numpy as np
import pytest

from ccatp.config.load import dump_config, load_config
from ccatp.core import DeckPose, Fix, PanelId, PointId
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.records.recorder import Recorder
from ccatp.records.run_reader import RunReadError
from ccatp.records.store import MissionStore, PlannedPoint
from ccatp.report.figures import distribution_figure, error_figure, time_figure
from ccatp.report.findings import ErrorSeries, Grade, PointVerdict, TimeBreakdown, arrival_error_m
from ccatp.report.mirror_map import MAP_WIDTH_PX, draw_from_run_dir, record_map, run_map
from ccatp.report.plots import (
    NARROW,
    SVG,
    WIDE,
    PictureError,
    add_legend,
    add_tooltips,
    distinct,
    envelope,
    new_plot,
    save_figure,
    svg_of,
)
from ccatp.report.record import read_record

PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture(scope="module")
def mirror() -> Mirror:
    return build_mirror(load_config().mirror)


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


def test_marks_on_one_pixel_are_one() -> None:
    x, y = distinct(np.array([0.0, 0.01, 100.0, 50.0]), np.array([1.0, 1.0, 2.0, 1.5]), 100.0)
    assert (x.tolist(), y.tolist()) == ([0.0, 100.0, 50.0], [1.0, 2.0, 1.5])
    assert len(distinct(np.empty(0), np.empty(0), 100.0)[0]) == 0


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


POINTS = [PointId(5, 5, n) for n in range(1, 10)]


def verdict(place_m: tuple[float, float], left_mm: float | None, grade: Grade, number: int = 1) -> PointVerdict:
    return PointVerdict(POINTS[number - 1], place_m, None, left_mm, grade, "")


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
    told = ("pass, measured at 1.00 mm", "fail, measured at 55.00 mm", "skipped", "not measured")
    assert shown == {f"5/5/{number}: {text}" for number, text in enumerate(told, 1)}
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


def test_a_distribution() -> None:
    (axes,) = distribution_figure({"A": np.array([2.0, 1.0]), "B": np.array([0.5])}, "error, mm", NARROW).axes
    assert [line.get_label() for line in axes.lines] == ["A", "B"]
    assert axes.lines[0].get_xydata().tolist() == [[1.0, 50.0], [2.0, 100.0]]  # type: ignore[union-attr]
    assert axes.get_xlim() == pytest.approx((0.1, 10.0))


# -- map of a run directory -------------------------------------------------------------------------------------------

HEIGHT_M = 0.05


def fix_at(mirror: Mirror, x: float, y: float) -> Fix:
    return Fix(1.0, mirror.puck_world(DeckPose(x, y, 0.0), HEIGHT_M), (0.0,) * 9, 1.0, (1, 2, 3, 4), 0.0)


@pytest.fixture
def run_dir(tmp_path: Path, mirror: Mirror) -> Path:
    """Four points measured 3-4-5 mm off, one skipped, the others to come; a path in two recordings."""
    run_dir = tmp_path / "run"
    run_dir.mkdir()
    (run_dir / "config.toml").write_text(dump_config(load_config()))
    planned = [PlannedPoint(point, 0.0, 0.0) for point in POINTS]
    path = run_dir / "mission.sqlite"
    with MissionStore.create(path, mirror=mirror.name, seed=1, config_toml="", points=planned) as store:
        for point in POINTS[:4]:
            x, y = mirror.point_on_deck(point)
            store.record_fix(point, fix_at(mirror, x + 3e-3, y + 4e-3), DeckPose(x, y, 0.0)).result()
        store.record_skipped(POINTS[4], 2.0).result()
    for _ in range(2):
        recorder = Recorder(run_dir / "telemetry.mcap", [("truth", {}), ("track", {})], is_simulation=True)
        truth = [[i, i / 100, i / 100, 0.5, 0.0, i / 100, 0.5, 0.0, 1.0, 0, 0] for i in range(3)]
        track = [[i, i / 100, 5, 5, 0.0, 0.0, 0.0, 0.001] for i in range(3)]
        for topic, rows in (("truth", truth), ("track", track)):
            recorder.write(topic, 1.0, json.dumps({"seq": 2, "t_s": 1.0, "rows": rows}).encode())
        recorder.close()
    (run_dir / "summary.json").write_text('{"mission_time_s": 125.4}')
    return run_dir


def test_a_run_directory_becomes_a_picture(run_dir: Path) -> None:
    out = run_dir / "map.png"
    draw_from_run_dir(run_dir, out)
    assert out.read_bytes().startswith(PNG)
    assert int.from_bytes(out.read_bytes()[16:20], "big") == MAP_WIDTH_PX
    figure = record_map(read_record(run_dir), WIDE)
    axes = figure.axes[0]
    assert figure.get_label() == "fyst-m1: 4 of 9 points in 2 min 05 s"
    assert "simulation, world thesis  ·  seed 1  ·  filter ekf" in axes.get_title(loc="left")
    path_m = np.asarray(axes.lines[0].get_xydata())
    assert path_m.shape == (8, 2)  # the true path, not the estimated, of both recordings, each with a row of NaN
    np.testing.assert_array_equal(path_m[:3], [[0.0, 0.5], [0.01, 0.5], [0.02, 0.5]])
    assert np.isnan(path_m[[3, 7]]).all()
    marks = {str(marks.get_label()): marks.get_offsets() for marks in axes.collections}
    assert (len(marks["skipped"]), len(marks["not measured"])) == (1, 4)  # type: ignore[arg-type]
    # the slope of the mirror's middle panel makes 5 mm longer by less than 1 %
    assert np.asarray(axes.collections[-1].get_array()) == pytest.approx([5.0] * 4, rel=0.01)
    for name in ("summary.json", "telemetry.mcap", "telemetry.1.mcap"):  # as after kill -9
        (run_dir / name).unlink()
    draw_from_run_dir(run_dir, run_dir / "map.svg")
    assert "fyst-m1: 4 of 9 points<" in (run_dir / "map.svg").read_text()


def test_arrival_error_is_the_distance_of_foot_and_point(mirror: Mirror) -> None:
    point = mirror.point_ids(PanelId(2, 3))[7]
    x, y = mirror.point_on_deck(point)
    # foot_of_puck converges to 1e-10 m
    assert arrival_error_m(mirror, point, fix_at(mirror, x, y).position_m, HEIGHT_M) == pytest.approx(0.0, abs=1e-9)
    rise = mirror.surface.height_m(x + 2e-3, y) - mirror.surface.height_m(x, y)
    moved = arrival_error_m(mirror, point, fix_at(mirror, x + 2e-3, y).position_m, HEIGHT_M)
    assert moved == pytest.approx(hypot(2e-3, rise), abs=1e-9)


def test_what_cannot_be_drawn_is_said_in_one_line(tmp_path: Path, run_dir: Path) -> None:
    with pytest.raises(RunReadError, match=r"no config\.toml there"):
        draw_from_run_dir(tmp_path, tmp_path / "map.png")
    for out in (tmp_path / "nowhere" / "map.png", tmp_path / "map.what"):
        with pytest.raises(PictureError, match="cannot be written"):
            draw_from_run_dir(run_dir, out)
    (run_dir / "mission.sqlite").unlink()
    with pytest.raises(PictureError, match=r"no mission\.sqlite there"):
        draw_from_run_dir(run_dir, tmp_path / "map.png")
