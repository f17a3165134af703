"""The list of alarms."""

import time
import uuid
from pathlib import Path

import pytest
import structlog

from ccatp import conditions
from ccatp.core import Severity
from ccatp.daemon import alarms
from ccatp.daemon.alarms import LEAST_S, ActiveCause, AlarmList, active_cause, read_history
from tests.support.daemon import configuration, running_daemon

FAN = conditions.FAN_WEAK.text(side="left")
RIM = conditions.RIM_AHEAD.message
STALE = conditions.EDGE_STALE.message
FIRE, QUAKE, WEATHER = (f"emergency: {kind}" for kind in ("fire", "earthquake", "weather"))
NONE = Severity.NONE


@pytest.fixture
def known(tmp_path: Path) -> AlarmList:
    return make(tmp_path)


def make(run_dir: Path) -> AlarmList:
    return AlarmList(run_dir, structlog.get_logger(), now=iter(f"T{k}" for k in range(1000)).__next__)


def update(known: AlarmList, causes: list[tuple[str, Severity]], t_s: float) -> None:
    """By their texts; a severity that is none is that of the row."""
    found = [(active_cause(cause), severity) for cause, severity in causes]
    known.update([one._replace(severity=severity or one.severity) for one, severity in found], t_s)


def shown(known: AlarmList) -> list[tuple[str, str]]:
    return [(one.name, one.severity + (" ended" if one.ended else "")) for one in known.alarms]


@pytest.mark.parametrize(
    ("causes", "listed"),
    [
        ([], []),
        ([("operator", NONE)], []),
        ([(conditions.SENSOR_TOO_SLOW.text(sensor="edge sensors", rate=100, least=200), Severity.SLOW)], []),
        ([(FAN, NONE)], [("fan_weak", "return")]),
        ([(STALE, Severity.PAUSE)], []),
        ([(f"{STALE}, for 30 s", Severity.FAULT)], [("edge_stale", "fault")]),
        ([(STALE, Severity.HOLD), (FAN, NONE), (QUAKE, NONE)],
         [("earthquake", "fault"), ("fan_weak", "return"), ("edge_stale", "hold")]),
        ([("what no row says", NONE)], [("other", "fault")]),
        ([(FAN, NONE), (FAN, Severity.FAULT)], [("fan_weak", "fault")]),
    ],
)  # fmt: skip
def test_what_is_an_alarm_and_how_grave(
    known: AlarmList, causes: list[tuple[str, Severity]], listed: list[tuple[str, str]]
) -> None:
    update(known, causes, 10.0)
    assert shown(known) == listed


def test_what_is_not_grave_must_last(known: AlarmList, monkeypatch: pytest.MonkeyPatch) -> None:
    update(known, [(RIM, NONE)], 10.0)
    update(known, [], 10.5)
    update(known, [(RIM, NONE)], 11.0)
    update(known, [(RIM, NONE)], 11.9)
    assert shown(known) == []
    update(known, [(RIM, NONE)], 12.0)
    assert shown(known) == [("rim_ahead", "pause")]
    update(known, [], 13.0)
    assert shown(known) == []
    # While the link is lost the robot's clock stands.
    update(known, [(RIM, NONE)], 13.0)
    now_s = time.monotonic() + LEAST_S
    monkeypatch.setattr(time, "monotonic", lambda: now_s)
    update(known, [(RIM, NONE)], 13.0)
    assert shown(known) == [("rim_ahead", "pause")]


def test_danger_says_which_of_two_rows_of_one_message_it_is(known: AlarmList) -> None:
    slow, text = conditions.SENSOR_TOO_SLOW, conditions.SENSOR_TOO_SLOW.text(sensor="edge", rate=100, least=200)
    for t_s in (10.0, 11.0):
        known.update([ActiveCause(slow.name, text, Severity.SLOW)], t_s)
    assert shown(known) == [("sensor_too_slow", "slow")]


def test_a_grave_alarm_stays_until_it_is_acknowledged(known: AlarmList) -> None:
    update(known, [(FIRE, NONE), (WEATHER, NONE)], 10.0)
    update(known, [], 20.0)
    assert shown(known) == [("emergency", "return ended")]
    (alarm,) = known.alarms
    assert (alarm.cause, alarm.advice) == (f"{FIRE}; {WEATHER}", conditions.EMERGENCY.advice)
    assert (alarm.since, alarm.since_s, alarm.count, alarm.ended) == ("T0", 10.0, 1, "T1")
    update(known, [(FIRE, NONE)], 30.0)
    assert known.alarms[0].count == 2
    assert known.acknowledge("emergency", "anna", 31.0) is None
    assert known.acknowledge("emergency", "bob", 32.0) is None
    (alarm,) = known.alarms
    assert (alarm.acknowledged_by, alarm.acknowledged, alarm.ended) == ("anna", "T3", "")
    update(known, [], 40.0)
    assert known.alarms == []
    assert known.acknowledge("emergency", "anna", 41.0) == "no alarm 'emergency'; the list is empty"
    update(known, [(FAN, NONE)], 50.0)
    assert known.acknowledge("wings", "anna", 51.0) == "no alarm 'wings'; the list has fan_weak"


def test_one_that_becomes_graver_is_to_be_acknowledged_again(known: AlarmList) -> None:
    update(known, [(STALE, Severity.HOLD)], 10.0)
    known.acknowledge("edge_stale", "anna", 11.0)
    update(known, [(f"{STALE}, for 30 s", Severity.FAULT)], 40.0)
    (alarm,) = known.alarms
    assert (alarm.severity, alarm.acknowledged_by, alarm.since_s, alarm.count) == ("fault", "", 10.0, 1)
    update(known, [(STALE, Severity.HOLD)], 41.0)
    assert known.alarms == [alarm]


def test_a_successor_has_the_same_list_and_the_file_is_bounded(
    tmp_path: Path, known: AlarmList, monkeypatch: pytest.MonkeyPatch
) -> None:
    update(known, [(FAN, NONE), (QUAKE, NONE)], 10.0)
    known.acknowledge("fan_weak", "anna", 11.0)
    update(known, [(QUAKE, NONE)], 12.0)
    with (tmp_path / alarms.FILE).open("a") as file:
        file.write('\n{"utc": "cut o')
    assert make(tmp_path).alarms == known.alarms
    assert [(e.event, e.name, e.by) for e in read_history(tmp_path)] == [
        ("raised", "fan_weak", ""), ("raised", "earthquake", ""), ("acknowledged", "fan_weak", "anna"),
        ("ended", "fan_weak", ""),
    ]  # fmt: skip
    monkeypatch.setattr(alarms, "MAX_LINES", 4)
    update(known, [], 13.0)
    assert shown(known) == [("earthquake", "fault ended")]
    assert len(list(read_history(tmp_path))) == 4


def test_a_folder_that_is_gone_ends_nothing(tmp_path: Path) -> None:
    known = make(tmp_path / "gone")
    update(known, [(FAN, NONE)], 1.0)
    assert shown(known) == [("fan_weak", "return")]


async def test_all_that_danger_finds_is_listed_not_only_the_gravest() -> None:
    async with running_daemon(configuration()) as daemon:
        await daemon.until(lambda: daemon.is_driving)
        daemon.danger.monitor.emergency("earthquake", str(uuid.uuid4()))
        await daemon.until(lambda: len(daemon.main.status().alarms) == 1)
        daemon.danger.monitor.emergency("fire", str(uuid.uuid4()))  # which does not change the verdict
        await daemon.until(lambda: len(daemon.main.status().alarms) == 2)
        assert [(one.name, one.cause) for one in daemon.main.status().alarms] == [
            ("earthquake", QUAKE), ("emergency", FIRE),
        ]  # fmt: skip
