"""The golden comparison itself: every change of a decision is found, and what is only renamed is not a change."""

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from mcap.writer import Writer

from tools.golden.comparison import Observation, Renames, compare, observe
from tools.golden.runs import CASES, HERE

SENSORS = '>{"type":"sensors","seq":%d,"t":%s,"fans":[0.8,0.8]}'
WIRE = [
    '>{"type":"hello","protocol":"ccatp-robot/1","boot":7,"nonce":"00"}',
    '<{"type":"join","role":"controller","client":"main"}',
    SENSORS % (0, "0.0"),
    '<{"type":"fans","seq":1,"duty":[0.8,0.8]}',
    '<{"type":"permit","seq":1,"ack":0,"forward":true,"reverse":true,"turn":true}',
    '<{"type":"drive","seq":1,"ack":0,"wr":0.1,"wl":0.1}',
    SENSORS % (1, "0.01"),
    '<{"type":"permit","seq":2,"ack":1,"forward":true,"reverse":true,"turn":true}',
    '<{"type":"drive","seq":2,"ack":1,"wr":0.30000000000000004,"wl":0}',
]
STATE = {"process": "main", "event": "state", "wall": "now", "seq": 1, "before": "idle", "after": "driving"}
TRACK: list[list[float]] = [[0, 0.0, 1.5], [1, 0.01, 1.25]]


def left_behind(
    folder: Path, *, wire: list[str] = WIRE, state: dict[str, Any] = STATE, topic: str = "track", batch: int = 2
) -> Observation:
    """What is read of a small case."""
    run = folder / "run"
    run.mkdir(parents=True)
    (folder / "exit.0").write_text("0")
    (folder / "out.0").write_text('{"places": {"a": [1.0, null]}, "warnings": ["far off"]}')
    (folder / "wire.0").write_text("\n".join(wire) + "\n")
    (folder / "bus.0").write_text(
        'verdict {"code":0,"value":0.1,"seq":1,"t_s":0.01}\ntiming {"tick_us":[1.5],"seq":1}\n'
    )
    (run / "summary.json").write_text('{"points": {"total": 9}, "wall": {"time_s": 3.0}}')
    (run / "log.jsonl").write_text(json.dumps(state) + "\n" + '{"event": "run", "wall": "now"}\n')
    with (run / "telemetry.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel(topic, "json", 0)
        for k in range(0, len(TRACK), batch):
            writer.add_message(channel, 0, json.dumps({"seq": k, "rows": TRACK[k : k + batch]}).encode(), 0)
        writer.finish()  # type: ignore[no-untyped-call]
    return observe(folder, only_results=False)


@pytest.fixture
def base(tmp_path: Path) -> Observation:
    return left_behind(tmp_path / "base")


def changed(observation: Observation, stream: str, row: int, field: str, value: object) -> Observation:
    new = copy.deepcopy(observation)
    assert field in new[stream][row][1]
    new[stream][row][1][field] = value
    return new


def test_a_case_is_equal_to_itself_however_its_rows_are_batched(base: Observation, tmp_path: Path) -> None:
    assert {"exit", "json", "summary", "frames", "track", "event:state"} <= base.keys()
    assert compare(base, left_behind(tmp_path / "new", batch=1), Renames()) == []


@pytest.mark.parametrize(
    ("stream", "row", "field", "value", "at"),
    [
        ("frames", 1, "drive.wr", 0.3, "frame 1"),  # the last bit
        ("frames", 1, "drive.wl", -0.0, "frame 1"),
        ("frames", 0, "permit.turn", False, "frame 0"),
        ("frames", 0, "permit.turn", 1, "frame 0"),
        ("frames", 0, "fans.duty", "[0.8, 0.9]", "frame 0"),
        ("frames", 1, "sensors.t", 0.02, "frame 1"),
        ("event:state", 0, "after", "held", "frame 1"),
        ("bus:verdict", 0, "value", 0.10000000000000002, "frame 1"),
        ("track", 1, "2", 1.2500000000000002, "frame 1"),
        ("summary", 0, "points.total", 8.0, "frame 0"),
        ("json", 0, "0.places.a.1", 0.0, "step 0"),
        ("exit", 0, "status", 3, "step 0"),
    ],
)
def test_each_change_is_found(base: Observation, stream: str, row: int, field: str, value: object, at: str) -> None:
    found = compare(base, changed(base, stream, row, field, value), Renames())
    assert [(one.stream, one.key, one.rows) for one in found] == [(stream, at, 1)]
    assert [(name, new) for name, _, new in found[0].fields] == [(field, value)]
    assert f"{stream}: 1 of {len(base[stream])} rows differ; first at {at}" in str(found[0])
    assert f"{field}: base " in str(found[0])


def test_the_first_of_several_differences_is_shown(base: Observation) -> None:
    new = changed(changed(base, "frames", 0, "drive.wr", 0.2), "frames", 1, "drive.wr", 0.2)
    assert [(one.key, one.rows) for one in compare(base, new, Renames())] == [("frame 0", 2)]


@pytest.mark.parametrize(
    "change",
    [
        lambda new: new["frames"].pop(),
        lambda new: new["frames"][0][1].pop("drive.wr"),
        lambda new: new["frames"][0][1].update({"drive.steer": 0.1}),
        lambda new: new.pop("track"),
        lambda new: new["event:state"].append(((2,), {"before": "driving", "after": "done"})),
    ],
)
def test_what_is_missing_or_too_much_is_found(base: Observation, change: Callable[[Observation], object]) -> None:
    new = copy.deepcopy(base)
    change(new)
    assert len(compare(base, new, Renames())) == 1
    assert len(compare(new, base, Renames())) == 1


def test_frames_after_a_reboot_are_others(base: Observation, tmp_path: Path) -> None:
    again = [line.replace('"boot":7', '"boot":8') for line in WIRE]
    frames = left_behind(tmp_path / "new", wire=[*WIRE, *again])["frames"]
    assert [key for key, _ in frames] == [(0, 1, 0), (0, 1, 1), (0, 2, 0), (0, 2, 1)]
    assert frames[:2] == base["frames"]


def test_a_rename_in_the_table_is_no_difference(base: Observation, tmp_path: Path) -> None:
    state = {"logger": "main", "event": "state_changed", "timestamp": "now", "seq": 1}
    state |= {"from": "idle", "after": "moving"}
    new = left_behind(tmp_path / "new", state=state, topic="pose_track")
    assert {one.stream for one in compare(base, new, Renames())} == {"event:state", "track"}
    renames = Renames(
        streams={"track": "pose_track", "event:state": "event:state_changed"},
        fields={"event:state.before": "from"},
        texts={"^driving$": "moving"},
    )
    assert compare(base, new, renames) == []
    assert compare(base, changed(new, "pose_track", 0, "2", 1.0), renames)[0].stream == "pose_track"


def test_wordings_and_ignored_fields(base: Observation) -> None:
    new = changed(base, "json", 0, "0.warnings.0", "far away")
    new = changed(new, "summary", 0, "wall.time_s", 4.0)
    assert len(compare(base, new, Renames())) == 2
    lenient = Renames(wording=("json.*.warnings*",), ignored=("summary.wall.*",))
    assert compare(base, new, lenient) == []
    assert len(compare(base, changed(new, "json", 0, "0.warnings.0", ""), lenient)) == 1


def test_command_lines_are_renamed() -> None:
    renames = Renames(options={"--held": "--start-held", "log": "recording"}, settings={"sim.robot.port": "sim.port"})
    given = ["log", "--held", "--set", "sim.robot.port=0", "--set", "run.seed=1"]
    assert renames.arguments(given) == ["recording", "--start-held", "--set", "sim.port=0", "--set", "run.seed=1"]


def test_the_table_and_the_cases_can_be_read() -> None:
    assert Renames.read(HERE / "renames.toml").base
    names = [case.name for case in CASES]
    assert len(set(names)) == len(names)
