"""Danger permits motion only on a frame that it has judged, whatever comes in which order; main likewise drives."""

import ast
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import ccatp
from ccatp.beacons.links.messages import BeaconFrame
from ccatp.beacons.safety.rules import BeaconSafetyRules
from ccatp.core import NO_CAUSE, EventCode, Verdict
from ccatp.danger import DangerMonitor
from ccatp.links.frame_answers import (
    AWAY_SLACK_S,
    DriveRule,
    FrameStamp,
    JudgedFrame,
    PermitRule,
    is_restart,
    permitted,
)
from ccatp.links.robot_messages import CommandEcho, Sensors
from ccatp.missions import kind_of
from tests.support.scenario import config_of, radio_config_of

NOTHING, ALL = (False, False, False), (True, True, True)
frames = st.builds(
    FrameStamp, st.integers(0, 1), st.integers(1, 2), st.integers(0, 5), st.sampled_from((0.0, 0.01, 0.02))
)
permits = st.tuples(st.booleans(), st.booleans(), st.booleans())


def verdict_on(frame: FrameStamp, allowed: tuple[bool, bool, bool] = ALL) -> Verdict:
    return Verdict(frame.seq, frame.t_s, EventCode.NORMAL, NO_CAUSE, "", 0.0, 0.0, *allowed)


@given(frames, frames, permits)
def test_a_verdict_permits_motion_on_its_own_frame_only(
    newest: FrameStamp, other: FrameStamp, allowed: tuple[bool, bool, bool]
) -> None:
    found = permitted(newest, JudgedFrame(other, verdict_on(other, allowed)))
    assert found == (allowed if other == newest else NOTHING)
    assert permitted(newest, None) == permitted(None, None) == NOTHING


# A session begins, the robot restarts, the permit is sent again, a frame comes and is judged or not.
steps = st.one_of(
    st.sampled_from(("session", "restart", "again")),
    st.tuples(st.integers(0, 6), st.booleans(), permits, st.booleans()),
)


@pytest.mark.fault("L16")
@given(st.lists(steps, max_size=60))
def test_every_permit_of_motion_is_that_of_the_frame_that_it_answers(story: list[object]) -> None:
    rule, session, seq = PermitRule(), 1, 0
    newest: FrameStamp | None = None
    judged = dict[FrameStamp, tuple[bool, bool, bool]]()
    highest, number = -1, 0
    for step in story:
        if step == "session":
            rule.begin_session()
            session, newest = session + 1, None
        elif step == "restart":
            rule.restart()
            highest = -1
        elif isinstance(step, tuple):
            seq, is_judged, allowed, is_other = step
            frame = FrameStamp(0, session, seq, 0.01 * seq)
            is_new = newest is None or seq > newest.seq
            assert rule.take(frame) is (is_new and seq > highest)
            if is_new and seq > highest:
                highest = seq
                if is_judged:
                    rule.judge(verdict_on(frame._replace(t_s=9.0) if is_other else frame, allowed))
                    judged[frame] = NOTHING if is_other else allowed
            newest = frame if is_new else newest
        permit = rule.permit()
        assert (permit is None) is (newest is None)
        if permit is not None and newest is not None:
            assert permit.ack == newest.seq
            assert permit.seq > number
            number = permit.seq
            assert (permit.forward, permit.reverse, permit.turn) == judged.get(newest, NOTHING)


@given(st.lists(st.one_of(st.just("session"), st.tuples(st.integers(0, 6), st.integers(0, 6))), max_size=40))
def test_a_drive_moves_for_the_newest_frame_of_the_session_only(story: list[object]) -> None:
    rule, newest = DriveRule(), -1
    for step in story:
        if isinstance(step, tuple):
            newest, ack = step
            rule.take(newest)
            drive = rule.drive(ack, 1.0, 2.0)
            assert (drive.ack, drive.wr, drive.wl) == (ack, *((1.0, 2.0) if ack == newest else (0.0, 0.0)))
            again = rule.repeat()
            assert again is not None
            assert (again.seq, again.ack, again.wr, again.wl) == (drive.seq + 1, drive.ack, drive.wr, drive.wl)
        else:
            rule.begin_session()
            assert rule.repeat() is None


# -- the monitors ------------------------------------------------------------------------------------------------------


def frame(seq: int) -> Sensors:
    t_s = 0.01 * seq
    edges, wheels = [(t_s, 1, 1, 1, 1)], [(t_s, 0.0, 0.0)]
    echo = CommandEcho(0, 0.0, 0.0, held=True)
    return Sensors(seq, t_s, [], wheels, edges, None, (0.5, 0.5), 1.0, echo, [])  # type: ignore[arg-type]


@lru_cache
def monitor_of(kind: str) -> DangerMonitor | BeaconSafetyRules:
    cfg = config_of() if kind == "survey" else radio_config_of()
    rules: DangerMonitor | BeaconSafetyRules = kind_of(cfg).rules.get()(cfg)
    return rules


@pytest.mark.fault("L16")
@pytest.mark.parametrize("kind", ["survey", "beacons"])
@given(order=st.lists(st.integers(0, 12), max_size=20))
def test_a_monitor_permits_nothing_on_a_frame_that_it_does_not_judge(kind: str, order: list[int]) -> None:
    monitor = monitor_of(kind)
    monitor.reset()
    highest = -1
    for seq in order:
        if isinstance(monitor, BeaconSafetyRules):
            verdict = monitor.step(frame(seq), BeaconFrame(), None)
        else:
            verdict = monitor.step(frame(seq), None)
        assert (verdict.seq, verdict.t_s) == (seq, 0.01 * seq)
        if seq <= highest:
            assert (verdict.forward, verdict.reverse, verdict.turn) == NOTHING
        highest = max(highest, seq)


# -- one sender --------------------------------------------------------------------------------------------------------


def callers(name: str) -> Iterator[str]:
    folder = Path(ccatp.__file__).parent
    for path in sorted(folder.rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        for node in ast.walk(ast.parse(text)) if f"{name}(" in text else ():
            called = getattr(node, "func", None)
            if isinstance(node, ast.Call) and name in {getattr(called, "attr", None), getattr(called, "id", None)}:
                yield path.relative_to(folder).as_posix()


def test_permits_and_judged_frames_are_made_in_one_place() -> None:
    assert list(callers("send_permit")) == ["daemon/loops/danger_loop.py"]
    assert list(callers("JudgedFrame")) == ["links/frame_answers.py"]
    assert [path for path in callers("Permit") if not path.startswith("commissioning/")] == ["links/frame_answers.py"]


# -- restarts ----------------------------------------------------------------------------------------------------------

BEFORE = FrameStamp(7, 1, 500, 5.0)


@pytest.mark.parametrize(
    ("first", "away_s", "restarted"),
    [
        (FrameStamp(7, 2, 500, 5.0), 0.0, False),  # in lockstep the last frame comes again
        (FrameStamp(7, 2, 501, 5.01), 0.5, False),
        (FrameStamp(7, 2, 2500, 25.0), 20.0, False),
        (FrameStamp(7, 2, 2480, 24.8), 20.0, False),  # its clock is slow by 1 %
        (FrameStamp(8, 2, 501, 5.01), 0.5, True),
        (FrameStamp(7, 2, 499, 5.5), 0.5, True),
        (FrameStamp(7, 2, 501, 4.99), 0.5, True),
        (FrameStamp(7, 2, 1, 0.01), 0.5, True),
        (FrameStamp(7, 2, 800, 8.0), 20.0, True),  # its numbers have passed the old ones already
        (FrameStamp(7, 2, 1490, 14.9 + 10.0), 20.0 + AWAY_SLACK_S, False),
    ],
)
def test_a_restart_shows_in_boot_number_frame_number_or_clock(
    first: FrameStamp, away_s: float, restarted: bool
) -> None:
    assert is_restart(BEFORE, first, away_s) is restarted


@given(st.integers(0, 10_000), st.integers(0, 30_000), st.floats(0.0, 300.0))
def test_a_robot_that_restarted_while_it_was_away_is_never_taken_for_the_old_one(
    before: int, after: int, away_s: float
) -> None:
    """With the same boot number: its clock cannot show more than the time for which it was away."""
    up_s = 0.01 * before
    first_s = min(0.01 * after, away_s)
    first = FrameStamp(7, 2, round(100.0 * first_s), first_s)
    if up_s > AWAY_SLACK_S + 0.03 * away_s:
        assert is_restart(FrameStamp(7, 1, before, up_s), first, away_s)
