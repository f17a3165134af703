"""Reports of missions among beacons: what is read, what it amounts to, the page, its figures, and what is missing."""

from pathlib import Path

import pytest

from ccatp.beacons.report.page import beacon_data, beacon_drawings, beacon_page
from ccatp.beacons.report.record import (
    beacon_rows,
    pose_errors_m,
    pose_nees,
    read_beacon_record,
    readings_of,
    waypoint_rows,
)
from ccatp.cli import main
from ccatp.records.run_reader import RunReadError
from ccatp.report.plots import NARROW, PX_PER_IN, WIDE
from tests.support.command import answered, printed
from tests.support.pages import Markup
from tests.support.recorded import FRAMES, OFF_M, SIGMA_M, beacon_config, record_beacons

ALL = ["map", "waypoints", "localization", "consistency", "events", "configuration"]


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_beacons(tmp_path_factory.mktemp("beacons") / "run")


def test_errors_and_consistency_of_a_record(run_dir: Path) -> None:
    record = read_beacon_record(run_dir)
    assert len(record.track.seq) == FRAMES  # the frame that was told twice counts once
    assert record.track.sigma_m == pytest.approx(SIGMA_M)
    errors, nees = pose_errors_m(record), pose_nees(record)
    assert errors is not None
    assert errors == pytest.approx(OFF_M)
    assert nees == pytest.approx((OFF_M / SIGMA_M) ** 2)
    readings = readings_of(record)
    assert [reading.nis for reading in readings] == pytest.approx([3.0] * 12)
    assert [reading.size for reading in readings] == [2] * 12
    first, second = beacon_rows(record)
    assert (first.name, first.sigma_m, first.error_m, first.nees) == ("beacon1", *map(pytest.approx, (0.1, 0.1, 1.0)))
    assert second.error_m == 0.0
    assert second.sigma_m == pytest.approx(0.012**0.5)


def test_a_waypoint_that_was_reached(run_dir: Path) -> None:
    (row,) = waypoint_rows(read_beacon_record(run_dir))
    assert (row.number, row.lap, row.waypoint, row.t_s, row.place_m) == (1, 1, 1, 1.0, (0.8, 0.8))
    assert row.sigma_m == pytest.approx(SIGMA_M)
    assert row.true_off_m == pytest.approx((0.2**2 + OFF_M**2) ** 0.5)
    assert row.error_m == pytest.approx(OFF_M)
    assert row.sigmas == pytest.approx(OFF_M / SIGMA_M)


@pytest.mark.usefixtures("drawn")
def test_the_command_and_the_page(run_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "page.html"
    assert printed(capsys, "report", run_dir, "--out", path) == f"{path}\n"
    reported = answered(capsys, "report", run_dir, "--out", path)
    assert reported["report"] == str(path)
    assert (reported["system"], reported["seed"], reported["outcome"]) == ("zigbee", 5, "complete")
    assert reported["waypoints"] == {"total": 4, "reached": 1, "within_3_sigma": 1}
    assert (reported["nis_mean"], reported["position_error_m"]) == (1.5, {"rms": OFF_M, "max": OFF_M})
    page = path.read_text()
    markup = Markup(page)
    assert (markup.outside, markup.anchors) == ([], ALL)
    for text in (
        "SIMULATION, seed 5", '<strong class="good">complete</strong>', "obstacle 1\u00d7",
        "held: &lt;b&gt;near&lt;/b&gt;",  # text stays text
        "mission.laps",  # other than the defaults
        "30 <small>mm rms, 30 largest</small>", "1.500 <small>95 % band",
    ):  # fmt: skip
        assert text in page
    assert main(["compare", str(run_dir), str(run_dir)]) == RunReadError.exit_status
    assert "a mission among beacons; this is for surveys, ccatp report takes both" in capsys.readouterr().err


def test_its_figures_are_drawn_for_screens_and_telephones(run_dir: Path) -> None:
    drawings = beacon_drawings(read_beacon_record(run_dir))
    assert set(drawings) == {"map", "localization", "consistency", "beacons"}
    for width in (WIDE, NARROW):
        for draw in drawings.values():
            picture = draw(width)
            assert picture.get_figwidth() * PX_PER_IN == pytest.approx(width)
            assert picture.get_figheight() * PX_PER_IN > 200.0


def test_a_robot_that_follows(tmp_path: Path) -> None:
    record = read_beacon_record(record_beacons(tmp_path / "run", beacon_config("follow")))
    assert set(record.beacons) == {"beacon1", "beacon2"}  # the one that moves is none of the map
    assert "target" in beacon_drawings(record)
    anchors = Markup(beacon_page(record)).anchors
    assert ("target" in anchors, "waypoints" in anchors) == (True, False)


def test_a_real_robot_has_no_truth(tmp_path: Path) -> None:
    record = read_beacon_record(record_beacons(tmp_path / "run", is_sim=False))
    page = beacon_page(record)
    Markup(page)
    assert "real robot" in page
    assert "The true pose is not known" in page
    data = beacon_data(record)
    assert (data["position_error_m"], data["pose_nees_mean"]) == (None, None)
    assert data["waypoints"] == {"total": 4, "reached": 1, "within_3_sigma": None}


def test_a_run_that_was_killed_says_what_it_lacks(tmp_path: Path) -> None:
    run_dir = record_beacons(tmp_path / "run", ends=False)
    whole = (run_dir / "telemetry.mcap").read_bytes()
    (run_dir / "telemetry.mcap").write_bytes(whole[: int(0.7 * len(whole))])
    record = read_beacon_record(run_dir)
    assert record.missing == ("summary.json: the run is in progress, or was killed before its end",)
    assert any("telemetry.mcap" in warning for warning in record.warnings)
    Markup(beacon_page(record))
    for name in ("telemetry.mcap", "log.jsonl"):
        (run_dir / name).unlink()
    record = read_beacon_record(run_dir)
    assert {line.partition(":")[0] for line in record.missing} == {"telemetry.mcap", "log.jsonl", "summary.json"}
    assert beacon_drawings(record) == {}
    assert Markup(beacon_page(record)).anchors == ["configuration"]
