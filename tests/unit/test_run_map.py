"""Tests of the map of a run: it renders, and shows what the run directory holds."""

import json
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
from ccatp.report.findings import arrival_error_m
from ccatp.report.mirror_map import MAP_WIDTH_PX, MapPoint, draw_from_run_dir, record_map, run_map
from ccatp.report.plots import WIDE, PictureError, save_figure
from ccatp.report.record import read_record

PNG = b"\x89PNG\r\n\x1a\n"
POINTS = [PointId(5, 5, n) for n in range(1, 10)]
HEIGHT_M = 0.05


@pytest.fixture(scope="module")
def mirror() -> Mirror:
    return build_mirror(load_config().mirror)


def fix_at(mirror: Mirror, x: float, y: float) -> Fix:
    return Fix(1.0, mirror.puck_world(DeckPose(x, y, 0.0), HEIGHT_M), (0.0,) * 9, 1.0, (1, 2, 3, 4), 0.0)


def make_run(run_dir: Path, mirror: Mirror) -> None:
    """Four points measured 3-4-5 mm off, one skipped, the others to come; a path in two recordings."""
    cfg = load_config()
    (run_dir / "config.toml").write_text(dump_config(cfg))
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


def test_a_run_directory_becomes_a_png(tmp_path: Path, mirror: Mirror) -> None:
    make_run(tmp_path, mirror)
    draw_from_run_dir(tmp_path, tmp_path / "map.png")
    content = (tmp_path / "map.png").read_bytes()
    assert content.startswith(PNG)
    assert int.from_bytes(content[16:20], "big") == MAP_WIDTH_PX
    figure = record_map(read_record(tmp_path), WIDE)
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


def test_a_run_that_was_killed_is_drawn_too(tmp_path: Path, mirror: Mirror) -> None:
    make_run(tmp_path, mirror)
    for name in ("summary.json", "telemetry.mcap", "telemetry.1.mcap"):
        (tmp_path / name).unlink()
    draw_from_run_dir(tmp_path, tmp_path / "map.svg")
    assert "fyst-m1" in (tmp_path / "map.svg").read_text() or (tmp_path / "map.svg").stat().st_size > 10_000


def test_errors_far_out_and_no_points_at_all_are_drawn(tmp_path: Path, mirror: Mirror) -> None:
    far = [MapPoint(0.0, 0.0, 55.0), MapPoint(0.1, 0.1, 0.0)]
    for number, points in enumerate((far, [], [MapPoint(0.0, 0.0, 0.0)])):
        out = tmp_path / f"{number}.png"
        save_figure(run_map(mirror, np.empty((0, 2)), points, WIDE, "title"), out)
        assert out.read_bytes().startswith(PNG)


def test_arrival_error_is_the_distance_of_foot_and_point(mirror: Mirror) -> None:
    point = mirror.point_ids(PanelId(2, 3))[7]
    x, y = mirror.point_on_deck(point)
    # foot_of_puck converges to 1e-10 m
    assert arrival_error_m(mirror, point, fix_at(mirror, x, y).position_m, HEIGHT_M) == pytest.approx(0.0, abs=1e-9)
    rise = mirror.surface.height_m(x + 2e-3, y) - mirror.surface.height_m(x, y)
    moved = arrival_error_m(mirror, point, fix_at(mirror, x + 2e-3, y).position_m, HEIGHT_M)
    assert moved == pytest.approx(hypot(2e-3, rise), abs=1e-9)


def test_what_cannot_be_drawn_is_said_in_one_line(tmp_path: Path, mirror: Mirror) -> None:
    with pytest.raises(RunReadError, match=r"no config\.toml there"):
        draw_from_run_dir(tmp_path, tmp_path / "map.png")
    make_run(tmp_path, mirror)
    with pytest.raises(PictureError, match="cannot be written"):
        draw_from_run_dir(tmp_path, tmp_path / "nowhere" / "map.png")
    with pytest.raises(PictureError, match="cannot be written"):
        draw_from_run_dir(tmp_path, tmp_path / "map.what")
    (tmp_path / "mission.sqlite").unlink()
    with pytest.raises(PictureError, match=r"no mission\.sqlite there"):
        draw_from_run_dir(tmp_path, tmp_path / "map.png")
