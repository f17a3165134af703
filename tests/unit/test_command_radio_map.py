"""The command ``ccatp radio map``: its JSON and files, recorded and wrong ranges, ranges in space, its refusals."""

import json
import re
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ccatp.beacons.cricket.range_network import MappingError
from ccatp.beacons.datasets.range_csv import BeaconFileError, read_beacons, read_places, read_ranges, write_beacons
from ccatp.cli import main
from tests.unit.beacons.cricket.fields import ALL, HEADS, FloatArray

SESSION = Path(__file__).parents[2].parent / "shared" / "data" / "radio" / "uwb_planar"
CONTRACT = {"rms_m", "crlb_m", "rank_deficiency", "fold_over_risk", "phase1_rms_m", "iterations"}


def mapped(capsys: pytest.CaptureFixture[str], *args: str) -> dict[str, Any]:
    assert main(["radio", "map", "--json", *args]) == 0
    data: dict[str, Any] = json.loads(capsys.readouterr().out)
    assert set(data) >= CONTRACT
    assert set(data["rms_m"]) == {"p10", "p50", "p90"}
    return data


def refusal(capsys: pytest.CaptureFixture[str], *args: str) -> str:
    assert main(["radio", "map", *args]) == 2
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.count("\n") == 1
    return shown.err


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


def test_few_pairs_are_told_before_they_are_estimated(capsys: pytest.CaptureFixture[str]) -> None:
    data = mapped(
        capsys,
        "--method",
        "ekf",
        "--seeds",
        "3",
        "--set",
        "cricket.phase2.pairs=zigzag",
        "--set",
        "cricket.phase2.max_updates=40",
    )
    assert data["rank_deficiency"] == 4
    assert data["fold_over_risk"] is True
    assert data["free_directions"][-1] == "N6-1 against N1-1, N2-1"
    assert "N6-1 may be mirrored across the line through N5-1" in data["warnings"]
    assert data["crlb_m"] > 0.1
    assert data["iterations"] == 40


def test_all_pairs_reach_the_target(capsys: pytest.CaptureFixture[str]) -> None:
    data = mapped(capsys, "--method", "ekf", "--seeds", "5")
    assert (data["rank_deficiency"], data["fold_over_risk"]) == (0, False)
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
    beacons = read_beacons(out)
    assert len(beacons.names) == 18
    at = beacons.names.index("N1-1")
    assert beacons.positions_m[at] == pytest.approx([0.0, 1.0])
    assert beacons.positions_m[beacons.names.index("N6-1")] == pytest.approx([5.0, 8.0], abs=0.05)
    assert beacons.covariance_m2.shape == (36, 36)
    assert np.linalg.eigvalsh(beacons.covariance_m2)[0] > -1e-12


def test_the_filters_file_holds_all_motes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, figure = tmp_path / "beacons.toml", tmp_path / "map.svg"
    mapped(capsys, "--method", "ekf", "--seeds", "2", "--out", str(out), "--figure", str(figure))
    assert len(read_beacons(out).names) == 18
    assert "updates" in figure.read_text() or figure.stat().st_size > 10_000


def test_measured_ranges(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, truth = ranges_file(tmp_path / "r.csv", ALL * 3), truth_file(tmp_path / "t.csv")
    for method in ("batch", "ekf"):
        data = mapped(capsys, "--ranges", str(path), "--truth", str(truth), "--method", method)
        assert data["rms_m"]["p50"] < 0.004
        assert data["rms_m"]["p50"] < 3.0 * data["crlb_m"]
    out = tmp_path / "b.toml"
    data = mapped(capsys, "--ranges", str(path), "--out", str(out), "--figure", str(tmp_path / "m.png"))
    assert data["rms_m"] == {"p10": None, "p50": None, "p90": None}
    assert read_beacons(out).positions_m[0] == pytest.approx([0.0, 0.0], abs=1e-12)


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


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("first,second,range_m\nA,B,-1.0\n", ":2: range of -1 m is no distance"),
        ("first,second,range_m\nA,B,nan\n", ":2: range of nan m is no distance"),
        ("first,second,range_m\nA,B,0\n", ":2: range of 0 m is no distance"),
        ("first,second,range_m\nA,B,inf\n", ":2: range of inf m is more than the 1e+06 m"),
        ("first,second,range_m\nA,B,1e300\n", ":2: range of 1e+300 m is more than the 1e+06 m"),
        ("first,second,range_m\nA,B,1.0,more\nB,C\n", ":3: range_m = '' is no number"),
        ("", "ranges.csv: is empty; give a header"),
        ("\n \n# nothing\n", "ranges.csv: is empty; give a header"),
        ("first,second,range_m\nA,A,1.0\n", ":2: from A to itself"),
        ("first,second,range_m\nA,B,far\n", ":2: range_m = 'far' is no number"),
        ("first,second,range_m,sigma_m\nA,B,1.0,0\n", ":2: sigma of 0 m, must be 1e-06 to 1e+06 m"),
        ("first,second,range_m,sigma_m\nA,B,1.0,1e-200\n", ":2: sigma of 1e-200 m, must be 1e-06 to 1e+06 m"),
        ("first,second,range_m\nA,B,1e-300\n", ":2: range of 1e-300 m is no distance"),
        ("first,second,range_m\nA,,1.0\n", ":2: second is empty"),
        ("first,second,range_m\n", "has no ranges, only a header"),
        ("session,pos,deg,anchor,tag,mean_m\n", "has no ranges, only a header"),
        ("a,b,c\n1,2,3\n", ":1: columns a,b,c; wanted first,second,range_m"),
        ("first,second,range_m\nA,B,1.0\nC,D,1.0\n", "the motes fall into 2 parts"),
        ("first,second,range_m\nA,B,1.0\nB,C,1.0\nC,D,1.0\n", "3 pairs of 4 motes were measured, a map in 2"),
    ],
)
def test_ranges_that_make_no_map(text: str, what: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "ranges.csv"
    path.write_text(text)
    assert what in refusal(capsys, "--ranges", str(path))


def measured(path: Path, rows: str, capsys: pytest.CaptureFixture[str], *args: str) -> dict[str, Any]:
    path.write_text("first,second,range_m\n" + rows)
    return mapped(capsys, "--ranges", str(path), *args)


def test_two_motes_are_a_map(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "r.csv"
    data = measured(path, "A,B,1.0\n", capsys)
    assert (data["motes"], data["rank_deficiency"], data["warnings"]) == (2, 0, [])
    assert data["expected_rms_m"] < 0.01
    assert "no triangle of motes" in refusal(capsys, "--ranges", str(path), "--method", "ekf")


def test_a_triangle_is_not_in_doubt_of_its_mirror_image(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for method in ("batch", "ekf"):
        data = measured(tmp_path / "r.csv", "A,B,1\nB,C,1\nA,C,1\n", capsys, "--method", method)
        assert (data["warnings"], data["fold_over_risk"]) == ([], False)
        assert data["crlb_m"] < 0.01


@pytest.mark.parametrize("rows", ["A,B,1\nB,C,1\nA,C,2\n", "A,B,1\nB,C,1\nA,C,2\nA,D,3\nB,D,2\nC,D,1\n"])
def test_motes_in_a_line(rows: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "r.csv"
    data = measured(path, rows, capsys)
    assert (data["crlb_m"], data["expected_rms_m"]) == (None, None)
    assert data["warnings"][-1].startswith("the motes lie in a line, or nearly: the ranges do not tell how far")
    assert "the best motes to begin with lie in a line, or nearly" in refusal(
        capsys, "--ranges", str(path), "--method", "ekf"
    )


def test_ranges_of_one_pair_that_disagree(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = "A,B,1\nB,A,4\nB,C,1\nA,C,1.2\nA,D,1\nB,D,1\nC,D,1.1\n"
    data = measured(tmp_path / "r.csv", rows, capsys)
    assert data["warnings"][0] == (
        "ranges between A and B disagree among themselves: 1 to 4 m with a sigma of 0.00667 m"
    )
    sound = measured(tmp_path / "r.csv", rows.replace("B,A,4", "B,A,1.01"), capsys)
    assert not any("disagree" in warning for warning in sound["warnings"])


def test_files_that_do_not_fit_each_other(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = ranges_file(tmp_path / "r.csv", ALL)
    places = tmp_path / "p.csv"
    places.write_text("name,x_m,y_m\nM0,0,0\n")
    assert "--truth: no place of M1, M2, M3, M4, M5; there are M0" in refusal(
        capsys, "--ranges", str(path), "--truth", str(places)
    )
    assert "--tags: these ranges are of no trolley" in refusal(capsys, "--ranges", str(path), "--tags", str(places))
    places.write_text("name,x\nM0,0\n")
    assert "p.csv:1: columns name,x; wanted name,x_m,y_m" in refusal(
        capsys, "--ranges", str(path), "--truth", str(places)
    )
    session = tmp_path / "s.csv"
    session.write_text(
        "session,pos,deg,anchor,tag,mean_m\n"
        + "".join(f"s,1,0,{a},{t},{3 + a + t}\n" for a in range(4) for t in range(3))
    )
    places.write_text("name,x_m,y_m\ntag0,0,0\n")
    assert "--tags: no place of tag1; there are tag0" in refusal(
        capsys, "--ranges", str(session), "--tags", str(places)
    )
    places.write_text("name,x_m,y_m\ntag0,0,0\ntag1,0.2,0\ntag2,0,0.2\n")
    assert "the filter knows no trolleys" in refusal(
        capsys, "--ranges", str(session), "--tags", str(places), "--method", "ekf"
    )


def test_a_truth_of_too_few_coordinates(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, truth = ranges_file(tmp_path / "r.csv", ALL), truth_file(tmp_path / "t.csv")
    shown = refusal(
        capsys,
        "--ranges",
        str(path),
        "--truth",
        str(truth),
        "--set",
        "cricket.dimension=3",
        "--set",
        "cricket.layout=random",
        "--set",
        "cricket.random.size_m=[1,1,1]",
    )
    assert "--truth: M0 has 2 coordinates, wanted 3" in shown


def test_a_place_that_is_none(tmp_path: Path) -> None:
    (tmp_path / "p.csv").write_text("name,x_m,y_m\nM0,0,0\nM1,nan,0\n")
    with pytest.raises(MappingError, match=r"p\.csv:3: x_m = nan is no place within 1e\+06 m"):
        read_places(tmp_path / "p.csv")


def test_usage(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "r.csv: no such file or directory; name a CSV file that exists" in refusal(
        capsys, "--ranges", str(tmp_path / "r.csv")
    )
    assert "--seeds is for simulated ranges" in refusal(capsys, "--ranges", "r.csv", "--seeds", "2")
    assert "--tags and --truth go with --ranges" in refusal(capsys, "--tags", "t.csv")
    assert "--out: no directory" in refusal(capsys, "--out", str(tmp_path / "no" / "b.toml"))
    (tmp_path / "binary.csv").write_bytes(b"\xff\xfe\x00")
    assert "is no CSV text" in refusal(capsys, "--ranges", str(tmp_path / "binary.csv"))


def test_fields_that_cannot_be_mapped(capsys: pytest.CaptureFixture[str]) -> None:
    deaf = ("--set", "cricket.transducer.reach_m=[1,1,1,1,1]")
    assert "no pair of phase 2 receives each other" in refusal(capsys, "--method", "ekf", *deaf)
    narrow = ("--set", "cricket.phase1.max_dop=5")
    assert "N2-1 from N1-1, N1-2, N1-3: dilution of precision" in refusal(capsys, "--method", "ekf", *narrow)
    apart = ("--set", "cricket.layout=random", "--set", "cricket.random.count=30", "--set", "cricket.random.reach_m=9")
    assert "the motes fall into" in refusal(capsys, *apart)


def test_a_figure_that_no_format_has(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = ranges_file(tmp_path / "r.csv", ALL)
    assert "m.gifx: no format by that name" in refusal(
        capsys, "--ranges", str(path), "--figure", str(tmp_path / "m.gifx")
    )


def test_beacon_files(tmp_path: Path) -> None:
    path = tmp_path / "b.toml"
    rng = np.random.default_rng(1)
    places, root = rng.normal(size=(3, 3)), rng.normal(size=(9, 9))
    write_beacons(path, ["N1-1", "b", "c"], places, root @ root.T, "here")
    found = read_beacons(path)
    assert found.names == ("N1-1", "b", "c")
    assert (found.positions_m == places).all()
    assert (found.covariance_m2 == root @ root.T).all()
    assert found.frame == "here"
    with pytest.raises(BeaconFileError, match="cannot be written"):
        write_beacons(tmp_path / "no" / "b.toml", ["a"], places[:1], np.eye(3), "here")
    with pytest.raises(BeaconFileError, match="cannot be read as a map of beacons"):
        read_beacons(tmp_path / "none.toml")
    path.write_text("x = 1\n")
    with pytest.raises(BeaconFileError, match="is no map of beacons: 'beacons'"):
        read_beacons(path)
    path.write_text('frame = "x"\n[beacons.a]\nposition_m = [0.0, 0.0]\n[joint]\ncovariance_m2 = [[1.0]]\n')
    with pytest.raises(BeaconFileError, match=r"covariance of shape \(1, 1\) for 2 coordinates"):
        read_beacons(path)


def test_ranges_of_both_forms(tmp_path: Path) -> None:
    path = tmp_path / "r.csv"
    path.write_text("\ufefffirst, second ,range_m,sigma_m\n A ,B,1.5,\nB,C,2.0,0.3\n")
    found = read_ranges(path, 0.1)
    assert [tuple(row) for row in found.readings] == [("A", "B", 1.5, 0.1), ("B", "C", 2.0, 0.3)]
    path.write_text(
        "session,pos,deg,anchor,tag,n,mean_m,median_m,std_m\n8_14,1,60,2,0,10,4.8,4.8,0.02\n8_14,1,60,2,1,10,4.5,4.5,0.02\n"
    )
    found = read_ranges(path, 0.1)
    assert found.groups == {"1/60": ("1/60/tag0", "1/60/tag1")}
    assert found.tags == {"1/60/tag0": "tag0", "1/60/tag1": "tag1"}
    assert found.readings[0].first == "anchor2"
    path.write_text("name,x_m,y_m,z_m\na,1,2,3\n")
    assert read_places(path) == {"a": (1.0, 2.0, 3.0)}


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
