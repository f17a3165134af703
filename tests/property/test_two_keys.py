"""Wheels turn only by a drive and a permit of the present session and boot: every order of events, and seeded mutants.

The exploration is ``tests/property/two_keys.py``; the printed line has the number of states.
"""

from collections.abc import Callable
from dataclasses import replace
from math import inf
from typing import Any

import pytest

from ccatp.core import ALL_MOTION
from ccatp.links.frame_answers import DriveRule, FrameStamp, PermitRule
from ccatp.links.robot_messages import Drive, Permit, Role
from ccatp.onboard.rules import MotionRules
from ccatp.onboard.sessions import ClientSession, RobotServer
from tests.faults.linking import Measured
from tests.property.two_keys import DIRECTIONS, HZ, TTL, Bounds, Robot, Violation, explore

MAIN = Bounds(free=("controller",))
DANGER = Bounds(free=("monitor",))
BOTH = Bounds()
FEW: dict[str, Any] = {"gaps": (4,), "repeats": False}


def check(bounds: Bounds, measured: Measured, depth: int = 10_000, at_least: int = 0) -> None:
    found = explore(bounds, depth)
    print(f"{bounds.free}, {bounds.direction}: {found}")
    assert found.is_whole or found.depth == depth >= 12
    assert found.states >= at_least
    assert found.moving > 0
    measured("L17", 0)  # a violation ends the test before


@pytest.mark.fault("L17")
def test_all_orders_of_drives_frames_sessions_and_restarts(measured: Measured) -> None:
    check(replace(MAIN, **FEW), measured, depth=12, at_least=3000)


@pytest.mark.fault("L17")
def test_all_orders_of_permits_frames_sessions_and_restarts(measured: Measured) -> None:
    check(replace(DANGER, **FEW, judges=False), measured, depth=12, at_least=3000)


@pytest.mark.slow
@pytest.mark.fault("L17")
@pytest.mark.parametrize("direction", DIRECTIONS)
@pytest.mark.parametrize("bounds", [MAIN, DANGER], ids=["main", "danger"])
def test_every_state_of_one_key(bounds: Bounds, direction: str, measured: Measured) -> None:
    check(replace(bounds, direction=direction), measured, at_least=5000)


@pytest.mark.slow
@pytest.mark.fault("L17")
def test_every_state_of_main_with_two_commands_on_their_way(measured: Measured) -> None:
    check(replace(MAIN, commands=2, drives_still=True, gaps=(4,)), measured, at_least=10_000)


@pytest.mark.slow
@pytest.mark.fault("L17")
def test_twelve_events_of_both_keys(measured: Measured) -> None:
    check(replace(BOTH, **FEW, judges=False), measured, depth=12, at_least=30_000)


# -- mutants -----------------------------------------------------------------------------------------------------------


class RulesMutant(MotionRules):
    """Rules with one fault."""

    def __init__(self, fault: str) -> None:
        super().__init__(TTL / HZ, 8.0)
        self.fault = fault
        if fault == "lasts a tick longer":
            self._ttl_s += 1.0 / HZ
        elif fault == "never expires":
            self._ttl_s = inf

    def lose(self, role: Role) -> None:
        if self.fault == "a monitor that has gone is not needed":
            self.has_monitor_joined = role == "controller" and self.has_monitor_joined
        if self.fault != "a command survives its session":
            super().lose(role)

    def _may_move(self, drive: tuple[float, float], until_s: float) -> bool:
        allowed, permit = super()._may_move(drive, until_s), self._permit
        if self.fault == "a permit allows every direction":
            self._permit = None if permit is None else ALL_MOTION
            allowed = super()._may_move(drive, until_s)
            self._permit = permit
        elif self.fault == "a permit never expires" and permit is not None:
            kept, self._permit_s = self._permit_s, inf
            allowed = super()._may_move(drive, until_s)
            self._permit_s = kept
        elif self.fault == "a monitor is not needed":
            return until_s - self._drive_s <= self._ttl_s + 1e-9
        return allowed


class RobotMutant(Robot):
    """A robot with one fault."""

    def __init__(self, fault: str) -> None:
        self.fault = fault
        super().__init__((TTL / HZ, 8.0, 0.0), 1.0 / HZ, HZ)

    def _boot(self) -> None:
        super()._boot()
        self.rules = RulesMutant(self.fault)

    def _take(self, kind: str, seq: int, values: tuple[Any, ...]) -> bool:
        if self.fault == "an older number is executed":
            self._newest[kind] = -1
        elif self.fault == "an equal number is executed" and seq == self._newest[kind]:
            self._newest[kind] -= 1
        return super()._take(kind, seq, values)

    def _forget(self, kind: str) -> None:
        kept = self._newest[kind]
        super()._forget(kind)
        if self.fault == "numbers go on in the next session":
            self._newest[kind] = kept


class ServerMutant(RobotServer):
    """A server that goes on obeying a session that has ended."""

    def lost(self, session: ClientSession) -> None:
        role = session.role
        super().lost(session)
        session.role = role


def of_robot(fault: str, bounds: Bounds) -> Bounds:
    return replace(bounds, makes_robot=lambda: RobotMutant(fault))


class Careless(PermitRule):
    """Permits that do not belong to their frame."""

    def permit(self) -> Permit | None:
        permit, judged = super().permit(), self._judged
        if permit is not None and judged is not None:
            verdict = judged.verdict
            permit = Permit(permit.seq, permit.ack, verdict.forward, verdict.reverse, verdict.turn)
        return permit


class RepeatsVerdict(Careless):
    """A frame that is not judged gets the last verdict."""

    def take(self, frame: FrameStamp) -> bool:
        judged = self._judged
        is_new = super().take(frame)
        self._judged = judged
        return is_new


class ForgetsSession(RepeatsVerdict):
    """The verdict of the session before counts in the next one."""

    def begin_session(self) -> None:
        judged = getattr(self, "_judged", None)
        super().begin_session()
        self._judged = judged


class PermitsAtOnce(PermitRule):
    """Motion is permitted before the frame is judged."""

    def permit(self) -> Permit | None:
        permit = super().permit()
        if permit is not None and self._judged is None:
            permit = Permit(permit.seq, permit.ack, True, True, True)
        return permit


class JudgesTwice(PermitRule):
    """The last frame of the session before is judged again."""

    def take(self, frame: FrameStamp) -> bool:
        self._highest_seq = -1
        return super().take(frame)


class NumbersAnew(PermitRule):
    """The numbers of the permits do not grow."""

    def permit(self) -> Permit | None:
        self._seq = 0
        return super().permit()


class RepeatsOldDrive(DriveRule):
    """The drive of the session before is repeated in the next one."""

    def begin_session(self) -> None:
        newest = getattr(self, "_newest", None)
        super().begin_session()
        self._newest = newest

    def repeat(self) -> Drive | None:
        newest = self._newest
        if newest is None:
            return None
        self._seq += 1
        self._newest = Drive(self._seq, newest.ack, newest.wr, newest.wl)
        return self._newest


class RepeatsForOlderFrame(DriveRule):
    """A drive is repeated although a newer frame has come."""

    def drive(self, ack: int, right_rad_s: float, left_rad_s: float, steer_rad: float | None = None) -> Drive:
        self._frame_seq = ack
        return super().drive(ack, right_rad_s, left_rad_s, steer_rad)


def of_permits(rule: Callable[[], PermitRule], **changes: Any) -> Bounds:
    return replace(DANGER, gaps=(4,), makes_permits=rule, **changes)


TWO = replace(MAIN, commands=2, **FEW)
QUICK, QUICK_DANGER = replace(MAIN, **FEW), replace(DANGER, **FEW, judges=False)
MUTANTS: dict[str, Bounds] = {
    **{fault: of_robot(fault, QUICK) for fault in (
        "lasts a tick longer", "never expires", "a command survives its session",
    )},
    "an equal number is executed": of_robot("an equal number is executed", replace(MAIN, gaps=(4,))),
    "an older number is executed": of_robot("an older number is executed", TWO),
    **{f"danger: {fault}": of_robot(fault, QUICK_DANGER) for fault in (
        "a permit never expires", "lasts a tick longer", "a monitor that has gone is not needed",
        "a monitor is not needed", "a command survives its session", "numbers go on in the next session",
    )},
    "a permit allows every direction": of_robot("a permit allows every direction", replace(DANGER, **FEW)),
    "an old session is obeyed": replace(QUICK, makes_server=lambda robot: ServerMutant(robot, lockstep=False)),
    "danger: an old session is obeyed": replace(
        QUICK_DANGER, makes_server=lambda robot: ServerMutant(robot, lockstep=False)
    ),
    "a frame that is not judged gets the last verdict": of_permits(RepeatsVerdict, repeats=False),
    "the verdict of the session before counts": of_permits(ForgetsSession, repeats=False, judges=False),
    "motion is permitted before the frame is judged": of_permits(PermitsAtOnce, repeats=False, judges=False),
    "a frame is judged twice": of_permits(JudgesTwice, repeats=False, judges=False),
    "permits have no numbers": of_permits(NumbersAnew, judges=False),
    "a restart is seen by the boot number alone": replace(
        QUICK_DANGER, restarted=lambda before, first: first.boot != before.boot
    ),
    "the drive of the session before is repeated": replace(QUICK, makes_drives=RepeatsOldDrive),
    "a drive is repeated for an older frame": replace(QUICK, makes_drives=RepeatsForOlderFrame),
}  # fmt: skip


@pytest.mark.fault("L17")
@pytest.mark.parametrize("name", MUTANTS)
def test_the_exploration_finds_a_mutant_of_the_rules(name: str, measured: Measured) -> None:
    with pytest.raises(Violation) as found:
        explore(MUTANTS[name], states=20_000)
    print(f"{name}: {found.value}")
    measured("L17", 100.0, "percent")
