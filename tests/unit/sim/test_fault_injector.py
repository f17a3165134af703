"""Every type of fault on every signal: observed at the robot, and effective in the frames that it delivers."""

import json
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from ccatp.config.models import Config
from ccatp.links.robot_codec import MAX_LINE_BYTES
from ccatp.mirror.mirror import Mirror
from ccatp.sim.fault_plan import SENSOR_SIGNALS, TYPES, FaultPlan, parse_plan
from ccatp.sim.robot import Robot
from tests.support.scenario import config_of, fault_plan, mirror_of

PLACES = {
    "imu_ax": ("imu", 1),
    "imu_wz": ("imu", 2),
    "encoder_right": ("enc", 1),
    "encoder_left": ("enc", 2),
    "edge_front_left": ("edge", 1),
    "edge_front_right": ("edge", 2),
    "edge_rear_left": ("edge", 3),
    "edge_rear_right": ("edge", 4),
}
FROM, UNTIL = 20, 60  # frames: the fault acts from 0.2 s to 0.6 s
FRAMES = 80


def plan_of(signal: str, kind: str, **values: object) -> FaultPlan:
    return fault_plan({"signal": signal, "type": kind, "at_s": 0.2, "for_s": 0.4, **values})


class Drive:
    """The raw lines of a short drive, one bytes object a frame."""

    def __init__(self, config: Config, mirror: Mirror, plan: FaultPlan | None, frames: int = FRAMES) -> None:
        self.robot = Robot(config, mirror, np.random.default_rng(1), plan)
        self.robot.join("controller")
        self.robot.command_fans(1, 0.25, 0.5)
        self.lines: list[bytes] = []
        self.delivered: list[bool] = []
        for k in range(1, frames):
            rate = 2.0 + math.sin(0.2 * k)
            self.robot.drive(k, rate, 0.5 * rate)
            self.robot.advance()
            self.lines.append(self.robot.delivered_line)
            self.delivered.append(self.robot.delivered is not None)

    def readings(self, signal: str, first: int = FROM + 1, last: int = UNTIL - 1) -> list[tuple[float, Any]]:
        """(t, reading) of the samples in a range of frames, as they stand in the raw lines; no sample of a wheel left
        out."""
        found: list[tuple[float, Any]] = []
        for line in b"".join(self.lines[first - 1 : last]).splitlines():
            frame = json.loads(line)  # as lenient as a reader can be: NaN is a number to it
            if signal in PLACES:
                name, column = PLACES[signal]
                found += [(row[0], row[column]) for row in frame[name] if row[column] is not None]
            elif signal != "gravity":
                found.append((frame["t"], frame[signal]))
            elif frame["gravity"] is not None:
                found.append((frame["gravity"][0], frame["gravity"][1:]))
        return found


@pytest.fixture(scope="module")
def sound(config: Config, mirror: Mirror) -> Drive:
    return Drive(config, mirror, None)


def flat(reading: Any) -> list[float]:
    return list(reading) if isinstance(reading, list) else [reading]


def is_always_there(signal: str) -> bool:
    return signal in {"fans", "soc"}


def check_off(signal: str, was: list[tuple[float, Any]], found: list[tuple[float, Any]]) -> None:
    if is_always_there(signal):
        assert len({str(reading) for _, reading in found}) == 1
    else:
        assert found == []


def check_stuck(signal: str, was: list[tuple[float, Any]], found: list[tuple[float, Any]]) -> None:
    assert [t for t, _ in found] == [t for t, _ in was]
    assert {x for _, reading in found for x in flat(reading)} == {1.0 if signal.startswith("fans") else 0.0}


def check_garbage(signal: str, was: list[tuple[float, Any]], found: list[tuple[float, Any]]) -> None:
    assert [t for t, _ in found] == [t for t, _ in was]
    sizes = [max(map(abs, flat(reading))) for _, reading in found]
    assert any(size > 1.0 if signal.startswith("edge") else size > 1e3 for size in sizes)
    assert any(size < 40.0 for size in sizes)
    assert found != was


def check_wrong(signal: str, was: list[tuple[float, Any]], found: list[tuple[float, Any]]) -> None:
    for (_, before), (_, after) in zip(was, found, strict=True):
        if signal.startswith("edge"):
            assert after == int(2.0 * (1 - before) + 0.01 >= 0.5)
        else:
            assert flat(after) == pytest.approx([-2.0 * x + 0.01 for x in flat(before)], rel=1e-12)


def check_slow(signal: str, was: list[tuple[float, Any]], found: list[tuple[float, Any]]) -> None:
    if is_always_there(signal):
        assert len(found) == len(was)
    else:
        assert len(found) == pytest.approx(len(was) / 4, abs=2)
        assert set(map(str, found)) <= set(map(str, was))


def check_delayed(signal: str, was: list[tuple[float, Any]], found: list[tuple[float, Any]]) -> None:
    assert [t for t, _ in found] == [t for t, _ in was]
    if is_always_there(signal) or signal.startswith("edge"):
        return
    before = [(t, str(reading)) for t, reading in was]
    for t, reading in found[-3:]:
        then = max((s, r) for s, r in before if s <= t - 0.1 + 1e-9)
        assert str(reading) == then[1]


def check_intermittent(signal: str, was: list[tuple[float, Any]], found: list[tuple[float, Any]]) -> None:
    for t, reading in found:
        is_sound = (t - 0.2) % 0.1 < 0.05
        if not is_always_there(signal):
            assert is_sound
        assert not is_sound or (t, reading) in was
    assert found
    if not is_always_there(signal):
        assert len(found) < 0.7 * len(was)


def check_saturated(signal: str, was: list[tuple[float, Any]], found: list[tuple[float, Any]]) -> None:
    for (_, before), (_, after) in zip(was, found, strict=True):
        if signal.startswith("edge"):
            assert after == 0
        else:
            assert flat(after) == [min(max(x, 0.15), 0.2) for x in flat(before)]


def check_non_finite(signal: str, was: list[tuple[float, Any]], found: list[tuple[float, Any]]) -> None:
    assert len(found) == len(was)
    assert all(math.isnan(x) for _, reading in found for x in flat(reading))


Check = Callable[[str, list[tuple[float, Any]], list[tuple[float, Any]]], None]
TABLE: dict[str, tuple[dict[str, object], Check]] = {
    "off": ({}, check_off),
    "stuck": ({"value": 0.0}, check_stuck),
    "garbage": ({"beyond": 0.3}, check_garbage),
    "wrong": ({"offset": 0.01, "factor": 2.0, "sign": -1}, check_wrong),
    "slow": ({"every": 4}, check_slow),
    "delayed": ({"by_s": 0.1, "stamps": "fresh"}, check_delayed),
    "intermittent": ({"period_s": 0.1, "duty": 0.5}, check_intermittent),
    "saturated": ({"low": 0.15, "high": 0.2}, check_saturated),
    "non_finite": ({"token": "NaN"}, check_non_finite),
}


def test_the_table_knows_every_type_and_signal() -> None:
    for signal in SENSOR_SIGNALS:
        assert set(TYPES[signal]) == set(TABLE)


@pytest.mark.parametrize("kind", TABLE)
@pytest.mark.parametrize("signal", SENSOR_SIGNALS)
def test_a_fault_acts_and_reports_it(config: Config, mirror: Mirror, sound: Drive, signal: str, kind: str) -> None:
    values, check = TABLE[kind]
    if (signal, kind) == ("fans", "stuck"):
        values = {"value": 1.0}
    drive = Drive(config, mirror, plan_of(signal, kind, **values))
    check(signal, sound.readings(signal), drive.readings(signal))
    # Observed at the robot: within its time, so often, and with an effect wherever one can be seen.
    assert drive.robot.injector is not None
    (record,) = drive.robot.injector.injected
    assert (record.signal, record.type, record.at_s) == (signal, kind, 0.2)
    times = [t for t, _ in sound.readings(signal, 1, FRAMES - 1) if 0.2 <= t < 0.6]
    assert (record.samples, record.from_s, record.until_s) == (len(times), times[0], times[-1])
    changes_nothing = kind == "delayed" and (is_always_there(signal) or signal.startswith("edge"))
    assert (record.changed > 0) is not changes_nothing
    # Before and after it, the frames are those of the run without it.
    assert drive.lines[: FROM - 1] == sound.lines[: FROM - 1]
    assert drive.readings(signal, UNTIL + 2, FRAMES - 1) == sound.readings(signal, UNTIL + 2, FRAMES - 1)
    # Nothing else changed: neither the truth nor what another signal reads.
    assert drive.robot.world.plant.pose == sound.robot.world.plant.pose
    assert all(len(line) <= MAX_LINE_BYTES for line in drive.lines)


def test_stuck_without_a_value_repeats_the_last_reading(config: Config, mirror: Mirror, sound: Drive) -> None:
    drive = Drive(config, mirror, plan_of("imu_wz", "stuck"))
    last = [reading for t, reading in sound.readings("imu_wz", 1, FROM) if t < 0.2][-1]
    assert {reading for _, reading in drive.readings("imu_wz", FROM, UNTIL - 1)} == {last}
    assert last != 0.0


@pytest.mark.parametrize("signal", [*PLACES, "gravity"])
def test_old_samples_arrive_late_under_their_own_times_and_in_order(
    config: Config, mirror: Mirror, sound: Drive, signal: str
) -> None:
    drive = Drive(config, mirror, plan_of(signal, "delayed", by_s=0.1, stamps="old"))
    assert drive.readings(signal, FROM + 1, FROM + 9) == []
    while_late = drive.readings(signal, FROM + 12, UNTIL - 1)
    assert while_late
    for number, line in enumerate(drive.lines[FROM + 12 : UNTIL - 1], start=FROM + 13):
        name = PLACES.get(signal, ("", 0))[0]
        for row in json.loads(line)[name] if name else []:
            assert row[0] <= number / 100.0 - 0.1 + 1e-9
    if signal != "gravity":  # a frame holds one reading of gravity, the newest
        assert drive.readings(signal, 1, FRAMES - 1) == sound.readings(signal, 1, FRAMES - 1)


def test_the_echo_of_the_fans_is_late(config: Config, mirror: Mirror) -> None:
    robot = Robot(config, mirror, np.random.default_rng(1), plan_of("fans", "delayed", by_s=0.1, stamps="fresh"))
    found = []
    for k in range(1, 50):
        if k == 31:
            robot.command_fans(1, 0.5, 0.5)
        robot.advance()
        assert robot.delivered is not None
        found.append(robot.delivered.fans[0])
    assert found.index(0.5) == pytest.approx(31 + 10 - 1, abs=1)


def test_both_encoders_off_leave_no_row(config: Config, mirror: Mirror) -> None:
    plans = [plan_of(f"encoder_{side}", "off") for side in ("right", "left")]
    drive = Drive(config, mirror, FaultPlan(plans[0].faults + plans[1].faults))
    assert json.loads(drive.lines[FROM + 5])["enc"] == []
    assert json.loads(Drive(config, mirror, plans[0]).lines[FROM + 5])["enc"][0][1] is None


def test_a_run_with_an_empty_plan_is_the_run_without() -> None:
    cfg = config_of("fyst-m2", run__world="hard")
    deck = mirror_of("fyst-m2")
    without, with_one = (Drive(cfg, deck, plan, 400) for plan in (None, FaultPlan()))
    assert with_one.lines == without.lines
    assert with_one.delivered == without.delivered
    assert with_one.robot.world.truth_row(0, 0.0) == without.robot.world.truth_row(0, 0.0)
    late = parse_plan('[[fault]]\nsignal = "imu_wz"\ntype = "garbage"\nat_s = 3.5\nbeyond = 0.5', "plan")
    assert Drive(cfg, deck, late, 400).lines[:340] == without.lines[:340]
    assert without.robot.delivered == with_one.robot.delivered
