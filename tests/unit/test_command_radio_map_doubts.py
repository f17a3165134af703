"""The command ``ccatp radio map``: wrong ranges, ranges in space, motes in a line, scales that cannot be told."""

import json
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ccatp.beacons.datasets.range_csv import read_beacons
from ccatp.cli import main
from tests.unit.beacons.cricket.fields import FloatArray

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
        assert main(["radio", "map", "--json", "--ranges", str(ranges), "--truth", str(where), *args]) == 0
        return json.loads(capsys.readouterr().out)

    return tell


def test_a_wrong_range_is_named_and_blames_nothing_else(tell: Any) -> None:
    data = tell(FLAT, long={0: 2.0})
    assert data["warnings"] == ["1 of 28 ranges contradict the others and count for little: m0 to m1"]
    assert data["rms_m"]["p50"] < 0.005
    assert data["expected_rms_m"] < 0.01


def test_four_wrong_ranges(tell: Any) -> None:
    data = tell(FLAT, long=dict.fromkeys(range(0, 28, 9), 2.0))
    assert data["rms_m"]["p50"] < 0.005
    assert [warning[:30] for warning in data["warnings"]] == ["4 of 28 ranges contradict the "]


def test_a_common_offset_is_still_told(tell: Any) -> None:
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
    assert np.sqrt(read_beacons(out).covariance_m2.diagonal().max()) > 0.1  # metres off, and it shows


@pytest.mark.parametrize("args", [("--dimension", "3"), ("--set", "cricket.dimension=3")])
def test_ranges_in_space(args: tuple[str, ...], tell: Any) -> None:
    data = tell(DEEP, *args)
    assert data["rms_m"]["p50"] < 0.01
    assert data["warnings"] == []


def test_heights_that_are_all_the_same_are_not_missed(tell: Any) -> None:
    assert tell(np.column_stack([FLAT, np.ones(8)]))["warnings"] == []


def test_motes_of_a_simulated_field_have_its_dimension(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["radio", "map", "--dimension", "3"]) == 2
    assert 'cricket.dimension = 3 needs layout = "motes" or "random"' in capsys.readouterr().err


def test_no_scale_where_none_can_be_told(tell: Any) -> None:
    data = tell(FLAT, "--scale", scale=1.1)
    assert (data["scale"], data["expected_rms_m"], data["crlb_m"]) == (None, None, None)
    assert data["warnings"][-1].startswith("no scale can be told from these ranges")


@pytest.mark.parametrize("off_m", [0.0, 0.01])
def test_motes_in_a_line_with_noise(off_m: float, tell: Any) -> None:
    off = np.random.default_rng(2).normal(0.0, 1.0, 6) * off_m
    data = tell(np.column_stack([1.3 * np.arange(6), off]))
    assert (data["expected_rms_m"], data["crlb_m"]) == (None, None)
    assert data["warnings"][-1].startswith("the motes lie in a line, or nearly")


def test_a_thin_field_is_no_line(tell: Any) -> None:
    places = np.column_stack([1.3 * np.arange(6), np.tile([0.0, 0.8], 3)])
    data = tell(places)
    assert data["warnings"] == []
    assert data["expected_rms_m"] < 0.05


def test_motes_in_a_plane_mapped_in_space(tell: Any) -> None:
    data = tell(np.column_stack([FLAT, np.ones(8)]), "--dimension", "3")
    assert data["expected_rms_m"] is None
    assert data["warnings"][-1].startswith("the motes lie in a plane, or nearly")


def test_unknown_scale_for_people(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "r.csv"
    path.write_text("first,second,range_m\nA,B,3\nB,C,4\nA,C,5\n")
    assert main(["radio", "map", "--scale", "--offset", "--ranges", str(path)]) == 0
    shown = capsys.readouterr().out
    assert "common offset of the ranges        unknown" in shown
    assert "common scale of the ranges         unknown" in shown


def test_comments_in_a_file_of_ranges(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "r.csv"
    path.write_text("# three motes\n\nfirst,second,range_m\n# hello\nA,B,1\n  # more, commas\nB,C,1\nA,C,1\n")
    assert main(["radio", "map", "--json", "--ranges", str(path)]) == 0
    assert json.loads(capsys.readouterr().out)["motes"] == 3
    path.write_text("# three motes\nfirst,second,range_m\n# hello\nA,B,far\n")
    assert main(["radio", "map", "--ranges", str(path)]) == 2
    assert "r.csv:4: range_m = 'far' is no number" in capsys.readouterr().err


@pytest.mark.parametrize(("text", "what"), [("", "is empty"), ("name,x_m,y_m\n", "has no places, only a header")])
def test_an_empty_file_of_places(text: str, what: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, truth = tmp_path / "r.csv", tmp_path / "t.csv"
    path.write_text("first,second,range_m\nA,B,1\n")
    truth.write_text(text)
    assert main(["radio", "map", "--ranges", str(path), "--truth", str(truth)]) == 2
    assert f"t.csv: {what}" in capsys.readouterr().err
