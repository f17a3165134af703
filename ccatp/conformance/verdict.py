"""Pure. How a check ends: by a line that says what was seen, or by one of these exceptions."""

from typing import Literal, NamedTuple

Outcome = Literal["pass", "fail", "not applicable"]


class Broken(Exception):
    """A promise of the page was not kept; the text says what was seen instead."""


class NotApplicable(Exception):
    """The server promises nothing here, or nothing that can be seen; the text says why."""


class Result(NamedTuple):
    """One check's end: its identity, what the page promises, how it ended, and what was seen."""

    check_id: str
    promise: str
    outcome: Outcome
    detail: str


def require(is_kept: bool, seen: str) -> None:
    """Go on if a promise is kept.

    Args:
        is_kept: whether it is.
        seen: what was seen if it is not.

    Raises:
        Broken: it is not.
    """
    if not is_kept:
        raise Broken(seen)
