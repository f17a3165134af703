"""Pure. Where a mission stands, for the terminal: a table, and one line."""

from collections.abc import Mapping, Sequence
from typing import Any

CODES = {0: "normal", 1: "near the mirror's edge", 2: "operation aborted"}
BAR = 30
_SHOWN = 10


def clock(seconds: float) -> str:
    """``1:02:03``, or ``2:03`` below an hour."""
    minutes, rest = divmod(max(round(seconds), 0), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def share_done(status: Mapping[str, Any]) -> float:
    """Points that are done with, 0 to 1."""
    total = int(status.get("total", 0))
    return (int(status.get("done", 0)) + int(status.get("skipped", 0))) / total if total else 0.0


def status_rows(status: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Name and value of each line of the table.

    Args:
        status: the ``status`` of the operator channel's answer.
    """
    done, total, skipped = (int(status.get(key, 0)) for key in ("done", "total", "skipped"))
    state, point, cause = (str(status.get(key, "")) for key in ("state", "point", "cause"))
    rows = [("state", f"{state} {point}".strip())]
    if cause:
        rows.append(("cause", cause))
    if outcome := str(status.get("outcome", "")):
        rows.append(("outcome", outcome))
    filled = round(BAR * share_done(status))
    skips = f", {skipped} skipped" if skipped else ""
    rows.append(("points", f"{done} of {total} measured{skips}  [{'#' * filled}{'.' * (BAR - filled)}]"))
    elapsed_s, eta_s = float(status.get("elapsed_s", 0.0)), float(status.get("eta_s", 0.0))
    bound_s = float(status.get("lower_bound_s", 0.0))
    rows.append(("time", f"{clock(elapsed_s)} elapsed, {clock(eta_s)} to go, no path takes less than {clock(bound_s)}"))
    error_mm = float(status.get("error_mm", 0.0))  # exactly zero before the first arrival
    rows.append(("arrival", f"{error_mm:.2f} mm from the last point, as estimated" if error_mm else "none yet"))
    code = int(status.get("code", 0))
    rows.append(("danger", f"{code} {CODES.get(code, '')}".strip()))
    if slips := int(status.get("slips", 0)):
        rows.append(("late frames", f"{slips}, the latest by {float(status.get('lag_ms', 0.0)):.0f} ms"))
    rows += [(f"left out: {why}", _named(points)) for why, points in dict(status.get("left_out", {})).items()]
    if (exit_status := int(status.get("exit_status", -1))) >= 0:
        rows.append(("over", f"with exit status {exit_status}"))
    return rows


def _named(points: Sequence[str]) -> str:
    """The first names, and of many how many there are."""
    names = ", ".join(points[:_SHOWN])
    return names if len(points) <= _SHOWN else f"{len(points)} points: {names}, ..."


def status_line(status: Mapping[str, Any]) -> str:
    """The same in one line."""
    what = f"{status.get('state', '')} {status.get('point', '')}".strip()
    cause = f" ({status['cause']})" if status.get("cause") else ""
    times = f"{clock(float(status.get('elapsed_s', 0.0)))} elapsed, {clock(float(status.get('eta_s', 0.0)))} to go"
    points = f"{status.get('done', 0)} of {status.get('total', 0)} points"
    return f"{100.0 * share_done(status):.0f} %: {points}, {what}{cause}, {times}"
