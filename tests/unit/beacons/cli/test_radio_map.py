"""The command ``ccatp radio map``: its JSON and files, recorded and wrong ranges, ranges in space, its refusals."""

import re
import tomllib
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ccatp.cli import main
from tests.support.command import answered, printed, refused
from tests.support.scenario import RADIO_DATA
from tests.unit.beacons.cricket.fields import ALL, HEADS, FloatArray

SESSION = RADIO_DATA / "uwb_planar"
METHODS = ("batch", "ekf")
CONTRACT = {"rms_m", "crlb_m", "rank_deficiency", "fold_over_risk", "phase1_rms_m", "iterations"}


def mapped(capsys: pytest.CaptureFixture[str], *args: str) -> dict[str, Any]:
    data: dict[str, Any] = answered(capsys, "radio", "map", *args)
    assert set(data) >= CONTRACT
    assert set(data["rms_m"]) == {"p10", "p50", "p90"}
    return data


def refusal(capsys: pytest.CaptureFixture[str], *args: str) -> str:
    return refused(capsys, "radio", "map", *args)


def ranges_file(path: Path, pairs: Sequence[tuple[int, int]], noise_m: float = 0.002) -> Path:
    rng = np.random.default_rng(1)
    lines = ["first,second,range_m,sigma_m"]
    for i, j in pairs:
        range_m = float(np.linalg.norm(HEADS[i] - HEADS[j])) + rng.normal(0.0, noise_m)
        lines.append(f"M{i},M{j},{range_m:.5f},{noise_m}")
    path.write_text("\n".join(lines) + "\n")
    return path


def truth_file(path: Path) -> Path:
    path.write_text("name,x_m,y_m\n" + "".join(f"M{number},{x},{y}\n" for number, (x, y) in enumerate(HEADS)))
    return path


def test_the_directions_of_the_frame_stand_apart(capsys: pytest.CaptureFixture[str]) -> None:
    out = printed(capsys, "radio", "map")
    assert "of the frame       translation along x, translation along y, rotation\n" in out
    assert "beyond the frame   0\n  other maps" in out


def test_too_few_pairs_are_reported_before_the_estimation(capsys: pytest.CaptureFixture[str]) -> None:
    programme = ("--set", "cricket.phase2.pairs=zigzag", "--set", "cricket.phase2.max_updates=40")
    data = mapped(capsys, "--method", "ekf", "--seeds", "3", *programme)
    assert data["rank_deficiency"] == 4
    assert data["fold_over_risk"] is True
    assert data["free_directions"][-1] == "N6-1 against N1-1, N2-1"
    assert len(data["free_directions"]) == 4
    assert data["frame_directions"] == []
    assert "N6-1 may be mirrored across the line through N5-1" in data["warnings"]
    assert data["crlb_m"] > 0.1
    assert data["iterations"] == 40


def test_all_pairs_reach_the_target(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, figure = tmp_path / "beacons.toml", tmp_path / "map.svg"
    data = mapped(capsys, "--method", "ekf", "--seeds", "5", "--out", str(out), "--figure", str(figure))
    assert len(tomllib.loads(out.read_text())["beacons"]) == 18
    assert figure.stat().st_size > 10_000
    assert (data["rank_deficiency"], data["fold_over_risk"]) == (0, False)
    assert (data["free_directions"], data["frame_directions"]) == ([], [])
    assert data["rms_m"]["p50"] < 0.007
    assert data["phase1_rms_m"] > 0.05
    assert data["iterations"] <= 30
    assert data["expected_rms_m"] <= 0.005


def test_the_batch_and_its_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, figure = tmp_path / "beacons.toml", tmp_path / "map.png"
    config = tmp_path / "field.toml"
    config.write_text('system = "cricket"\n[cricket.ranging]\nrepeats = 20\n')
    data = mapped(capsys, "--config", str(config), "--seed", "4", "--out", str(out), "--figure", str(figure))
    assert data["rms_m"]["p50"] < 1.6 * data["crlb_m"]
    assert figure.read_bytes().startswith(b"\x89PNG")
    written = tomllib.loads(out.read_text())
    assert len(written["beacons"]) == 18
    assert written["beacons"]["N1-1"]["position_m"] == pytest.approx([0.0, 1.0])
    assert written["beacons"]["N6-1"]["position_m"] == pytest.approx([5.0, 8.0], abs=0.05)
    assert np.shape(written["joint"]["covariance_m2"]) == (36, 36)
    assert np.linalg.eigvalsh(written["joint"]["covariance_m2"])[0] > -1e-12


def test_measured_ranges(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, truth = ranges_file(tmp_path / "r.csv", ALL * 3), truth_file(tmp_path / "t.csv")
    for method in METHODS:
        data = mapped(capsys, "--ranges", str(path), "--truth", str(truth), "--method", method)
        assert data["rms_m"]["p50"] < 0.004
        assert data["rms_m"]["p50"] < 3.0 * data["crlb_m"]
    out = tmp_path / "b.toml"
    data = mapped(capsys, "--ranges", str(path), "--out", str(out), "--figure", str(tmp_path / "m.png"))
    assert data["rms_m"] == {"p10": None, "p50": None, "p90": None}
    first = next(iter(tomllib.loads(out.read_text())["beacons"].values()))
    assert first["position_m"] == pytest.approx([0.0, 0.0], abs=1e-12)
    assert data["measure_next"]["after_m"] < data["measure_next"]["map_m"] == pytest.approx(data["expected_rms_m"])


def test_one_pair_that_was_measured_less_is_to_be_measured_next(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """M2 hangs on the others by three ranges, each once: all others have theirs sixty times."""
    path = ranges_file(tmp_path / "r.csv", [pair for pair in ALL if 2 not in pair] * 60 + [(0, 2), (1, 2), (2, 3)])
    rows = printed(capsys, "radio", "map", "--ranges", path).splitlines()
    line = next(row for row in rows if "measure next" in row)
    assert "M2" in line.split(":")[0].split()


def test_the_report_for_people(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = ranges_file(tmp_path / "r.csv", [pair for pair in ALL if 5 not in pair] + [(4, 5)])
    assert main(["radio", "map", "--ranges", str(path)]) == 0
    shown = capsys.readouterr()
    assert "free directions beyond the frame   1" in shown.out
    assert "M5 against M0, M1, M2, M3, M4" in shown.out
    assert "least error (Cramér-Rao)           unknown" in shown.out
    assert "warning: M5 may be mirrored" in shown.err


@pytest.mark.skipif(not SESSION.is_dir(), reason=f"no recorded data at {SESSION}")
@pytest.mark.parametrize("with_tags", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_eight_surveyed_anchors(with_tags: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Recorded ranges between a trolley's tags and eight anchors: 0.20 m of error, less than 0.08 with an offset."""
    tables = {"Anchor": ["name,x_m,y_m"], "Tag": ["name,x_m,y_m"]}
    for line in (SESSION / "README.md").read_text().splitlines():
        if found := re.match(r"\|\s*(Anchor|Tag) (\d)\s*\|\s*(\S+)\s*\|\s*(\S+)\s*\|", line):
            tables[found[1]].append(f"{found[1].lower()}{found[2]},{found[3]},{found[4]}")
    truth, tags = tmp_path / "truth.csv", tmp_path / "tags.csv"
    truth.write_text("\n".join(tables["Anchor"]) + "\n")
    tags.write_text("\n".join(tables["Tag"]) + "\n")
    args = ["--ranges", str(SESSION / "session_8_14.csv"), "--truth", str(truth)]
    args += ["--tags", str(tags)] if with_tags else []
    plain, offset = mapped(capsys, *args), mapped(capsys, *args, "--offset")
    assert plain["motes"] == 8
    assert any("all ranges look 12" in warning for warning in plain["warnings"])
    assert plain["rms_m"]["p50"] == pytest.approx(0.199, abs=0.01)
    assert offset["rms_m"]["p50"] < 0.080
    assert offset["offset_m"] == pytest.approx(0.12, abs=0.01)


def measured(path: Path, rows: str, capsys: pytest.CaptureFixture[str], *args: str) -> dict[str, Any]:
    path.write_text("first,second,range_m\n" + rows)
    return mapped(capsys, "--ranges", str(path), *args)


def test_two_motes_are_a_map(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for method in METHODS:
        data = measured(tmp_path / "r.csv", "A,B,1.0\n", capsys, "--method", method)
        assert (data["motes"], data["rank_deficiency"], data["warnings"]) == (2, 0, [])
        assert data["expected_rms_m"] < 0.01


@pytest.mark.parametrize("rows", ["A,B,1\nB,C,1\nA,C,2\n", "A,B,1\nB,C,1\nA,C,2\nA,D,3\nB,D,2\nC,D,1\n"])
def test_motes_in_a_line(rows: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "r.csv"
    data = measured(path, rows, capsys)
    assert (data["crlb_m"], data["expected_rms_m"]) == (None, None)
    assert data["warnings"][-1].startswith("the motes lie in a line, or nearly: the ranges do not determine how far")
    line = refusal(capsys, "--ranges", str(path), "--method", "ekf")
    assert "the motes lie in a line, or nearly: the filter has no beginning" in line


def test_ranges_of_one_pair_that_disagree(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = "A,B,1\nB,A,4\nB,C,1\nA,C,1.2\nA,D,1\nB,D,1\nC,D,1.1\n"
    data = measured(tmp_path / "r.csv", rows, capsys)
    assert data["warnings"][0] == (
        "ranges between A and B disagree among themselves: 1 to 4 m with a sigma of 0.00667 m"
    )
    sound = measured(tmp_path / "r.csv", rows.replace("B,A,4", "B,A,1.01"), capsys)
    assert not any("disagree" in warning for warning in sound["warnings"])


IN_SPACE = "--set cricket.dimension=3 --set cricket.layout=random --set cricket.random.size_m=[1,1,1]"


NOISE_M = 0.005
FLAT = np.random.default_rng(1).uniform(0.0, 8.0, (8, 2))
DEEP = np.random.default_rng(1).uniform(0.0, 8.0, (8, 3))


@pytest.fixture(name="tell")
def _tell(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Any:
    """Map ranges between places, some too long, and return the data of ``--json``."""

    def tell(places: FloatArray, *args: str, long: dict[int, float] | None = None, scale: float = 1.0) -> Any:
        rng = np.random.default_rng(0)
        rows = ["first,second,range_m"]
        for row, (i, j) in enumerate(combinations(range(len(places)), 2)):
            true_m = float(np.linalg.norm(places[i] - places[j]))
            range_m = scale * true_m + rng.normal(0.0, NOISE_M) + (long or {}).get(row, 0.0)
            rows.append(f"m{i},m{j},{range_m:.5f}")
        axes = ["x_m", "y_m", "z_m"][: places.shape[1]]
        truth = ["name," + ",".join(axes)]
        truth += [f"m{i}," + ",".join(f"{value:.4f}" for value in place) for i, place in enumerate(places)]
        ranges, where = tmp_path / "r.csv", tmp_path / "t.csv"
        ranges.write_text("\n".join(rows) + "\n")
        where.write_text("\n".join(truth) + "\n")
        return answered(capsys, "radio", "map", "--ranges", ranges, "--truth", where, *args)

    return tell


@pytest.mark.parametrize(("places", "more"), [(FLAT, ()), (DEEP, ("--dimension", "3"))])
def test_a_wrong_range_is_named_and_blames_nothing_else(places: FloatArray, more: tuple[str, ...], tell: Any) -> None:
    data = tell(places, *more, long={0: 2.0})
    assert data["warnings"] == ["1 of 28 ranges contradict the others and count for little: m0 to m1"]
    assert data["rms_m"]["p50"] < 0.005
    assert data["expected_rms_m"] < 0.01


def test_a_common_offset_is_still_reported(tell: Any) -> None:
    data = tell(FLAT, long=dict.fromkeys(range(28), 0.3) | {3: 2.3})
    assert any(warning.startswith("all ranges look 299 mm long") for warning in data["warnings"])
    assert data["expected_rms_m"] is None
    offset = tell(FLAT, "--offset", long=dict.fromkeys(range(28), 0.3) | {3: 2.3})
    assert offset["offset_m"] == pytest.approx(0.3, abs=0.01)
    assert offset["rms_m"]["p50"] < 0.01


def test_ranges_in_space_mapped_in_the_plane(tell: Any, tmp_path: Path) -> None:
    out = tmp_path / "b.toml"
    data = tell(DEEP[:7], "--out", str(out))
    assert data["warnings"][0].startswith("--truth: z_m, which differs by")
    denied = next(warning for warning in data["warnings"] if warning.startswith("the map contradicts its ranges"))
    assert "--dimension 3" in denied
    assert data["expected_rms_m"] is None
    assert not any("--offset" in warning for warning in data["warnings"])
    covariance_m2 = tomllib.loads(out.read_text())["joint"]["covariance_m2"]
    assert np.sqrt(np.diag(covariance_m2).max()) > 0.1  # metres off, and it shows


def test_no_scale_is_given_where_none_can_be_determined(tell: Any) -> None:
    data = tell(FLAT, "--scale", scale=1.1)
    assert (data["scale"], data["expected_rms_m"], data["crlb_m"]) == (None, None, None)
    assert data["warnings"][-1].startswith("no scale can be determined from these ranges")


@pytest.mark.parametrize(
    "places", [np.column_stack([FLAT, np.ones(8)]), np.column_stack([1.3 * np.arange(6), np.tile([0.0, 0.8], 3)])]
)
def test_equal_heights_and_a_thin_field_raise_no_doubt(places: FloatArray, tell: Any) -> None:
    data = tell(places)
    assert data["warnings"] == []
    assert data["expected_rms_m"] < 0.05
