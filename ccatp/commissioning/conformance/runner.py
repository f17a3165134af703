"""The list of all checks; runs them against one server and gives the results as JSON and as a table."""

import time
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from typing import Any, Literal, NamedTuple

from ccatp.commissioning.conformance import frame_checks, line_checks, motion_checks, rule_checks, session_checks
from ccatp.commissioning.conformance.checks import (
    Check,
    CheckFailed,
    Duty,
    Message,
    Need,
    NotApplicable,
    is_duty,
    is_number,
    is_positive,
    read_message,
    shorten,
)
from ccatp.commissioning.conformance.connections import (
    CheckContext,
    ControllerAndMonitor,
    Facts,
    RawConnection,
    receive_any,
)
from ccatp.errors import CcatpError, DaemonUnreachableError, ExitStatus
from ccatp.links.robot_messages import AUTH_HMAC

Outcome = Literal["pass", "fail", "not applicable"]
_MODULES = (session_checks, frame_checks, rule_checks, line_checks, motion_checks)
CHECKS: tuple[Check, ...] = tuple(check for module in _MODULES for check in module.CHECKS)
# With a hello that lacks what the other checks need, these two are all that can run.
_HELLO_CHECKS = {"hello": session_checks.check_fields, "hello-robot": session_checks.check_robot}
_WHY: dict[Need, str] = {
    "motion": "--no-motion",
    "real time": "lockstep: time stands still while an answer is missing",
    "lockstep": "hello.lockstep is false",
    "hmac": "hello.auth is none",
}


def check_ids() -> tuple[str, ...]:
    """The names of all checks, in the order in which they run."""
    return tuple(check.check_id for check in CHECKS)


class Result(NamedTuple):
    """One check's end: its identity, what the interface control document promises, how it ended, what was seen."""

    check_id: str
    promise: str
    outcome: Outcome
    detail: str


class NoRobot(DaemonUnreachableError):
    """No server of the robot link at the address, or another program holds the robot."""


class KeyNeeded(CcatpError):
    """The server asks for a mac, and there is no key."""

    exit_status = ExitStatus.USAGE


class Conformance:
    """The checks of one server; ``facts`` of its hello are ``None`` if it lacks what the checks need.

    Raises:
        NoRobot: nothing at the address says hello.
        KeyNeeded: it asks for a key.
    """

    def __init__(self, address: tuple[str, int], key: bytes | None, timeout_s: float) -> None:
        self._address, self._key, self._timeout_s = address, key, timeout_s
        self._where = f"{address[0]}:{address[1]}"
        self._fans: Duty | None = None
        hello = self._hello()
        self._why_unfit = ""
        try:
            for check in _HELLO_CHECKS.values():
                check(hello)
        except CheckFailed as failed:
            self._why_unfit = str(failed)
        self.facts = _facts(hello)
        if self.facts is not None and self.facts.needs_mac and key is None:
            raise KeyNeeded(f"the robot at {self._where} asks for a key: name its file with --key")

    def run(
        self, *, motion: bool, only: Collection[str] = (), report: Callable[[Result], object] = lambda _: None
    ) -> list[Result]:
        """Run the checks in their order, or only those named; ``report`` is called with each result.

        Raises:
            NoRobot: another program holds the robot.
        """
        results = []
        context = None if self.facts is None else self._begin(self.facts)
        try:
            for check in CHECKS:
                if not only or check.check_id in only:
                    outcome, detail = self._run_one(check, context, motion)
                    results.append(Result(check.check_id, check.promise, outcome, detail))
                    report(results[-1])
        finally:
            if context is not None:
                self._restore(context)
        return results

    def _run_one(self, check: Check, context: CheckContext | None, motion: bool) -> tuple[Outcome, str]:
        try:
            if context is None:
                if check.check_id not in _HELLO_CHECKS:
                    return "not applicable", f"the hello is of no use: {self._why_unfit}"
                return "pass", _HELLO_CHECKS[check.check_id](self._hello())
            facts = context.facts
            has: dict[Need, bool] = {
                "motion": motion,
                "real time": not facts.is_lockstep,
                "lockstep": facts.is_lockstep,
                "hmac": facts.needs_mac,
            }
            for need in check.needs:
                if not has[need]:
                    return "not applicable", _WHY[need]
            return "pass", check.run(context)
        except CheckFailed as failed:
            return "fail", str(failed)
        except NotApplicable as reason:
            return "not applicable", str(reason)
        finally:
            if context is not None:
                context.clear()

    def _hello(self) -> Message:
        try:
            link = RawConnection(self._address, self._timeout_s)
        except OSError as error:
            reason = error.strerror or str(error)
            raise NoRobot(f"no server at {self._where}: {reason}; start it first") from error
        try:
            deadline_s = time.monotonic() + self._timeout_s
            while not link.lines and not link.is_ended and (left_s := deadline_s - time.monotonic()) > 0.0:
                receive_any([link], left_s)
            line = link.lines[0] if link.lines else b""
        finally:
            link.close()
        message = read_message(line)
        if message is None or message.get("type") != "hello":
            seen = f"says {shorten(line)!r}" if line else "says nothing"
            raise NoRobot(f"no robot link at {self._where}: it {seen} where a hello should be")
        return message

    def _begin(self, facts: Facts) -> CheckContext:
        """Check that no other program holds the robot, note its fans; a context with numbers above those in use."""
        context = CheckContext(self._address, facts, self._key, self._timeout_s, 0)
        first_seq = 0
        try:
            frame = ControllerAndMonitor(context).expect(lambda _: True, "no frame")
        except CheckFailed as failed:
            if "role taken" in str(failed):
                raise NoRobot(f"another program drives the robot at {self._where}; end it first") from None
        else:
            self._fans, first_seq = frame.fans, max(frame.seq, frame.drive_seq, 0)
        finally:
            context.clear()
        return CheckContext(self._address, facts, self._key, self._timeout_s, first_seq)

    def _restore(self, context: CheckContext) -> None:
        """Fans as they were found; then no session, so that the wheels are held."""
        context.clear()
        fans = self._fans
        with suppress(CheckFailed, NotApplicable):
            pair = ControllerAndMonitor(context)
            if fans is not None and not is_duty(pair.steady().fans, fans):
                pair.fans(fans)
                pair.settle()
        context.clear()


def _facts(hello: Message) -> Facts | None:
    robot: Any = hello.get("robot")
    robot = robot if isinstance(robot, dict) else {}
    sizes = {name: robot.get(name) for name in ("wheel_radius_m", "wheel_base_m", "max_wheel_rad_s")}
    rates: dict[str, Any] = {name: hello.get(name) for name in ("frame_hz", "ttl_s")}
    floor, is_lockstep = robot.get("fan_floor"), hello.get("lockstep")
    is_fit = all(map(is_positive, (*rates.values(), *sizes.values()))) and is_number(floor)
    if not is_fit or not isinstance(is_lockstep, bool):
        return None
    needs_mac = hello.get("auth") == AUTH_HMAC
    return Facts(is_lockstep=is_lockstep, needs_mac=needs_mac, fan_floor=floor, **rates, **sizes)


_SHORT = {"pass": "ok", "fail": "FAIL", "not applicable": "-"}


def as_json(server: str, results: Sequence[Result]) -> dict[str, Any]:
    """What ``--json`` prints."""
    return {
        "server": server,
        "checks": [
            {"id": result.check_id, "promise": result.promise, "result": result.outcome, "detail": result.detail}
            for result in results
        ],
        "passed": _count(results, "pass"),
        "failed": _count(results, "fail"),
    }


def table_line(result: Result) -> str:
    """One result; for a failure with the promise."""
    detail = f"seen: {result.detail}; promised: {result.promise}" if result.outcome == "fail" else result.detail
    return f"{result.check_id:<21}{_SHORT[result.outcome]:<4}  {detail}"


def last_line(results: Sequence[Result]) -> str:
    """The number of results of each outcome."""
    passed, failed, idle = (_count(results, outcome) for outcome in ("pass", "fail", "not applicable"))
    return f"{passed} passed, {failed} failed, {idle} not applicable"


def _count(results: Sequence[Result], outcome: str) -> int:
    return sum(result.outcome == outcome for result in results)
