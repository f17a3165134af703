"""Pure. Results as JSON and as a table."""

from collections.abc import Iterable, Sequence
from typing import Any

from ccatp.conformance.verdict import Result

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
