"""ROS bags as recordings: the same run by bag and by CSV; antennas off the origin, beacons at a height."""

from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import pytest

from ccatp.beacons.config.load import load_recordings_config
from ccatp.beacons.datasets.reader import read_run
from ccatp.beacons.datasets.tables import RadioDataError
from ccatp.beacons.estimation.causal import filter_run
from ccatp.beacons.estimation.evaluation import judge
from ccatp.beacons.estimation.recording import Radio
from tests.unit.beacons.datasets.sets import BEACONS, World, csv_lines, world, write_lines

rosbags = pytest.importorskip("rosbags", reason="the extra ros is not installed")

TOPICS = """
[odometry]
topic = "/odom"

[[readings]]
topic = "/uwb"
beacon = "header.frame_id"
range = "range"

[truth]
topic = "/truth"

[beacons]
6 = [0.5, 4.0]
"""


def write_bag(path: Path, w: World, tags: int = 1, unit_m: float = 1.0) -> Path:
    """Odometry and truth as nav_msgs/Odometry, ranges as sensor_msgs/Range, places of beacons as PoseStamped.

    The tag of a range is in ``radiation_type``; the tags alternate: the first has the readings 0, ``tags``, ...
    """
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    types = get_typestore(Stores.ROS1_NOETIC if path.suffix == ".bag" else Stores.ROS2_JAZZY)
    kinds = types.types

    def header(time_s: float, frame: str) -> Any:
        stamp = kinds["builtin_interfaces/msg/Time"](*divmod(round(time_s * 1e9), 10**9))
        return kinds["std_msgs/msg/Header"](*([0] if path.suffix == ".bag" else []), stamp=stamp, frame_id=frame)

    def odometry(time_s: float, pose: Any) -> Any:
        x, y, heading = pose
        vector, zeros = kinds["geometry_msgs/msg/Vector3"], np.zeros(36)
        turn = kinds["geometry_msgs/msg/Quaternion"](0.0, 0.0, np.sin(heading / 2.0), np.cos(heading / 2.0))
        place = kinds["geometry_msgs/msg/Pose"](kinds["geometry_msgs/msg/Point"](x, y, 0.0), turn)
        still = kinds["geometry_msgs/msg/Twist"](vector(0.0, 0.0, 0.0), vector(0.0, 0.0, 0.0))
        return kinds["nav_msgs/msg/Odometry"](
            header(time_s, "odom"), "base_link",
            kinds["geometry_msgs/msg/PoseWithCovariance"](place, zeros),
            kinds["geometry_msgs/msg/TwistWithCovariance"](still, zeros),
        )  # fmt: skip

    rows = [
        (t, topic, odometry(t, pose))
        for topic in ("/odom", "/truth")
        for t, pose in zip(w.times_s, w.poses, strict=True)
    ]
    names = list(BEACONS)
    fields: tuple[Any, ...] = () if path.suffix == ".bag" else (0.0,)  # ROS 2 has a variance, too
    for k, (t, beacon, range_m) in enumerate(zip(w.read_s, w.read_beacon, w.range_m, strict=True)):
        values = header(t, names[beacon]), k % tags, 0.1, 0.0, 50.0, range_m / unit_m, *fields
        message = kinds["sensor_msgs/msg/Range"](*values)
        rows.append((t, "/uwb", message))
    for name, (x, y) in BEACONS.items():
        place = kinds["geometry_msgs/msg/Point"](x, y, 0.0)
        turn = kinds["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
        stamped = kinds["geometry_msgs/msg/PoseStamped"](
            header(0.5, name), kinds["geometry_msgs/msg/Pose"](place, turn)
        )
        rows.append((0.5, "/anchors", stamped))
    plugin = {".db3": StoragePlugin.SQLITE3, ".mcap": StoragePlugin.MCAP}.get(path.suffix)
    folder = path.with_suffix("") if plugin else path
    with Writer1(path) if plugin is None else Writer(folder, version=9, storage_plugin=plugin) as writer:
        at: dict[str, Any] = {}
        for t, topic, message in sorted(rows, key=lambda row: row[0]):
            kind = message.__msgtype__
            at.setdefault(topic, None)
            at[topic] = at[topic] or writer.add_connection(topic, kind, typestore=types)
            raw = types.serialize_ros1(message, kind) if plugin is None else types.serialize_cdr(message, kind)
            writer.write(at[topic], round(t * 1e9), raw)
    return path if plugin is None else next(folder.glob(f"*{path.suffix}"))


@pytest.mark.parametrize("suffix", [".bag", ".db3", ".mcap"])
def test_a_bag_is_the_run_that_its_csv_is(suffix: str, tmp_path: Path) -> None:
    w = world(seconds=20.0)
    topics = tmp_path / "topics.toml"
    topics.write_text(TOPICS)
    found = read_run(write_bag(tmp_path / f"run{suffix}", w), None, None, topics)
    wanted = read_run(write_lines(tmp_path / "run.csv", csv_lines(w)), None, None)
    assert found.beacon_truth_m == {"6": BEACONS["6"]}
    assert set(found.beacon_ids) == set(BEACONS)
    np.testing.assert_allclose(found.steps.distance_m, wanted.steps.distance_m, atol=1e-5)
    np.testing.assert_allclose(found.steps.turn_rad, wanted.steps.turn_rad, atol=1e-5)
    np.testing.assert_allclose(found.first_pose, w.poses[0], atol=1e-5)
    np.testing.assert_allclose(np.sort(found.readings.range_m), np.sort(w.range_m), atol=1e-5)  # single precision


@pytest.mark.parametrize(
    ("topics", "what"),
    [
        ("", "odometry: field required"),
        ("[odometry", "is no TOML"),
        (TOPICS.replace("/uwb", "/nothing"), "has no topic /nothing; there are /anchors, /odom, /truth, /uwb"),
        (TOPICS.replace('"range"', '"distance"'), "message 5 of /uwb"),
    ],
)
def test_topics_that_are_not_there(topics: str, what: str, tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "run.mcap", world(seconds=5.0))
    file = tmp_path / "topics.toml"
    file.write_text(topics)
    with pytest.raises(RadioDataError, match=what):
        read_run(bag, None, None, file)
    with pytest.raises(RadioDataError, match="names its topics with --topics"):
        read_run(bag, None, None)


MORE = """
[markers]
topic = "/anchors"
each = ""
name = "header.frame_id"
"""


@pytest.mark.parametrize("use", ["", 'use_tag = "1"'])
def test_tags_in_millimetres_and_beacons_from_markers(use: str, tmp_path: Path) -> None:
    w = world(seconds=20.0)
    topics = tmp_path / "topics.toml"
    tags = 'tag = "radiation_type"\nunit = "mm"'
    arms = "\n[tags]\n0 = [0.3, 0.0]\n1 = [0.0, 0.2]\n"
    topics.write_text(use + TOPICS.replace('range = "range"', f'range = "range"\n{tags}') + MORE + arms)
    found = read_run(write_bag(tmp_path / "run.mcap", w, tags=2, unit_m=1e-3), None, None, topics)
    expected_m = w.range_m[1::2] if use else w.range_m
    np.testing.assert_allclose(np.sort(found.readings.range_m), np.sort(expected_m), atol=1e-5)
    assert found.antenna_m == ((0.0, 0.2) if use else (0.0, 0.0))
    assert found.tags == (() if use else (Radio("0", 0.3, 0.0), Radio("1", 0.0, 0.2)))
    assert dict(found.beacon_truth_m) == BEACONS
    assert ("readings of tag 1" in " | ".join(found.warnings)) == bool(use)
    topics.write_text('use_tag = "7"' + topics.read_text().removeprefix(use))
    with pytest.raises(RadioDataError, match="has no reading of tag 7; there are 0 "):
        read_run(tmp_path / "run" / "run.mcap", None, None, topics)


def test_a_bag_without_its_index_is_read(tmp_path: Path) -> None:
    w = world(seconds=20.0)
    (topics := tmp_path / "topics.toml").write_text(TOPICS)
    whole = write_bag(tmp_path / "run.mcap", w)
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole.read_bytes()[:-1000])  # of its summary
    found = read_run(cut, None, None, topics)
    assert "the bag has no index" in " | ".join(found.warnings)
    assert found.steps.times_s[-1] == pytest.approx(20.0)
    np.testing.assert_allclose(found.first_pose, w.poses[0], atol=1e-5)


ANTENNA_M, ABOVE_M = (0.8, -0.5), 2.0


def test_an_antenna_off_the_origin_and_beacons_at_a_height(tmp_path: Path) -> None:
    """Ranges of the antenna to beacons 2 m above it: with both in the file, errors are those of ranges in the plane."""
    w = world(seconds=60.0)
    c, s = np.cos(w.poses[:, 2]), np.sin(w.poses[:, 2])
    ahead, left = ANTENNA_M
    antenna = w.poses[:, :2] + np.column_stack([c * ahead - s * left, s * ahead + c * left])
    at = np.column_stack([np.interp(w.read_s, w.times_s, column) for column in antenna.T])
    places = np.array(list(BEACONS.values()))[w.read_beacon]
    noise = np.random.default_rng(2).normal(0.0, 0.05, len(at))
    w = replace(w, range_m=np.hypot(np.hypot(*(places - at).T), ABOVE_M) + noise)
    lines = [line for line in csv_lines(w) if not line.startswith("bearing")]
    reported = [f"{line},{ABOVE_M + 0.3}" if line.startswith("beacon") else line for line in lines]
    cfg, errors_m = load_recordings_config(), []
    for name, text in (("reported", [*reported, f"antenna,{ahead},{left},0.3"]), ("untold", lines)):
        run = read_run(write_lines(tmp_path / f"{name}.csv", text), None, None)
        errors_m.append(judge(filter_run(run, cfg.csv, cfg.filter, perf_counter), run).beacon_rmse_m or np.inf)
    assert errors_m[0] < 0.1  # two sigmas of a range
    assert errors_m[1] > 3.0 * errors_m[0]


@pytest.mark.parametrize("suffix", [".bag", ".db3", ".mcap"])
def test_a_damaged_bag_is_refused_or_read(suffix: str, tmp_path: Path) -> None:
    whole, topics = write_bag(tmp_path / f"run{suffix}", world(seconds=3.0)), tmp_path / "topics.toml"
    rng = np.random.default_rng(1)
    topics.write_text(TOPICS)
    refused = []
    for number in range(20):
        data = bytearray(whole.read_bytes())
        data = data[: int(rng.integers(len(data)))] if number % 4 == 0 else data
        for place in rng.integers(len(data), size=30).tolist():
            data[place] = int(rng.integers(256))
        bad = tmp_path / f"bad{number}{suffix}"
        bad.write_bytes(bytes(data))
        try:
            read_run(bad, None, None, topics)
        except RadioDataError as error:
            refused.append(str(error))
    assert len(refused) >= 5
    assert not any("\n" in line for line in refused)
