"""Runs the checks against one server, from the first connection to the last.

Results as JSON and as a table.
"""

import time
from collections.abc import Callable, Collection, Iterable, Sequence
from contextlib import suppress
from typing import Any

from ccatp.commissioning.conformance.checks import CHECKS, Check, Need
from ccatp.commissioning.conformance.connections import (
    CheckContext,
    ControllerAndMonitor,
    Facts,
    RawConnection,
    auth_needs_mac,
    receive_any,
)
from ccatp.commissioning.conformance.judges import (
    CheckFailed,
    Message,
    NotApplicable,
    Result,
    is_duty,
    is_number,
    is_positive,
    judge_fields,
    judge_robot,
    read_message,
    shorten,
)
from ccatp.commissioning.conformance.rule_checks import TOLERANCE, Duty
from ccatp.errors import CcatpError, DaemonUnreachableError, ExitStatus

_WHY: dict[Need, str] = {
    "motion": "--no-motion",
    "real time": "lockstep: time stands still while an answer is missing",
    "lockstep": "hello.lockstep is false",
    "hmac": "hello.auth is none",
}


class NoRobot(DaemonUnreachableError):
    """Nothing there that speaks the robot link, or another program holds the robot."""


class KeyNeeded(CcatpError):
    """The server asks for a mac, and there is no key."""

    exit_status = ExitStatus.USAGE


class Conformance:
    """The checks of one server.

    Attributes:
        facts: of the server's hello; ``None`` if it lacks what the checks need.

    Raises:
        NoRobot: nothing there that says hello.
        KeyNeeded: it asks for a key.
    """

    def __init__(self, address: tuple[str, int], key: bytes | None, timeout_s: float) -> None:
        self._address, self._key, self._timeout_s = address, key, timeout_s
        self._where = f"{address[0]}:{address[1]}"
        self._fans: Duty | None = None
        hello = self._hello()
        self._why_unfit = ""
        self.facts = self._facts(hello)
        if self.facts is not None and self.facts.needs_mac and key is None:
            raise KeyNeeded(f"the robot at {self._where} asks for a key: name its file with --key")

    def run(
        self, *, motion: bool, only: Collection[str] = (), tell: Callable[[Result], object] = lambda _: None
    ) -> list[Result]:
        """Run the checks in the order of the table.

        Args:
            only: names of the checks to run; all if empty.

        Raises:
            NoRobot: another program holds the robot.
        """
        results = []
        stage = None if self.facts is None else self._stage(self.facts)
        try:
            for check in CHECKS:
                if not only or check.check_id in only:
                    results.append(self._play(check, stage, motion))
                    tell(results[-1])
        finally:
            if stage is not None:
                self._leave(stage)
        return results

    def _play(self, check: Check, stage: CheckContext | None, motion: bool) -> Result:
        lacking = None if stage is None else _lacking(check, stage.facts, motion)
        if stage is None and check.check_id not in {"hello", "hello-robot"}:
            return Result(check.check_id, check.promise, "not applicable", f"the hello is of no use: {self._why_unfit}")
        if lacking is not None:
            return Result(check.check_id, check.promise, "not applicable", _WHY[lacking])
        try:
            seen = self._unfit(check) if stage is None else check.story(stage)
        except CheckFailed as broken:
            return Result(check.check_id, check.promise, "fail", str(broken))
        except NotApplicable as reason:
            return Result(check.check_id, check.promise, "not applicable", str(reason))
        finally:
            if stage is not None:
                stage.clear()
        return Result(check.check_id, check.promise, "pass", seen)

    def _unfit(self, check: Check) -> str:
        """The checks of a hello with which nothing else can begin."""
        return (judge_fields if check.check_id == "hello" else judge_robot)(self._hello())

    # -- before and after -----------------------------------------------------------------------------------------

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
            said = f"says {shorten(line)!r}" if line else "says nothing"
            raise NoRobot(f"no robot link at {self._where}: it {said} where a hello should be")
        return message

    def _facts(self, hello: Message) -> Facts | None:
        robot = hello.get("robot")
        try:
            judge_fields(hello)
            judge_robot(hello)
        except CheckFailed as broken:
            self._why_unfit = str(broken)
        robot = robot if isinstance(robot, dict) else {}
        sizes: list[Any] = [robot.get(name) for name in ("wheel_radius_m", "wheel_base_m", "max_wheel_rad_s")]
        frame_hz, ttl_s, floor = hello.get("frame_hz"), hello.get("ttl_s"), robot.get("fan_floor")
        is_fit = all(map(is_positive, (frame_hz, ttl_s, *sizes))) and is_number(floor)
        if not is_fit or not isinstance(hello.get("lockstep"), bool):
            return None
        radius_m, base_m, most_rad_s = sizes
        return Facts(
            hello["lockstep"], hello["frame_hz"], hello["ttl_s"], auth_needs_mac(hello), radius_m, base_m, most_rad_s,
            robot["fan_floor"],
        )  # fmt: skip

    def _stage(self, facts: Facts) -> CheckContext:
        """See that nobody else holds the robot, and how the fans stand; a stage with numbers above those in use."""
        stage = CheckContext(self._address, facts, self._key, self._timeout_s, 0)
        first_seq = 0
        try:
            pair = ControllerAndMonitor(stage)
            frame = pair.expect(lambda _: True, "no frame")
        except CheckFailed as broken:
            if "role taken" in str(broken):
                raise NoRobot(f"another program drives the robot at {self._where}; end it first") from None
        else:
            self._fans, first_seq = frame.fans, max(frame.seq, frame.drive_seq, 0)
        finally:
            stage.clear()
        return CheckContext(self._address, facts, self._key, self._timeout_s, first_seq)

    def _leave(self, stage: CheckContext) -> None:
        """Fans as they were found; then no session, so that the wheels are held."""
        stage.clear()
        fans = self._fans
        with suppress(CheckFailed, NotApplicable):
            pair = ControllerAndMonitor(stage)
            if fans is not None and not is_duty(pair.steady().fans, fans, TOLERANCE):
                pair.fans(fans)
                pair.settle()
        stage.clear()


def _lacking(check: Check, facts: Facts, motion: bool) -> Need | None:
    """What a check needs and does not have."""
    has: dict[Need, bool] = {
        "motion": motion,
        "real time": not facts.is_lockstep,
        "lockstep": facts.is_lockstep,
        "hmac": facts.needs_mac,
    }
    return next((need for need in check.needs if not has[need]), None)


_ID_WIDTH, _OUTCOME_WIDTH = 21, 4
_SHORT = {"pass": "ok", "fail": "FAIL", "not applicable": "-"}


def as_json(server: str, results: Sequence[Result]) -> dict[str, Any]:
    """What ``--json`` prints."""
    return {
        "server": server,
        "checks": [
            {"id": result.check_id, "promise": result.promise, "result": result.outcome, "detail": result.detail}
            for result in results
        ],
        "passed": count(results, "pass"),
        "failed": count(results, "fail"),
    }


def table_line(result: Result) -> str:
    """One result; a failure says what was promised, too."""
    detail = f"seen: {result.detail}; promised: {result.promise}" if result.outcome == "fail" else result.detail
    return f"{result.check_id:<{_ID_WIDTH}}{_SHORT[result.outcome]:<{_OUTCOME_WIDTH}}  {detail}"


def last_line(results: Sequence[Result]) -> str:
    """How many ended how."""
    passed, failed, idle = (count(results, outcome) for outcome in ("pass", "fail", "not applicable"))
    return f"{passed} passed, {failed} failed, {idle} not applicable"


def count(results: Iterable[Result], outcome: str) -> int:
    """Results that ended so."""
    return sum(result.outcome == outcome for result in results)
