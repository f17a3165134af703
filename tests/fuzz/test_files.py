"""Files that are read back, as targets of the fuzzer: configuration, mission database, recording of a run."""

import json
import os
import random
import tempfile
import tomllib
from collections.abc import Callable, Hashable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import msgspec
import pytest
import tomlkit

from ccatp.config.files import read_toml
from ccatp.config.load import dump_config, load_config
from ccatp.core import DeckPose, Fix, PointId
from ccatp.errors import ConfigError
from ccatp.links.topics import FixMessage, Rest, SensorLines, TrackMessage, all_topics, schema_of
from ccatp.records.recorder import Recorder, iter_messages
from ccatp.records.run_reader import RunReadError, open_recordings
from ccatp.records.store import MissionStore, StoredPoint, StoreError
from tests.contract.test_robot_wire import SENSORS_LINE
from tests.fuzz.fuzzer import Target, fuzz

USER_FILE = b"""[run]
mirror = "fyst-m1"
seed = 3
panels = 2

[robot]
wheel_radius_m = 0.03
edge_sensors_m = [[0.09, 0.09], [0.09, -0.09], [-0.09, 0.09], [-0.09, -0.09]]
fan_duty = [0.8, 0.8]

[limits]
v_max_m_s = 0.10

[danger]
map_margin_m = 0.010
debounce_samples = 2

[mission]
fix_at_start = true
backoff_m = 0.06
"""
PANEL = [PointId(1, 2, n) for n in range(1, 10)]


@contextmanager
def scratch() -> Iterator[Path]:
    """A folder in memory where there is one: a million files would wear a disk."""
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(prefix="ccatp-fuzz-", dir=memory if memory.is_dir() else None) as folder:
        yield Path(folder)


# -- configuration ----------------------------------------------------------------------------------------------------


def config_target(folder: Path) -> Target:
    """A user's file: it is refused with file and line, or each of its values is in force as it stands there."""
    file = folder / "user.toml"

    def run(data: bytes) -> Hashable:
        file.write_bytes(data)
        try:
            cfg = load_config(file)
        except ConfigError as error:
            for problem in error.problems:
                assert problem.startswith(f"{file}"), problem
                assert "\n" not in problem, problem
            raise
        assert_in_force(tomllib.loads(read_toml(file)), cfg.model_dump(), "")
        return cfg.run.panels == 0

    return Target("configuration", [USER_FILE, b"", b"[run]\nseed = 1\n"], run, (ConfigError,))


def assert_in_force(said: Any, got: Any, where: str) -> None:
    """Nothing that was said was left out or taken for something else."""
    if isinstance(said, Mapping):
        for key, value in said.items():
            assert_in_force(value, got[key], f"{where}.{key}")
    elif isinstance(said, list):
        assert len(said) == len(got), where
        for one, other in zip(said, got, strict=True):
            assert_in_force(one, other, where)
    else:
        assert said == got, where
        assert isinstance(said, bool) == isinstance(got, bool), where


@cache
def dumped_config() -> dict[str, Any]:
    """The whole default configuration as a tree."""
    return tomllib.loads(dump_config(load_config()))


# -- mission database -------------------------------------------------------------------------------------------------


def a_fix(t_s: float = 1.5) -> Fix:
    return Fix(t_s, (1.0, 2.0 + t_s, 3.0), tuple(i * 1e-12 for i in range(9)), 1.7, (1, 2, 5, 8), 2e-6)


def sound_store(folder: Path) -> bytes:
    """A database with six points measured, one skipped, two planned."""
    path = folder / "sound.sqlite"
    plan = [StoredPoint(p, 0.22, -0.25) for p in PANEL]
    with MissionStore.create(path, mirror="fyst-m1", seed=1, config_toml="[run]\n", points=plan, reserve_bytes=0) as db:
        for k, point in enumerate(PANEL[:6]):
            db.record_fix(point, a_fix(float(k)), DeckPose(0.1, 0.2, 0.3)).result()
        db.record_skipped(PANEL[6], 9.0).result()
    return path.read_bytes()


def check_store(path: Path) -> int:
    """Open what is at ``path``: what is measured there is what was measured, and what is damaged is said to be."""
    with MissionStore.open(path, mirror="fyst-m1") as db:
        damaged, measured = db.damaged, {p.point for p in db.points() if p.status == "measured"}
        fixes = {f.point: f.fix for f in db.fixes()}
    assert measured | set(damaged) == set(PANEL[:6])
    assert fixes == {p: a_fix(float(k)) for k, p in enumerate(PANEL[:6]) if p in measured}
    return len(damaged)


def store_target(folder: Path) -> Target:
    """A database: refused as a whole, or all of its fixes are right or named as damaged."""
    sound = sound_store(folder)
    path = folder / "mission.sqlite"

    def run(data: bytes) -> Hashable:
        path.with_name("mission.sqlite-journal").unlink(missing_ok=True)
        path.write_bytes(data)
        return check_store(path)

    return Target("mission database", [sound], run, (StoreError,))


# -- recording --------------------------------------------------------------------------------------------------------


def sound_recording(folder: Path) -> bytes:
    """A short recording of a run."""
    path = folder / "sound.mcap"
    topics = [(topic.name, schema_of(topic.name)) for topic in all_topics() if topic.recorded]
    config = dump_config(load_config(None, {"run.panels": 1}))
    recorder = Recorder(path, topics, is_simulation=True, metadata={"format": "1", "config": config})
    fix = FixMessage(
        seq=12,
        t_s=0.12,
        point=(1, 1, 1),
        is_fused=True,
        position_m=(1.0, 2.0, 3.0),
        covariance_m2=[1e-12, 0.0, 0.0, 0.0, 1e-12, 0.0, 0.0, 0.0, 1e-12],
        dop=1.0,
        residual_rms_m=1e-6,
        channels=[1, 2, 3, 4],
        jump_mm=0.1,
    )
    lines = [json.loads(SENSORS_LINE) | {"seq": k, "t": 0.01 * k} for k in range(3)]
    raw = [json.dumps(line).encode() for line in lines]
    messages = {
        "sensors": SensorLines(seq=12, t_s=0.12, lines=[msgspec.Raw(line) for line in raw]),
        "rest": Rest(seq=12, t_s=0.12),
        "fix": fix,
        "track": TrackMessage(seq=12, t_s=0.12, rows=[(12, 0.12, 1, 1, 0.0, 0.0, 0.0, 0.001)]),
    }
    for name, message in messages.items():
        recorder.write(name, 0.12, msgspec.json.encode(message))
    recorder.close()
    return path.read_bytes()


def recording_target(folder: Path) -> Target:
    """A recording: what can be read of it is read, and no more is promised."""
    sound = sound_recording(folder)
    (folder / "run").mkdir()
    (folder / "run" / "config.toml").write_text(dump_config(load_config()))
    path = folder / "run" / "telemetry.mcap"

    def run(data: bytes) -> Hashable:
        path.write_bytes(data)
        damages: list[str] = []
        topics = tuple(message.topic for message in iter_messages(path, damages.append))
        for recording in open_recordings(folder / "run"):
            count = sum(1 for _ in recording.messages())
            return topics, len(damages), min(count, 8), len(recording.warnings)
        raise AssertionError("no recording")

    return Target("recording", [sound], run, (RunReadError,))


MANY = int(os.environ.get("CCATP_FUZZ_INPUTS", "1000000")) // 10
SEED = int(os.environ.get("CCATP_FUZZ_SEED", "1"))
MAKERS = [
    pytest.param(config_target, 150, id="configuration"),
    pytest.param(store_target, 400, id="mission database"),
    pytest.param(recording_target, 300, id="recording"),
]


@pytest.fixture
def folder() -> Iterator[Path]:
    with scratch() as path:
        yield path


@pytest.mark.parametrize("is_many", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize(("make", "few"), MAKERS)
def test_damaged_files(make: Callable[[Path], Target], few: int, is_many: bool, folder: Path) -> None:
    report = fuzz(make(folder), max(MANY, few) if is_many else few, SEED if is_many else 0)
    print(report.line)
    assert not report.failures, "\n".join(report.failures)[:4000]
    assert len(report.outcomes) >= 3


# -- P20: every key of the configuration, wrong in every way that can be told -----------------------------------------


Key = tuple[str, ...]
# What looks wrong and means the same: Python's True is 1.
EQUIVALENT = ((("mirror", "frame", "reflecting_side_sign"), "reflecting_side_sign", True),)


def leaves(tree: object, key: Key = ()) -> Iterator[tuple[Key, object]]:
    if isinstance(tree, dict):
        for name, value in tree.items():
            yield from leaves(value, (*key, name))
    else:
        yield key, tree


def with_leaf(tree: object, key: Key, name: str, value: object) -> dict[str, object]:
    """A copy in which a leaf has another name and value."""
    assert isinstance(tree, dict)
    if len(key) == 1:
        return {name if k == key[0] else k: value if k == key[0] else v for k, v in tree.items()}
    return {k: with_leaf(v, key[1:], name, value) if k == key[0] else v for k, v in tree.items()}


def wrong(key: Key, value: object) -> list[tuple[str, object]]:
    """Names and values that no leaf may have."""
    found: list[tuple[str, object]] = [(key[-1] + "x", value)]
    if isinstance(value, bool):
        found += [(key[-1], 1), (key[-1], "true")]
    elif isinstance(value, int | float):
        found += [
            (key[-1], bad) for bad in (float("nan"), float("inf"), -float("inf"), str(value), True, [value], 1e300)
        ]
    elif isinstance(value, str):
        found += [(key[-1], bad) for bad in (1, 0.5, True, [value])]
    else:
        found += [(key[-1], bad) for bad in ("x", 1, [["x"]])]
    return [
        one for one in found if (key, *one) not in EQUIVALENT and not (key[-2] == "adjusters_mm" and one[1] == value)
    ]


def mistakes() -> list[tuple[Key, str, object]]:
    return [(key, name, bad) for key, value in leaves(dumped_config()) for name, bad in wrong(key, value)]


def refused(folder: Path, key: Key, name: str, bad: object) -> str:
    """What the loader says to a mistake; empty where it takes it."""
    file = folder / "user.toml"
    file.write_text(tomlkit.dumps(with_leaf(dumped_config(), key, name, bad)))
    try:
        load_config(file)
    except ConfigError as error:
        found = error.problems
    else:
        return ""
    assert all(problem.startswith(f"{file}:") for problem in found), found
    return found[0]


@pytest.mark.fault("P20")
@pytest.mark.parametrize("count", [40, pytest.param(None, marks=pytest.mark.slow)])
def test_mistakes_in_the_configuration(count: int | None, folder: Path, measured: Callable[[str, float], None]) -> None:
    chosen = mistakes()
    assert len(chosen) > 1000
    chosen = chosen if count is None else random.Random(20).sample(chosen, count)
    taken = [mistake for mistake in chosen if not refused(folder, *mistake)]
    measured("P20", 100.0 * (1.0 - len(taken) / len(chosen)))
    assert not taken


# -- P16: the whole database, bit by bit ------------------------------------------------------------------------------


@pytest.mark.fault("P16")
@pytest.mark.parametrize("is_every", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_cuts_and_flipped_bits_of_the_database(
    is_every: bool, folder: Path, measured: Callable[[str, float], None]
) -> None:
    """Each cut is refused; each flipped bit is found, or nothing that was measured has changed."""
    sound = sound_store(folder)
    path = folder / "mission.sqlite"
    cuts = range(0, len(sound), 1 if is_every else 211)
    flips = range(8 * len(sound))
    chosen = flips if is_every else random.Random(16).sample(flips, 800)
    missed = refusals = 0
    for size in cuts:
        path.write_bytes(sound[:size])
        missed += not is_refused(path)
    for at, bit in (divmod(flip, 8) for flip in chosen):
        path.with_name("mission.sqlite-journal").unlink(missing_ok=True)
        path.write_bytes(sound[:at] + bytes((sound[at] ^ (1 << bit),)) + sound[at + 1 :])
        try:
            refusals += is_refused(path)
        except AssertionError:
            missed += 1
    print(f"{len(cuts)} cuts and {len(chosen)} flips: {refusals} flips refused, {missed} missed")
    measured("P16", 100.0 * (1.0 - missed / (len(cuts) + len(chosen))))
    assert not missed


def is_refused(path: Path) -> bool:
    try:
        check_store(path)
    except StoreError:
        return True
    return False
