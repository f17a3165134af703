"""The list of alarms."""

import time
import uuid
from pathlib import Path

import pytest
import structlog

from ccatp import conditions
from ccatp.core import Severity
from ccatp.daemon import alarms
from ccatp.daemon.alarms import LEAST_S, AlarmList, read_history
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


def shown(known: AlarmList) -> list[tuple[str, str]]:
    return [(one.name, one.severity + (" ended" if one.ended else "")) for one in known.alarms]


@pytest.mark.parametrize(
    ("causes", "listed"),
    [
        ([], []),
        ([("operator", NONE)], []),
        ([("", NONE)], []),
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
    known.update(causes, 10.0)
    assert shown(known) == listed


def test_what_is_not_grave_must_last(known: AlarmList, monkeypatch: pytest.MonkeyPatch) -> None:
    known.update([(RIM, NONE)], 10.0)
    known.update([], 10.5)
    known.update([(RIM, NONE)], 11.0)
    known.update([(RIM, NONE)], 11.9)
    assert shown(known) == []
    known.update([(RIM, NONE)], 12.0)
    assert shown(known) == [("rim_ahead", "pause")]
    known.update([], 13.0)
    assert shown(known) == []
    # While the link is lost the robot's clock stands.
    known.update([(RIM, NONE)], 13.0)
    now_s = time.monotonic() + LEAST_S
    monkeypatch.setattr(time, "monotonic", lambda: now_s)
    known.update([(RIM, NONE)], 13.0)
    assert shown(known) == [("rim_ahead", "pause")]


def test_a_grave_alarm_stays_until_it_is_acknowledged(known: AlarmList) -> None:
    known.update([(FIRE, NONE), (WEATHER, NONE)], 10.0)
    known.update([], 20.0)
    assert shown(known) == [("emergency", "return ended")]
    (alarm,) = known.alarms
    assert (alarm.cause, alarm.advice) == (f"{FIRE}; {WEATHER}", conditions.EMERGENCY.advice)
    assert (alarm.since, alarm.since_s, alarm.count, alarm.ended) == ("T0", 10.0, 1, "T1")
    known.update([(FIRE, NONE)], 30.0)
    assert known.alarms[0].count == 2
    assert known.acknowledge("emergency", "anna", 31.0) is None
    assert known.acknowledge("emergency", "bob", 32.0) is None
    (alarm,) = known.alarms
    assert (alarm.acknowledged_by, alarm.acknowledged, alarm.ended) == ("anna", "T3", "")
    known.update([], 40.0)
    assert known.alarms == []
    assert known.acknowledge("emergency", "anna", 41.0) == "no alarm 'emergency'; the list is empty"
    known.update([(FAN, NONE)], 50.0)
    assert known.acknowledge("wings", "anna", 51.0) == "no alarm 'wings'; the list has fan_weak"


def test_one_that_becomes_graver_is_to_be_acknowledged_again(known: AlarmList) -> None:
    known.update([(STALE, Severity.HOLD)], 10.0)
    known.acknowledge("edge_stale", "anna", 11.0)
    known.update([(f"{STALE}, for 30 s", Severity.FAULT)], 40.0)
    (alarm,) = known.alarms
    assert (alarm.severity, alarm.acknowledged_by, alarm.since_s, alarm.count) == ("fault", "", 10.0, 1)
    known.update([(STALE, Severity.HOLD)], 41.0)
    assert known.alarms == [alarm]


def test_a_successor_has_the_same_list_and_the_file_is_bounded(
    tmp_path: Path, known: AlarmList, monkeypatch: pytest.MonkeyPatch
) -> None:
    known.update([(FAN, NONE), (QUAKE, NONE)], 10.0)
    known.acknowledge("fan_weak", "anna", 11.0)
    known.update([(QUAKE, NONE)], 12.0)
    with (tmp_path / alarms.FILE).open("a") as file:
        file.write('\n{"utc": "cut o')
    assert make(tmp_path).alarms == known.alarms
    assert [(e.event, e.name, e.by) for e in read_history(tmp_path)] == [
        ("raised", "fan_weak", ""), ("raised", "earthquake", ""), ("acknowledged", "fan_weak", "anna"),
        ("ended", "fan_weak", ""),
    ]  # fmt: skip
    monkeypatch.setattr(alarms, "MAX_LINES", 4)
    known.update([], 13.0)
    assert shown(known) == [("earthquake", "fault ended")]
    assert len(list(read_history(tmp_path))) == 4


def test_a_folder_that_is_gone_ends_nothing(tmp_path: Path) -> None:
    known = make(tmp_path / "gone")
    known.update([(FAN, NONE)], 1.0)
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
