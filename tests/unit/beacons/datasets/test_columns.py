"""Tables with headers and factor graphs give the run that the CSV of events gives."""

from collections.abc import Callable, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from ccatp.beacons.config.load import load_recordings_config
from ccatp.beacons.datasets.pyfg import pyfg_lines
from ccatp.beacons.datasets.reader import read_run
from ccatp.beacons.datasets.tables import RadioDataError
from ccatp.beacons.estimation.recording import Radio
from tests.unit.beacons.datasets.sets import BEACONS, csv_lines, world, write_lines

W = world(seconds=20.0)
NAMES = list(BEACONS)
RANGES = [(t, NAMES[b], r) for t, b, r in zip(W.read_s, W.read_beacon.tolist(), W.range_m, strict=True)]
POSES = [(t, *pose) for t, pose in zip(W.times_s, W.poses.tolist(), strict=True)]


def lines_of(header: str, rows: Sequence[tuple[object, ...]], mark: str = ",") -> list[str]:
    return [header.replace(",", mark), *(mark.join(map(str, row)) for row in rows)]


def long_form(folder: Path) -> Path:
    write_lines(folder / "odometry.csv", lines_of("time,x,y,yaw", POSES))
    write_lines(folder / "ground_truth.csv", lines_of("time,x,y,yaw", POSES))
    write_lines(folder / "anchors.csv", lines_of("anchor,x,y", [(name, *at) for name, at in BEACONS.items()]))
    return write_lines(folder / "uwb.csv", lines_of("time,anchor,range", RANGES))


def in_units(folder: Path) -> Path:
    long_form(folder)
    rows: list[tuple[object, ...]] = [(1e3 * t, name, 1e3 * r) for t, name, r in RANGES]
    write_lines(folder / "uwb.csv", lines_of("time [ms],anchor,range_mm", rows, ";"))
    rate = np.diff(W.times_s)
    speeds = [(t, v, w) for t, v, w in zip(W.times_s, W.distance_m / rate, W.turn_rad / rate, strict=False)]
    write_lines(folder / "odometry.csv", lines_of("t,vx,yaw_rate (rad/s)", [*speeds, (W.times_s[-1], 0, 0)]))
    return folder


def wide_form(folder: Path) -> Path:
    long_form(folder)
    rows = [(t, *(r if name == one else "" for one in NAMES)) for t, name, r in RANGES]
    write_lines(folder / "uwb.csv", lines_of("time," + ",".join(f"range {name} [m]" for name in NAMES), rows))
    return folder


def with_decimal_commas(folder: Path) -> Path:
    write_lines(folder / "uwb.csv", lines_of("time,anchor,range", RANGES, ";"))
    long_form(folder)
    for file in folder.iterdir():
        text = file.read_text(encoding="utf-8").replace(",", ";").replace(".", ",")
        file.write_bytes(text.replace("\n", "\r\n").encode("utf-16"))
    return folder / "uwb.csv"


def as_pandas_writes(folder: Path) -> Path:
    long_form(folder)
    begin = datetime(1970, 1, 1, tzinfo=UTC)
    rows = [(k, (begin + timedelta(seconds=t)).isoformat(" "), name, r, 0.1) for k, (t, name, r) in enumerate(RANGES)]
    lines = [f'{k},"{t}","{name}",{r},{sigma}' for k, t, name, r, sigma in rows]
    return write_lines(folder / "uwb.csv", ['"ID","Time","Anchor ID","Range (m)","Range Std (m)"', *lines])


def as_evo_writes(folder: Path) -> Path:
    long_form(folder)
    (folder / "odometry.csv").unlink()
    lines = [f"{t} {x} {y} 0 0 0 {2.0 * np.sin(0.5 * h)} {2.0 * np.cos(0.5 * h)}" for t, x, y, h in POSES]
    write_lines(folder / "odometry.txt", ["# timestamp tx ty tz qx qy qz qw", *lines])
    rows = [(t, *(r if name == one else "NaN" for one in NAMES)) for t, name, r in RANGES]
    return write_lines(folder / "uwb.csv", lines_of("# time," + ",".join(f"dist_{name}" for name in NAMES), rows))


def newest_first(folder: Path) -> Path:
    long_form(folder)
    for name in ("odometry.csv", "uwb.csv", "ground_truth.csv"):
        header, *rows = (folder / name).read_text(encoding="utf-8").splitlines()
        write_lines(folder / name, [header, *reversed(rows)])
    return folder


def parted(time_s: float) -> tuple[int, int]:
    """Seconds and nanoseconds."""
    nanoseconds = round(1e9 * time_s)
    return nanoseconds // 10**9, nanoseconds % 10**9


def as_messages(folder: Path) -> Path:
    long_form(folder)
    poses = [(*parted(t), 7.0, x, y, 0, 0, 0, np.sin(0.5 * h), np.cos(0.5 * h)) for t, x, y, h in POSES]
    position, turn = "pose.pose.position.", "pose.pose.orientation."
    fields = [*(position + axis for axis in "xyz"), *(turn + axis for axis in "xyzw")]
    head = ["header.stamp.sec", "header.stamp.nanosec", "twist.twist.linear.x", *fields]
    write_lines(folder / "odometry.csv", lines_of(",".join(head), poses))
    rows: list[tuple[object, ...]] = [(*parted(t), name, r) for t, name, r in RANGES]
    return write_lines(folder / "uwb.csv", lines_of("secs,nsecs,field.anchor_id,field.range", rows))


def with_places_beside_the_ranges(folder: Path) -> Path:
    long_form(folder)
    (folder / "anchors.csv").unlink()
    rows: list[tuple[object, ...]] = [(t, f"{name}.0", r, *BEACONS[name]) for t, name, r in RANGES]
    return write_lines(folder / "uwb.csv", lines_of("time,anchor,range,anchor_x,anchor_y", rows))


def as_graph(folder: Path) -> Path:
    run = read_run(write_lines(folder / "run.csv", csv_lines(W)), None, None)
    lines = pyfg_lines(run, load_recordings_config().csv, np.column_stack(run.truth[1:]) if run.truth else W.poses)
    (folder / "run.csv").unlink()
    return write_lines(folder / "graph.pyfg", lines)


@pytest.mark.parametrize(
    "make",
    [
        long_form, in_units, wide_form, with_decimal_commas, as_pandas_writes, as_evo_writes, as_graph, newest_first,
        as_messages, with_places_beside_the_ranges,
    ],
)  # fmt: skip
def test_the_same_run_comes_from_tables_and_from_a_graph(make: Callable[[Path], Path], tmp_path: Path) -> None:
    found = read_run(make(tmp_path), None, None)
    np.testing.assert_allclose(np.sort(found.readings.range_m), np.sort(W.range_m), atol=1e-7)
    np.testing.assert_allclose(found.readings.times_s, W.read_s, atol=1e-7)
    assert sorted(at for at in found.beacon_truth_m.values()) == sorted(BEACONS.values())
    assert found.steps.turn_rad.sum() == pytest.approx(
        np.interp(found.steps.times_s[-1], W.times_s, W.poses[:, 2]) - 0.4
    )
    assert found.first_pose == pytest.approx(W.poses[0], abs=1e-6)
    assert found.kind == "csv"


@pytest.mark.parametrize(
    ("header", "is_speed"),
    [
        ("time,distance,lateral,turn", False),
        ("time,distance [m],lateral [m],turn", False),
        ("time,distance,left,turn", False),
        ("time,distance_m,lateral_m,turn_rad", False),
        ("time,dist,sideways,dtheta", False),
        ("time,speed,lateral,rate", True),
        ("time,speed_m_s,lateral_m_s,turn_rate", True),
        ("time,vx,vy,wz", True),
        ("time,v,lateral_velocity,omega", True),
    ],
)
def test_motion_to_the_left_is_taken_whatever_its_column_is_named(header: str, is_speed: bool, tmp_path: Path) -> None:
    file = long_form(tmp_path)
    moves = np.column_stack([np.full(41, 0.2), np.linspace(-0.1, 0.1, 41), np.full(41, 0.05)])
    rows = [(0.5 * k, *(moves[k] / (0.5 if is_speed else 1.0)).tolist()) for k in range(41)]
    write_lines(tmp_path / "odometry.csv", lines_of(header, rows))
    run = read_run(file, None, None)
    np.testing.assert_allclose(run.steps.lateral_m, moves[:-1, 1] if is_speed else moves[1:, 1], atol=1e-9)
    assert not any("not understood" in line for line in run.warnings)


def test_columns_that_are_not_understood_are_named_once(tmp_path: Path) -> None:
    file = long_form(tmp_path)
    write_lines(tmp_path / "odometry.csv", lines_of("time,x,y,yaw,drift,slip", [(*row, 0, 0) for row in POSES]))
    write_lines(tmp_path / "ground_truth.csv", lines_of("time,x,y,yaw,north", [(*row, 0) for row in POSES]))
    rewritten(tmp_path, "time,anchor,range,,range_std,range_true", *(f"{t},{n},{r},,0.1,{r}" for t, n, r in RANGES))
    said = [line for line in read_run(file, None, None).warnings if "not understood" in line]
    assert said == [
        "uwb.csv: columns not understood, not used: range_std, range_true",
        "ground_truth.csv: column not understood, not used: north",
        "odometry.csv: columns not understood, not used: drift, slip",
    ]


def test_other_files_of_the_folder_are_not_read(tmp_path: Path) -> None:
    write_lines(tmp_path / "events.csv", csv_lines(W))
    write_lines(tmp_path / "notes.csv", ["time,note", "1,windy, and cold"])
    write_lines(tmp_path / "list.txt", ["id,owner", "6,Ann, Bob"])
    (tmp_path / "image.txt").write_bytes(bytes(range(256)))
    assert read_run(long_form(tmp_path), None, None).beacon_truth_m == BEACONS


def rewritten(folder: Path, *lines: str) -> Path:
    """The table of readings with other lines."""
    return write_lines(folder / "uwb.csv", [*lines])


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (lambda folder: (folder / "odometry.csv").unlink(), "has 0 tables of odometry and 1 of truth beside uwb.csv"),
        (lambda folder: write_lines(folder / "odometry.csv", ["time,x,y", "0,0,0"]), "x and y has no heading"),
        (lambda folder: write_lines(folder / "odometry.csv", ["time,x,y,yaw", "0,a,0,0"]), "csv:2: x is 'a'"),
        (lambda folder: write_lines(folder / "odometry.csv", ["time,x,y,yaw"]), "holds no rows below its header"),
        (lambda folder: rewritten(folder, "time,anchor,range"), "holds no rows below"),
        (lambda folder: rewritten(folder, "time,anchor,range,dist", "1,A,2,3"), "csv:1: several columns of a range"),
        (lambda folder: rewritten(folder, "time,id,range_raw", "1,A,2"), "has no column with a range"),
        (lambda folder: rewritten(folder, "time,id,range", "1,A,2,3"), "csv:2: 4 cells below a header of 3"),
        (lambda folder: rewritten(folder, "time,id,range", ",A,2"), "csv:2: the reading has no time"),
        (lambda folder: rewritten(folder, "time,id,range", "1,,2"), "csv:2: the reading has no name"),
        (lambda folder: rewritten(folder, "time,id,range", "noon,A,2"), "csv:2: time is 'noon', not a number"),
        (lambda folder: rewritten(folder, "time,id,range [ns]", "1,A,2"), "csv:1: column .*: 'ns' is no unit"),
        (lambda folder: write_lines(folder / "odometry.csv", ["time,dx,dtheta", "0,1,0"]), "a turn has no distance"),
        (lambda folder: write_lines(folder / "odometry.csv", ["t,dist,vy,turn", "0,1,0,0"]), "unit to the left"),
        (lambda folder: write_lines(folder / "odometry.csv", ["t,v,lateral_m,w", "0,1,0,0"]), "give a speed, too"),
        (lambda folder: write_lines(folder / "more.csv", ["time,x,y,yaw", "0,0,0,0"]), "has 2 tables of odometry"),
        (
            lambda folder: write_lines(folder / "old.csv", ["anchor,x,y", "6,9,9"]),
            r"has 2 tables of surveyed beacons beside uwb\.csv: anchors\.csv, old\.csv; leave one in the folder",
        ),
        (
            lambda folder: [write_lines(folder / f"{name}.csv", ["tag,forward,left", "1,0,0"]) for name in "ab"],
            r"has 2 tables of places of tags beside uwb\.csv: a\.csv, b\.csv; leave one in the folder",
        ),
    ],
)  # fmt: skip
def test_a_table_that_is_missing_or_wrong_is_one_line(
    change: Callable[[Path], object], what: str, tmp_path: Path
) -> None:
    file = long_form(tmp_path)
    change(tmp_path)
    with pytest.raises(RadioDataError, match=rf"{what}.*\(see docs/radio_data\.md\)$"):
        read_run(file, None, None)


def test_a_table_without_a_header_is_none_though_its_format_is_given(tmp_path: Path) -> None:
    file = write_lines(tmp_path / "uwb.csv", ["1,A,2", "2,A,3"])
    with pytest.raises(RadioDataError, match="has no header with a time and ranges"):
        read_run(file, "columns", None)


@pytest.mark.parametrize(
    ("lines", "what"),
    [
        (["VERTEX_SE2 0 A0 0 0 0"], "has no odometry: no EDGE_SE2"),
        (["VERTEX_SE3:QUAT 0 A0 0 0 0 0 0 0 1"], "'VERTEX_SE3:QUAT' is none of .* only graphs in the plane"),
        (["EDGE_SE2 0 A0 A1 1 0"], "pyfg:1: 5 words after EDGE_SE2, wanted 12"),
    ],
)
def test_a_graph_that_is_none_is_one_line(lines: list[str], what: str, tmp_path: Path) -> None:
    with pytest.raises(RadioDataError, match=what):
        read_run(write_lines(tmp_path / "a.pyfg", lines), None, None)


def test_a_graph_without_times_of_several_vehicles_with_loop_closures(tmp_path: Path) -> None:
    cov = "0.01 0 0 0.01 0 0.04"
    lines = ["VERTEX_XY L0 5 5"]
    lines += [f"EDGE_SE2 0.0 A{k} A{k + 1} 1 0 0.1 {cov}" for k in range(8)]
    lines += [f"EDGE_SE2 0.0 A0 A7 1 0 0.1 {cov}", f"EDGE_SE2 0.0 B0 B1 1 0 0.1 {cov}", "EDGE_RANGE 0.0 A1 B1 3 0.01"]
    lines += ["EDGE_RANGE 0.0 A2 L0 4 0.01", "EDGE_SE2_XY 0.0 A3 L0 3 4 0.01 0 0.01"]
    run = read_run(write_lines(tmp_path / "a.pyfg", lines), None, None)
    said = " | ".join(run.warnings)
    for what in ("of the vehicles A, B only A", "each step is taken as one second", "1 loop closure not used"):
        assert what in said
    assert "1 range between vehicles not used" in said
    assert run.readings.range_m.tolist() == [4.0, 5.0]
    assert run.readings.times_s.tolist() == [2.0, 3.0]


@pytest.mark.parametrize(("factor", "unit"), [(1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds")])
def test_times_since_1970_in_another_unit_are_recognised(factor: float, unit: str, tmp_path: Path) -> None:
    since_s = 1_714_557_600
    long_form(tmp_path)
    rows: list[tuple[object, ...]] = [(round((since_s + t) * 1e3) * round(factor / 1e3), n, r) for t, n, r in RANGES]
    write_lines(tmp_path / "uwb.csv", lines_of("timestamp,anchor,range", rows))
    poses = [(since_s + t, *pose) for t, *pose in POSES]
    write_lines(tmp_path / "odometry.csv", lines_of("time,x,y,yaw", poses))
    (tmp_path / "ground_truth.csv").unlink()
    run = read_run(tmp_path, None, None)
    assert f"uwb.csv: times of 1.715e+{8 + len(str(round(factor)))} are taken as {unit} since 1970" in run.warnings
    np.testing.assert_allclose(run.readings.times_s - since_s, W.read_s, atol=1e-3)


def two_tags(tmp_path: Path) -> Path:
    long_form(tmp_path)
    rows: list[tuple[object, ...]] = [(t, 1 + k % 3 // 2, n, r) for k, (t, n, r) in enumerate(RANGES)]
    return write_lines(tmp_path / "uwb.csv", lines_of("time,tag_id,anchor,range", rows))


TAGS = ["tag,forward,left,up", "1,0.4,0.1,0.3", "2,-0.4,-0.1,0.3"]


def test_all_tags_with_a_place_are_used_each_at_its_own(tmp_path: Path) -> None:
    file = two_tags(tmp_path)
    write_lines(tmp_path / "tags.csv", TAGS)
    run = read_run(file, None, None)
    assert run.tags == (Radio("1", 0.4, 0.1), Radio("2", -0.4, -0.1))
    assert run.readings.range_m.tolist() == [r for _, _, r in RANGES]
    assert run.readings.tag is not None
    assert run.readings.arm_m is not None
    assert run.readings.tag.tolist() == [k % 3 // 2 for k in range(len(RANGES))]
    assert run.readings.arm_m[:3].tolist() == [[0.4, 0.1], [0.4, 0.1], [-0.4, -0.1]]
    assert run.antenna_m == (0.0, 0.0)
    assert "not used" not in " | ".join(run.warnings)


def test_the_readings_of_one_tag_are_used_at_its_place(tmp_path: Path) -> None:
    file = two_tags(tmp_path)
    run = read_run(file, None, None)
    said = " | ".join(run.warnings)
    assert run.readings.range_m.tolist() == [r for k, (_, _, r) in enumerate(RANGES) if k % 3 < 2]
    assert run.readings.arm_m is None
    assert f"readings of tag 1 ({len(run.readings.times_s)}) are used, those of the tags 2 (" in said
    assert "the place of tag 1 is taken as zero: no place on the vehicle is given" in said
    write_lines(tmp_path / "tags.csv", TAGS)
    other = read_run(file, None, None, tag="2")
    assert other.readings.range_m.tolist() == [r for k, (_, _, r) in enumerate(RANGES) if k % 3 == 2]
    assert other.antenna_m == (-0.4, -0.1)
    assert other.tags == ()
    assert "is taken as" not in " | ".join(other.warnings)
    with pytest.raises(RadioDataError, match=r"has no reading of tag 3; there are 1 \(\d+\), 2 "):
        read_run(file, None, None, tag="3")


@pytest.mark.parametrize("place", ["2,,", "", "2,nan,nan"])
def test_a_tag_without_a_place_is_named_and_left_out(place: str, tmp_path: Path) -> None:
    file = two_tags(tmp_path)
    write_lines(tmp_path / "tags.csv", [*TAGS[:2], *([place] if place else [])])
    run = read_run(file, None, None)
    assert run.readings.range_m.tolist() == [r for k, (_, _, r) in enumerate(RANGES) if k % 3 < 2]
    assert run.antenna_m == (0.4, 0.1)
    assert "readings of the tags 2 (33) are not used: no place on the vehicle is given" in " | ".join(run.warnings)


def test_two_places_of_one_tag_and_too_many_tags_are_refused(tmp_path: Path) -> None:
    file = two_tags(tmp_path)
    write_lines(tmp_path / "tags.csv", [*TAGS, "1,0.5,0.1,0.3"])
    with pytest.raises(RadioDataError, match=r"tags\.csv:4: tag 1 has two places"):
        read_run(file, None, None)
    rows: list[tuple[object, ...]] = [(t, k, n, r) for k, (t, n, r) in enumerate(RANGES)]
    write_lines(file, lines_of("time,tag_id,anchor,range", rows))
    with pytest.raises(RadioDataError, match="are these the names of tags"):
        read_run(file, None, None)


def test_tags_in_a_csv_of_events(tmp_path: Path) -> None:
    lines = [f"{line},{'ab'[k // 2 % 2]}" if line.startswith("range") else line for k, line in enumerate(csv_lines(W))]
    lines = [line for line in lines if not line.startswith("bearing")]
    run = read_run(write_lines(tmp_path / "run.csv", [*lines, "tag,a,0.3,0.1", "tag,b,-0.3,0,0.2"]), None, None)
    assert set(run.tags) == {Radio("a", 0.3, 0.1), Radio("b", -0.3, 0.0)}
    assert len(run.readings.times_s) == W.read_s.size
    with pytest.raises(RadioDataError, match="tag has no name of a tag"):
        read_run(write_lines(tmp_path / "run.csv", [*lines, "tag,,0.3,0.1"]), None, None)


@pytest.mark.parametrize("is_surveyed", [True, False])
def test_ranges_of_both_ways_and_between_beacons(tmp_path: Path, is_surveyed: bool) -> None:
    """As of two-way ranging: either radio may begin, and the beacons range each other."""
    long_form(tmp_path)
    if not is_surveyed:
        (tmp_path / "anchors.csv").unlink()
    rows: list[tuple[object, ...]] = [
        (t, name, "10", r) if k % 3 == 0 else (t, "10", name, r) for k, (t, name, r) in enumerate(RANGES)
    ]
    rows += [(t + 0.01, "6", "8", 3.3) for t, *_ in RANGES[::2]]
    run = read_run(write_lines(tmp_path / "uwb.csv", lines_of("time,from_id,to_id,range", rows)), None, None)
    assert set(run.beacon_ids) == set(NAMES)
    assert run.readings.range_m.tolist() == [r for *_, r in RANGES]
    assert [run.beacon_ids[k] for k in run.readings.beacon.tolist()] == [name for _, name, _ in RANGES]
    assert run.beacon_truth_m == (BEACONS if is_surveyed else {})
    turned, left_out = len(RANGES[::3]), len(RANGES[::2])
    what = (
        f"10 is taken to be on the vehicle; {turned} readings have it as the beacon and were turned round, {left_out}"
    )
    assert what in " | ".join(run.warnings)


def test_two_radios_with_places_and_ranges_of_both_ways(tmp_path: Path) -> None:
    long_form(tmp_path)
    write_lines(tmp_path / "tags.csv", TAGS)
    rows: list[tuple[object, ...]] = [
        (t, name, "12"[k % 2], r) if k % 3 == 0 else (t, "12"[k % 2], name, r) for k, (t, name, r) in enumerate(RANGES)
    ]
    rows.append((RANGES[5][0], "1", "2", 0.8))
    run = read_run(write_lines(tmp_path / "uwb.csv", lines_of("time,from_id,to_id,range", rows)), None, None)
    assert run.tags == (Radio("1", 0.4, 0.1), Radio("2", -0.4, -0.1))
    assert len(run.readings.times_s) == len(RANGES)
    assert run.readings.tag is not None
    assert run.readings.tag.tolist() == [k % 2 for k in range(len(RANGES))]


def test_tags_and_beacons_that_are_numbered_alike_stay_what_they_are(tmp_path: Path) -> None:
    long_form(tmp_path)
    rows: list[tuple[object, ...]] = [(t, "6", name, r) for t, name, r in RANGES]
    run = read_run(write_lines(tmp_path / "uwb.csv", lines_of("time,tag_id,anchor,range", rows)), None, None)
    assert [run.beacon_ids[k] for k in run.readings.beacon.tolist()] == [name for _, name, _ in RANGES]
    assert run.warnings == read_run(long_form(tmp_path), None, None).warnings


def test_a_path_beside_the_readings_is_named(tmp_path: Path) -> None:
    long_form(tmp_path)
    rows: list[tuple[object, ...]] = [(*row, 1.0, 2.0) for row in RANGES]
    run = read_run(write_lines(tmp_path / "uwb.csv", lines_of("time,anchor,range,x,y", rows)), None, None)
    assert any(line.startswith("uwb.csv: a path beside the readings is not used: x, y") for line in run.warnings)
    write_lines(tmp_path / "uwb.csv", lines_of("time,peer,range,x,y", rows))
    with pytest.raises(RadioDataError, match=r"\(time, peer, range, x, y\) has no column with the name of a beacon"):
        read_run(tmp_path, None, None)


def test_tags_and_beacons_that_are_exchanged_are_named(tmp_path: Path) -> None:
    long_form(tmp_path)
    rows: list[tuple[object, ...]] = [(t, name, "vehicle", r) for t, name, r in RANGES]
    run = read_run(write_lines(tmp_path / "uwb.csv", lines_of("time,src,id,range", rows)), None, None)
    assert any("several tags and one beacon: are these two columns exchanged?" in line for line in run.warnings)


@pytest.mark.parametrize(
    ("name", "lines", "what"),
    [
        ("uwb.csv", ["time,anchor,range", "1,A,2"], "has no column of tags, so none of tag 2"),
        ("run.csv", ["odom,0,0,0", "range,0,A,1"], "has no column of tags, so none of tag 2"),
    ],
)
def test_a_tag_that_no_column_names_is_refused(name: str, lines: list[str], what: str, tmp_path: Path) -> None:
    long_form(tmp_path)
    with pytest.raises(RadioDataError, match=what):
        read_run(write_lines(tmp_path / name, lines), None, None, tag="2")


@pytest.mark.parametrize(
    ("header", "what"),
    [
        (
            "Zeit,Anker,Distanz",
            r"its header \(Zeit, Anker, Distanz\) has no column with a time or the name of a beacon",
        ),
        ("time,A1,A2,A3", "has no column with the name of a beacon or a range, bearing or rssi"),
    ],
)
def test_a_header_that_is_not_understood_is_reported(header: str, what: str, tmp_path: Path) -> None:
    long_form(tmp_path)
    rewritten(tmp_path, header, *(["1,2,3,4"[: len(header.split(",")) * 2 - 1]] * 5))
    with pytest.raises(RadioDataError, match=what):
        read_run(tmp_path, None, None)


def test_beacons_that_are_heard_once_each_are_no_beacons(tmp_path: Path) -> None:
    long_form(tmp_path)
    rows: list[tuple[object, ...]] = [(t, k, r) for k, (t, _, r) in enumerate(RANGES)]
    file = write_lines(tmp_path / "uwb.csv", lines_of("time,id,range", rows))
    with pytest.raises(RadioDataError, match=r"the only one of their beacon \(0, 1, 2, 3 and .*a number of the row"):
        read_run(file, None, None)


def test_a_heading_that_turns_against_the_course_is_named(tmp_path: Path) -> None:
    long_form(tmp_path)
    write_lines(tmp_path / "odometry.csv", lines_of("time,x,y,yaw", [(t, x, y, 1.57 - h) for t, x, y, h in POSES]))
    run = read_run(tmp_path, None, None)
    assert any("turns against the course of its positions: is it clockwise" in line for line in run.warnings)
    assert not any("clockwise" in line for line in read_run(long_form(tmp_path), None, None).warnings)


def test_a_beacon_with_several_places_beside_its_ranges_is_named(tmp_path: Path) -> None:
    long_form(tmp_path)
    (tmp_path / "anchors.csv").unlink()
    rows: list[tuple[object, ...]] = [
        (t, n, r, BEACONS[n][0] + (t if n == "7" else 0), BEACONS[n][1]) for t, n, r in RANGES
    ]
    file = write_lines(tmp_path / "uwb.csv", lines_of("time,anchor,range,anchor_x,anchor_y", rows))
    run = read_run(file, None, None)
    assert "beacons with several places beside their readings: 7; do they move?" in " | ".join(run.warnings)
    assert run.beacon_truth_m == {name: at for name, at in BEACONS.items() if name != "7"}
