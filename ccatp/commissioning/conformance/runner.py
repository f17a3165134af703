"""Runs the checks against one server and gives the results as JSON and as a table."""

from collections import Counter
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from typing import Any, Literal, NamedTuple

from ccatp.commissioning.conformance import command_checks, harness, motion_checks, server_checks
from ccatp.errors import DaemonUnreachableError, UsageError, one_line
from ccatp.mirror.mirror import Mirror

CHECKS = (*server_checks.CHECKS, *command_checks.CHECKS, *motion_checks.CHECKS)
Outcome = Literal["pass", "fail", "not applicable", "undecided"]
# The only checks that can run if the hello lacks what the other checks need.
_HELLO_CHECKS = ("hello", "hello-robot")
_WHY: dict[harness.Need, str] = {
    "motion": "--no-motion",
    "body": "--on-stands",
    "turn": "a steered vehicle has one wheel speed",
    "real time": "lockstep: time stands still while an answer is missing",
    "lockstep": "hello.lockstep is false",
    "hmac": "hello.auth is none",
}
_SHORT = {"pass": "ok", "fail": "FAIL", "not applicable": "-", "undecided": "?"}
# With these outcomes it is not shown that the server keeps the interface control document.
UNPROVEN: tuple[Outcome, ...] = ("fail", "undecided")


def check_ids() -> tuple[str, ...]:
    """The names of all checks, in the order in which they run."""
    return tuple(check.check_id for check in CHECKS)


class Result(NamedTuple):
    """Result of one check: name, requirement of the interface control document, outcome, what was observed."""

    check_id: str
    promise: str
    outcome: Outcome
    detail: str


class NoRobot(DaemonUnreachableError):
    """No server of the robot link at the address, or another program holds the robot."""


class KeyNeeded(UsageError):
    """The server needs a mac, and no key is given."""


class Conformance:
    """The checks of one server; ``facts`` is ``None`` if its hello lacks what the checks need.

    ``mirror``: the robot stands at its base. Raises NoRobot: no hello from the address; KeyNeeded: no key is given.
    """

    def __init__(
        self, address: tuple[str, int], key: bytes | None, timeout_s: float, mirror: Mirror | None = None
    ) -> None:
        self._context = harness.CheckContext(address, key, timeout_s)
        self._context.mirror = mirror
        self._where = f"{address[0]}:{address[1]}"
        self._fans: harness.Pair | None = None
        hello = self._hello()
        self.facts: harness.Facts | None = None
        self._why_unfit, self._lacking = "", list[harness.Need]()
        try:
            self.facts = self._context.facts = harness.parse(harness.Facts, hello)
        except harness.CheckFailed as failed:
            self._why_unfit = str(failed)
        if self.facts is not None and self.facts.needs_mac and key is None:
            raise KeyNeeded(f"the robot at {self._where} asks for a key: name its file with --key")

    def run(
        self,
        *,
        motion: bool,
        on_stands: bool = False,
        only: Collection[str] = (),
        report: Callable[[Result], object] = lambda _: None,
    ) -> list[Result]:
        """Run the checks in their order, or only those named; ``report`` is called with each result.

        ``on_stands``: the wheels turn but the body does not move. Raises NoRobot: another program holds the robot.
        """
        results = []
        if (facts := self.facts) is not None:
            self._begin()
            has: dict[harness.Need, bool] = {
                "motion": motion, "body": not on_stands,
                "turn": not facts.robot.is_steered, "real time": not facts.lockstep, "lockstep": facts.lockstep,
                "hmac": facts.needs_mac,
            }  # fmt: skip
            self._lacking = [need for need, is_there in has.items() if not is_there]
        try:
            for check in CHECKS:
                if not only or check.check_id in only:
                    results.append(Result(check.check_id, check.promise, *self._run_one(check)))
                    report(results[-1])
        finally:
            if facts is not None:
                self._restore()
        return results

    def _run_one(self, check: harness.Check) -> tuple[Outcome, str]:
        try:
            if self.facts is None and check.check_id not in _HELLO_CHECKS:
                return "not applicable", f"the hello is of no use: {self._why_unfit}"
            if self.facts is not None and (lacking := [need for need in check.needs if need in self._lacking]):
                return "not applicable", _WHY[lacking[0]]
            return "pass", check.run(self._context)
        except harness.CheckFailed as failed:
            return "fail", str(failed)
        except harness.NotApplicable as reason:
            return "not applicable", str(reason)
        except Exception as error:
            return "undecided", _reason(error)
        finally:
            self._context.clear()

    def _hello(self) -> harness.Message:
        try:
            connection = self._context.connect()
        except OSError as error:
            raise NoRobot(f"no server at {self._where}: {error.strerror or error}; start it first") from error
        try:
            self._context.until(lambda: bool(connection.lines) or connection.is_ended)
        except harness.CheckFailed as failed:
            raise NoRobot(f"no robot link at {self._where}: {failed}") from failed
        finally:
            self._context.clear()
        line = connection.lines[0] if connection.lines else b""
        message = harness.read_message(line)
        if message is None or message.get("type") != "hello":
            seen = f"says {harness.shorten(line)!r}" if line else "says nothing"
            raise NoRobot(f"no robot link at {self._where}: it {seen} where a hello should be")
        return message

    def _begin(self) -> None:
        """Check that no other program holds the robot; store its fan duties and the highest number in use."""
        try:
            frame = harness.ControllerAndMonitor(self._context).expect(lambda _: True, "no frame")
        except Exception as error:
            if "role taken" in str(error):
                raise NoRobot(f"another program drives the robot at {self._where}; end it first") from None
        else:
            self._fans = frame.fans[0], frame.fans[1]
            self._context.last_seq = max(frame.seq, frame.cmd.seq, 0)
        finally:
            self._context.clear()

    def _restore(self) -> None:
        """Restore the fan duties; then end all sessions, so that the wheels are held."""
        self._context.clear()
        with suppress(Exception):  # the robot holds itself without a session; the results must still be shown
            pair = harness.ControllerAndMonitor(self._context)
            if self._fans is not None and not pair.steady().has_fans(self._fans):
                pair.fans(self._fans)
                pair.settle()
        self._context.clear()


def as_json(server: str, results: Sequence[Result]) -> dict[str, Any]:
    """What ``--json`` prints."""
    counts = Counter(result.outcome for result in results)
    return {
        "server": server,
        "checks": [
            {"id": result.check_id, "promise": result.promise, "result": result.outcome, "detail": result.detail}
            for result in results
        ],
        "passed": counts["pass"],
        "failed": counts["fail"],
        "undecided": counts["undecided"],
    }


def table_line(result: Result) -> str:
    """One result as text; a failure with its requirement."""
    detail = f"seen: {result.detail}; promised: {result.promise}" if result.outcome == "fail" else result.detail
    return f"{result.check_id:<21}{_SHORT[result.outcome]:<4}  {detail}"


def last_line(results: Sequence[Result]) -> str:
    """The number of results of each outcome."""
    counts = Counter(result.outcome for result in results)
    words: dict[Outcome, str] = {"pass": "passed", "fail": "failed"}
    words |= {"undecided": "undecided", "not applicable": "not applicable"}
    return ", ".join(f"{counts[outcome]} {word}" for outcome, word in words.items())


def _reason(error: Exception) -> str:
    return one_line(f"this check cannot be evaluated: {type(error).__name__}: {error}")
