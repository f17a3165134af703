"""The list of alarms, the emergency latch that survives its process, and posts to a server that behaves badly."""

import socket
import threading
import time
import uuid
from collections.abc import Iterable, Iterator
from contextlib import closing
from io import StringIO
from pathlib import Path
from typing import Any
from uuid import UUID

import msgspec
import pytest
import structlog
import zmq
from msgspec.structs import replace
from structlog.testing import capture_logs

from ccatp.conditions import danger as conditions
from ccatp.conditions import text_of
from ccatp.conditions.mission import METROLOGY_UNRELIABLE, OPERATOR
from ccatp.config.models import AlarmsConfig
from ccatp.core import Cause, EmergencyKind, Severity, Verdict
from ccatp.daemon.loops.alarm_watch import AlarmWatch
from ccatp.daemon.loops.emergency_file import (
    EMERGENCIES_FILE,
    RESERVE_BYTES,
    PersistentEmergencyLatch,
    latched_kinds,
    read_active,
)
from ccatp.daemon.operator import alarms, webhook
from ccatp.daemon.operator.alarms import LEAST_S, ActiveCause, AlarmList, active_cause, read_history
from ccatp.daemon.operator.webhook import AlarmWebhook, changes
from ccatp.links.topics import Alarm, MissionStatus
from ccatp.safety.emergency_latch import cause_of
from tests.support.daemon import configuration, running_daemon
from tests.support.http_server import Posts, taking_posts
from tests.support.runs import until
from tests.support.scenario import config_of

FAN = conditions.FAN_WEAK.cause(side="left")
RIM = conditions.RIM_AHEAD.cause()
STALE = conditions.EDGE_STALE.cause()
FIRE, QUAKE, WEATHER = map(cause_of, (EmergencyKind.FIRE, EmergencyKind.EARTHQUAKE, EmergencyKind.WEATHER))
SLOW = conditions.SENSOR_TOO_SLOW.cause(sensor="edge sensors", rate="100", least="200")
NONE = Severity.NONE


@pytest.fixture
def known(tmp_path: Path) -> AlarmList:
    return make(tmp_path)


def make(run_dir: Path) -> AlarmList:
    return AlarmList(run_dir, structlog.get_logger(), now=iter(f"T{k}" for k in range(1000)).__next__)


def update(known: AlarmList, causes: list[tuple[Cause, Severity]], t_s: float) -> None:
    """A severity that is none is that of the row."""
    found = [(active_cause(cause), severity) for cause, severity in causes]
    known.update([one._replace(severity=severity or one.severity) for one, severity in found], t_s)


def shown(known: AlarmList) -> list[tuple[str, str]]:
    return [(one.name, one.severity + (" ended" if one.ended else "")) for one in known.alarms]


@pytest.mark.parametrize(
    ("causes", "listed"),
    [
        ([], []),
        ([(OPERATOR.cause(), NONE)], []),
        ([(SLOW, Severity.SLOW)], []),
        ([(FAN, NONE)], [("fan_weak", "return")]),
        ([(STALE, Severity.PAUSE)], []),
        ([(replace(STALE, lasted_s=30.0), Severity.FAULT)], [("edge_stale", "fault")]),
        ([(STALE, Severity.HOLD), (FAN, NONE), (QUAKE, NONE)],
         [("earthquake", "fault"), ("fan_weak", "return"), ("edge_stale", "hold")]),
        ([(Cause("of_a_newer_version"), NONE)], [("of_a_newer_version", "fault")]),
        ([(FAN, NONE), (FAN, Severity.FAULT)], [("fan_weak", "fault")]),
    ],
)  # fmt: skip
def test_what_is_an_alarm_and_how_grave(
    known: AlarmList, causes: list[tuple[Cause, Severity]], listed: list[tuple[str, str]]
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
    slow, text = conditions.SENSOR_TOO_SLOW, text_of(SLOW)
    for t_s in (10.0, 11.0):
        known.update([ActiveCause(slow.name, text, Severity.SLOW)], t_s)
    assert shown(known) == [("sensor_too_slow", "slow")]


def test_a_grave_alarm_stays_until_it_is_acknowledged(known: AlarmList) -> None:
    update(known, [(FIRE, NONE), (WEATHER, NONE)], 10.0)
    update(known, [], 20.0)
    assert shown(known) == [("emergency", "return ended")]
    (alarm,) = known.alarms
    assert (alarm.cause, alarm.advice) == ("emergency: fire; emergency: weather", conditions.EMERGENCY.advice)
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


def test_a_second_emergency_is_a_second_event_of_one_entry(tmp_path: Path, known: AlarmList) -> None:
    update(known, [(FIRE, NONE), (FIRE, NONE)], 10.0)  # of danger and of the mission that it sends home
    known.acknowledge("emergency", "anna", 11.0)
    before = {one.name: one for one in known.alarms}
    update(known, [(FIRE, NONE), (WEATHER, NONE)], 12.0)
    (alarm,) = known.alarms
    assert (alarm.cause, alarm.count, alarm.acknowledged_by) == ("emergency: fire; emergency: weather", 2, "")
    assert (alarm.since_s, [what for what, _ in changes(before, {alarm.name: alarm})]) == (10.0, ["raised"])
    for causes in ([FIRE], [FIRE, WEATHER], []):  # one is cleared, and comes again
        update(known, [(cause, NONE) for cause in causes], 13.0)
    assert [one.event for one in read_history(tmp_path)] == ["raised", "acknowledged", "raised", "ended"]


def test_an_emergency_that_outlasts_a_process_is_one_event(tmp_path: Path, known: AlarmList) -> None:
    update(known, [(FIRE, NONE)], 10.0)
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    verdict = Verdict.normal(1, 0.01)
    with closing(AlarmWatch(context, f"ipc://{tmp_path}/danger", make(tmp_path))) as watch:
        watch.update([], None, 0.0)
        watch.update([], replace(verdict, raised=1), 0.0)  # danger reports changes; there was none
        assert shown(watch.alarms) == [("emergency", "return")]
        watch.update([], verdict, 0.0)
        assert shown(watch.alarms) == [("emergency", "return ended")]
    context.destroy(linger=0)
    assert [one.event for one in read_history(tmp_path)] == ["raised", "ended"]


def test_one_that_becomes_graver_is_to_be_acknowledged_again(known: AlarmList) -> None:
    update(known, [(STALE, Severity.HOLD)], 10.0)
    known.acknowledge("edge_stale", "anna", 11.0)
    update(known, [(replace(STALE, lasted_s=30.0), Severity.FAULT)], 40.0)
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
    with (tmp_path / alarms.ALARMS_FILE).open("a") as file:
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


def test_the_text_of_an_alarm_has_the_newest_number(known: AlarmList) -> None:
    for count in (3, 4, 5):
        update(known, [(METROLOGY_UNRELIABLE.cause(count=count, channels="2"), NONE)], 10.0 + count)
    (alarm,) = known.alarms
    assert alarm.cause.startswith("the lengths of 5 points in a row")
    assert (alarm.count, alarm.since_s) == (1, 14.0)  # what is not grave must last for a second


async def test_all_that_danger_finds_is_listed_not_only_the_gravest() -> None:
    async with running_daemon(configuration()) as daemon:
        await daemon.until(lambda: daemon.is_driving)
        daemon.danger.monitor.emergency("earthquake", str(uuid.uuid4()))
        await daemon.until(lambda: len(daemon.main.status().alarms) == 1)
        daemon.danger.monitor.emergency("fire", str(uuid.uuid4()))  # which does not change the verdict
        await daemon.until(lambda: len(daemon.main.status().alarms) == 2)
        assert [(one.name, one.cause) for one in daemon.main.status().alarms] == [
            ("earthquake", text_of(QUAKE)), ("emergency", text_of(FIRE)),
        ]  # fmt: skip


# -- the emergency latch -----------------------------------------------------------------------------------------------

Log = structlog.typing.FilteringBoundLogger


@pytest.fixture
def reported() -> StringIO:
    return StringIO()


@pytest.fixture
def log(reported: StringIO) -> Log:
    logger: Log = structlog.wrap_logger(structlog.PrintLogger(reported))
    return logger


@pytest.mark.fault("P2")
def test_an_emergency_is_there_after_a_restart_until_it_is_cleared(tmp_path: Path, log: Log) -> None:
    path = tmp_path / EMERGENCIES_FILE
    latch = PersistentEmergencyLatch(path, log)
    assert not latch.is_latched
    assert latch.raise_emergency("fire", "a", "smoke") is None
    assert latch.raise_emergency("power", "b") is None
    assert latch.clear("b", at_base_or_held=True) is None
    again = PersistentEmergencyLatch(path, log)
    assert again.newest == latch.newest
    assert again.raised == 2
    assert [one.id for one in read_active(path)] == ["a"]
    assert again.raise_emergency("power", "b") is None  # cleared is cleared
    assert again.newest == latch.newest
    assert again.clear("a", at_base_or_held=True) is None
    assert not PersistentEmergencyLatch(path, log).is_latched


@pytest.mark.parametrize("text", ["", "{", "[]", '{"active": [{"id": "a"}], "cleared": []}', '{"active": 3}'])
def test_a_file_that_cannot_be_read_counts_as_an_emergency(
    tmp_path: Path, log: Log, reported: StringIO, text: str
) -> None:
    (tmp_path / EMERGENCIES_FILE).write_text(text)
    assert latched_kinds(tmp_path / EMERGENCIES_FILE) == {EmergencyKind.OPERATOR}
    latch = PersistentEmergencyLatch(tmp_path / EMERGENCIES_FILE, log)
    assert latch.is_latched
    newest = latch.newest
    assert newest is not None
    assert f"'ccatp clear {UUID(newest.id)}' ends it" in reported.getvalue()
    again = PersistentEmergencyLatch(tmp_path / EMERGENCIES_FILE, log)
    assert again.newest == newest  # the same after a restart
    assert again.clear(newest.id, at_base_or_held=True) is None
    assert not PersistentEmergencyLatch(tmp_path / EMERGENCIES_FILE, log).is_latched


def no_room(*_: int) -> None:
    raise OSError(28, "No space left on device")


def test_a_disk_that_refuses_does_not_keep_an_emergency_from_being_latched(
    tmp_path: Path, log: Log, reported: StringIO, monkeypatch: pytest.MonkeyPatch
) -> None:
    latch = PersistentEmergencyLatch(tmp_path / EMERGENCIES_FILE, log)
    monkeypatch.setattr("os.fsync", no_room)
    assert latch.raise_emergency("fire", "a") is None
    assert latch.is_latched
    assert "emergencies_not_saved" in reported.getvalue()


@pytest.mark.fault("P13")
def test_an_emergency_is_kept_on_a_full_disk(tmp_path: Path, log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    """The room for it was taken before; a full disk gives no more."""
    latch = PersistentEmergencyLatch(tmp_path / EMERGENCIES_FILE, log)
    assert (tmp_path / f"{EMERGENCIES_FILE}.new").stat().st_size == RESERVE_BYTES
    monkeypatch.setattr("os.posix_fallocate", no_room)
    assert latch.raise_emergency("earthquake", "a") is None
    assert PersistentEmergencyLatch(tmp_path / EMERGENCIES_FILE, log).is_shaking


# -- posts of alarms ---------------------------------------------------------------------------------------------------

PATIENCE_S = 30.0


def alarm(name: str = "fan_weak", **fields: Any) -> Alarm:
    whole = Alarm(name=name, severity="return", cause="weak", advice="", since="A", since_s=1.0)
    return msgspec.structs.replace(whole, **fields)


def status(*alarms: Alarm) -> MissionStatus:
    return MissionStatus(seq=1, t_s=1.0, state="held", alarms=list(alarms))


@pytest.fixture
def posts() -> Iterator[Posts]:
    with taking_posts() as found:
        yield found


def hook_to(url: str, give_up_s: float = 600.0, known: Iterable[Alarm] = ()) -> AlarmWebhook:
    cfg = AlarmsConfig(webhook_url=f"{url}hook", webhook_timeout_s=20.0, webhook_give_up_s=give_up_s)
    return AlarmWebhook(cfg, "tonight", structlog.get_logger(), known)


@pytest.mark.parametrize(
    ("before", "after", "events"),
    [
        ([], [alarm()], ["raised"]),
        ([alarm()], [alarm()], []),
        ([alarm()], [alarm(severity="fault")], ["raised"]),
        ([alarm()], [alarm(count=2)], ["raised"]),
        ([alarm()], [alarm(acknowledged_by="anna")], ["acknowledged"]),
        ([alarm()], [alarm(ended="B")], ["ended"]),
        ([alarm()], [], ["ended"]),
        ([alarm(ended="B")], [], []),
        ([alarm("a")], [alarm("b", acknowledged_by="anna", ended="B")], ["raised", "acknowledged", "ended", "ended"]),
    ],
)
def test_what_is_posted(before: list[Alarm], after: list[Alarm], events: list[str]) -> None:
    by_name = [{one.name: one for one in alarms} for alarms in (before, after)]
    assert [event for event, _ in changes(*by_name)] == events


def test_a_post_that_is_not_taken_comes_again_in_order(posts: Posts, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(webhook, "FIRST_PAUSE_S", 0.01)
    posts.answers += [500, 429]
    hook = hook_to(posts.url)
    hook.update(None)
    hook.update(status(alarm()))
    hook.update(status(alarm()))
    hook.update(status(alarm(ended="B")))
    until(lambda: len(posts.bodies) == 4)
    hook.close(PATIENCE_S)
    assert [(body["event"], body["answered"]) for body in posts.bodies] == [
        ("raised", 500), ("raised", 429), ("raised", 200), ("ended", 200),
    ]  # fmt: skip
    assert (posts.bodies[0]["run"], posts.bodies[0]["state"]) == ("tonight", "held")
    assert posts.bodies[0]["alarm"]["cause"] == "weak"


def test_a_resumed_run_posts_what_changed_since_the_session_before(posts: Posts) -> None:
    over, lasting, gone = alarm("over", ended="B"), alarm("lasting"), alarm("gone", acknowledged_by="root")
    hook = hook_to(posts.url, known=(over, lasting, gone))
    hook.update(status(over, lasting, alarm("new")))
    until(lambda: len(posts.bodies) == 2)
    hook.close(PATIENCE_S)
    found = [(body["event"], body["alarm"]["name"]) for body in posts.bodies]
    assert found == [("raised", "new"), ("ended", "gone")]


def test_a_refusal_is_logged_and_the_next_one_is_posted(posts: Posts) -> None:
    posts.answers.append(404)
    with capture_logs() as logs:
        hook = hook_to(posts.url)
        hook.update(status(alarm()))
        until(lambda: len(posts.bodies) == 1)
        hook.update(status(alarm(ended="B")))
        until(lambda: len(posts.bodies) == 2)
        hook.close(PATIENCE_S)
    assert [(log["event"], log["why"]) for log in logs] == [("alarm_not_posted", "refused: status 404")]


def test_a_server_that_never_answers_delays_nothing_and_the_queue_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(webhook, "MOST_WAITING", 3)
    with socket.create_server(("127.0.0.1", 0)) as silent, capture_logs() as logs:
        hook = hook_to(f"http://127.0.0.1:{silent.getsockname()[1]}/")
        for count in range(1, 11):
            hook.update(status(alarm(count=count)))
        hook.close(0.05)
    assert logs == [{"event": "alarm_posts_left_out", "log_level": "warning", "count": 10}]


def test_an_old_post_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(webhook, "FIRST_PAUSE_S", 0.01)
    with socket.create_server(("127.0.0.1", 0)) as gone:
        port = gone.getsockname()[1]
    with capture_logs() as logs:
        hook = hook_to(f"http://127.0.0.1:{port}/", give_up_s=0.02)
        hook.update(status(alarm()))
        until(lambda: logs)
        hook.close(PATIENCE_S)
    assert [log["event"] for log in logs] == ["alarm_not_posted"]


def test_without_an_address_there_is_no_thread() -> None:
    hook = AlarmWebhook(config_of().alarms, "run", structlog.get_logger())
    hook.update(status(alarm()))
    hook.close(PATIENCE_S)
    assert not [thread for thread in threading.enumerate() if thread.name == "webhook"]


def test_an_event_after_a_line_that_a_kill_cut_off_is_read_again(tmp_path: Path) -> None:
    update(make(tmp_path), [(FIRE, NONE)], 10.0)
    path = tmp_path / alarms.ALARMS_FILE
    whole = path.read_bytes()
    for kept in range(len(whole) + 1):
        path.write_bytes(whole[:kept])
        update(make(tmp_path), [(FIRE, NONE), (FAN, NONE)], 20.0)
        assert "fan_weak" in {event.name for event in read_history(tmp_path)}
        assert {name for name, _ in shown(make(tmp_path))} == {"emergency", "fan_weak"}


def test_emergencies_whose_file_was_cut_off_or_damaged_are_taken_for_one(tmp_path: Path, log: Log) -> None:
    path = tmp_path / EMERGENCIES_FILE
    latch = PersistentEmergencyLatch(path, log)
    latch.raise_emergency("fire", str(uuid.UUID(int=1)))
    latch.raise_emergency("power", str(uuid.UUID(int=2)), "the second")
    whole = path.read_bytes()
    cuts = [whole[:kept] for kept in range(len(whole) + 1)]
    damaged = [b"[]", b"null", b"{}", b"\0" * 64, b"[" * 100_000, b'{"active":[],"cleared":[],"raised":Infinity}']
    for content in (*cuts, *damaged):
        path.write_bytes(content)
        assert PersistentEmergencyLatch(path, log).is_latched
