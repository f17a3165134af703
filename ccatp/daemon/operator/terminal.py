"""The terminal output of a run: progress, messages, summary, status table."""

import json
import os
import sys
import time
from collections.abc import Mapping, Sequence
from typing import Any, Self

import msgspec
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from ccatp.conditions import danger_text, find_condition
from ccatp.core import Severity
from ccatp.daemon.supervision.process import RunContext
from ccatp.daemon.supervision.run_text import RunText, arrival, clock
from ccatp.errors import printable
from ccatp.links.liveness import RateLimitedLog
from ccatp.links.topics import Alarm, DangerEvent, LogMessage, Message, MissionStatus, TrackMessage
from ccatp.missions import kind_of
from ccatp.records.summary import format_table
from ccatp.survey.ending import ending_text, read_ending
from ccatp.survey.turn import is_after_hold, is_under_way, turn_text

LINES_OF_A_KIND, LINES_PERIOD_S = 3, 10.0
STYLES = {"info": "", "warning": "yellow", "error": "bold red"}


class _BufferedConsole(Console):
    """A console whose terminal may be closed; the survey continues without it."""

    def on_broken_pipe(self) -> None:
        self.quiet = True

    def _check_buffer(self) -> None:
        try:
            super()._check_buffer()
        except OSError:
            self.quiet = True


# Severities of danger's findings that are shown. A pause is not: it ends by itself or becomes a hold.
SHOWN = {Severity.SLOW, Severity.HOLD, Severity.RETURN, Severity.FAULT}


class RunView:
    """Shows progress and messages on standard error, the summary on standard output.

    ``verbosity``: -1 shows only warnings and errors; 1 adds each change of the state.
    """

    def __init__(self, run: RunContext, verbosity: int = 0) -> None:
        is_sim = run.is_sim
        self._is_quiet = verbosity < 0
        self._is_verbose = verbosity > 0
        self._state = ""
        self._text: RunText = kind_of(run.config).text.get()(run.config)
        self._console: Console = _BufferedConsole(stderr=True, highlight=False)
        self._is_terminal = self._console.is_terminal and not self._is_quiet
        self._rate_limit = RateLimitedLog(LINES_OF_A_KIND, LINES_PERIOD_S)
        self._has_pose = False
        self._verdict = (0, "", 0)  # code, cause and severity of the last event of danger
        self._shown_tenths = 0
        title, self._goals = self._text.title(is_sim), self._text.goals
        if not self._is_quiet:
            self._console.print(printable(f"{title}; writing {run.run_dir}"), soft_wrap=True, markup=False)
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[state]}"),
            console=self._console,
            auto_refresh=False,
        )
        self._task = self._progress.add_task("SIM" if is_sim else self._goals, total=None, state="starting")

    def __enter__(self) -> Self:
        if self._is_terminal:
            self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._is_terminal:
            self._progress.stop()

    def show_message(self, level: str, text: str) -> None:
        """Show one line to the operator, unless too many similar ones were shown; ``log.jsonl`` has them all."""
        if self._is_quiet and level == "info":
            return
        shown = self._rate_limit.take(level, text, time.monotonic())
        if shown is not None:
            self._console.print(f"{level}: {printable(shown)}", style=STYLES[level], markup=False, soft_wrap=True)

    def show(self, message: Message) -> None:
        """Show the part of a message for operators: progress, lines, the first pose, findings of danger."""
        if isinstance(message, TrackMessage) and not self._has_pose and message.rows:
            self._has_pose = True
            _, t_s, row, col, x, y, heading, _ = message.rows[-1]
            where = f"panel {row}-{col}, x {x:.4f} m, y {y:.4f} m, heading {heading:.4f} rad"
            self.show_message("info", f"first pose at {t_s:.2f} s: {where}")
        elif isinstance(message, MissionStatus):
            self._show_status(message)
        elif isinstance(message, LogMessage):
            self.show_message(message.level, message.text)
        elif isinstance(message, DangerEvent):
            self._show_danger(message)

    def _show_danger(self, message: DangerEvent) -> None:
        """Show a verdict that is new; an event also reports that further findings began or ended."""
        verdict = message.code, message.cause, message.severity
        if verdict != self._verdict and (message.code or message.severity in SHOWN):
            text = danger_text(message.condition, message.cause, message.signal, message.value, limit=message.limit)
            what = f"code {message.code}" if message.code else Severity(message.severity).name.lower()
            self.show_message("warning", f"danger: {what}, {text}, at {message.t_s:.2f} s")
        self._verdict = verdict

    def _show_status(self, status: MissionStatus) -> None:
        text = self.text_of(status)
        if self._is_verbose and status.state != self._state:
            self._state = status.state
            self._console.print(f"debug: {text}", soft_wrap=True, markup=False)
        if self._is_terminal:
            self._progress.update(self._task, completed=status.done, total=status.total, state=text)
            self._progress.refresh()
            return
        tenths = 10 * status.done // max(status.total, 1)
        if tenths > self._shown_tenths and not self._is_quiet:
            self._shown_tenths = tenths
            done = f"{10 * tenths} %: {status.done} of {status.total} {self._goals}"
            self._console.print(f"{done}, {text}", soft_wrap=True)

    def text_of(self, status: MissionStatus) -> str:
        """State, place, times, and what else the kind of mission shows."""
        return self._text.progress(status)

    def show_summary(self, summary: dict[str, Any], *, as_json: bool) -> None:
        """Print only JSON on standard output, or a table."""
        try:
            ending = read_ending(summary)
            ended = "" if ending is None else printable(ending_text(ending))
            print(json.dumps(summary, indent=1) if as_json else format_table(summary, ended), flush=True)
        except OSError as error:
            # The mission is over and its result is stored; the remaining output is discarded.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            self.show_message("warning", f"standard output cannot be written: {error.strerror}; see summary.json")

    def show_report(self, where: str) -> None:
        """Show where the report is, or why there is none; on standard error, to keep standard output pure JSON."""
        if not self._is_quiet:
            self._console.print(printable(f"report  {where}"), soft_wrap=True, markup=False)


CODES = {0: "normal", 1: "near the mirror's edge", 2: "operation aborted"}
BAR = 30
_SHOWN = 10


def _read(status: Mapping[str, Any]) -> MissionStatus:
    """The ``status`` in the reply of the operator channel."""
    return msgspec.convert({"seq": -1, "t_s": 0.0, "state": "", **status}, MissionStatus, strict=False)


def share_done(status: MissionStatus) -> float:
    """Share of the points that are measured or skipped, 0 to 1."""
    return (status.done + status.skipped) / status.total if status.total else 0.0


def status_rows(answered: Mapping[str, Any], text: RunText | None = None) -> list[tuple[str, str]]:
    """Name and value of each line of the table, from the ``status`` in the reply of the operator channel.

    ``text``: the texts of the run; ``None``: it is taken for a survey.
    """
    status = _read(answered)
    goals, reached = ("points", "measured") if text is None else (text.goals, text.reached)
    accuracy = arrival if text is None else text.accuracy
    filled = round(BAR * share_done(status))
    skips = f", {status.skipped} skipped" if status.skipped else ""
    row = None if is_after_hold(status) else find_condition(status.condition)
    severity = Severity(max(status.severity, row.severity if row is not None else 0))
    late = f"{status.missed_deadlines}, worst {status.worst_lateness_ms:.0f} ms"
    grip = f"friction {status.friction:.2f}, thrust {status.grip:.2f} times the least that holds the robot"
    bad = f"{status.bad_lines} from the robot, the first: {status.bad_line}; 'ccatp conformance' checks the firmware"
    count = f"{status.done} of {status.total} {reached}{skips}  [{'#' * filled}{'.' * (BAR - filled)}]"
    is_over = bool(status.outcome) or status.exit_status >= 0
    rows = [
        ("now", turn_text(status).line),
        ("state", status.state if is_over else f"{status.state} {status.point}".strip()),
        ("summary state", status.summary_state),
        ("cause", status.cause),
        ("severity", severity.name.lower() if severity else ""),
        ("for", clock(status.t_s - status.since_s) if status.cause and not is_after_hold(status) else ""),
        ("alarms", alarms_text(status.alarms)),
        ("what to do", row.advice if row is not None else ""),
        ("outcome", status.outcome),
        (goals, count),
        ("time", f"{clock(status.elapsed_s)} elapsed{_remaining(status, with_bound=True)}"),
        accuracy(status),
        ("grip", grip if status.grip else ""),
        ("event code", f"{status.code} {CODES.get(status.code, '')}".strip()),
        ("late frames", late if status.missed_deadlines else ""),
        ("bad lines", bad if status.bad_lines else ""),
        *((f"not measured: {why}", _named(points)) for why, points in status.left_out.items()),
        ("exit status", str(status.exit_status) if status.exit_status >= 0 else ""),
    ]
    return [(name, value) for name, value in rows if value]


def alarms_text(alarms: Sequence[Alarm]) -> str:
    """Numbers of alarms, and the command that lists them; empty without any."""
    active, unseen = sum(not one.ended for one in alarms), sum(not one.acknowledged_by for one in alarms)
    return f"{active} active, {unseen} not acknowledged; see 'ccatp alarms'" if alarms else ""


def _named(points: Sequence[str]) -> str:
    names = ", ".join(points[:_SHOWN])
    return names if len(points) <= _SHOWN else f"{len(points)} points: {names}, ..."


def _remaining(status: MissionStatus, *, with_bound: bool) -> str:
    """The remaining time; empty if the mission makes no progress, or does not know it."""
    if not is_under_way(status) or status.eta_s <= 0.0:
        return ""
    bound = f", minimum {clock(status.lower_bound_s)}" if with_bound else ""
    return f", {clock(status.eta_s)} remaining{bound}"


def status_line(answered: Mapping[str, Any], text: RunText | None = None) -> str:
    """The status in one line; ``text`` as in ``status_rows``."""
    status = _read(answered)
    goals = "points" if text is None else text.goals
    times, what = f"{clock(status.elapsed_s)} elapsed{_remaining(status, with_bound=False)}", turn_text(status).line
    return f"{100.0 * share_done(status):.0f} %: {status.done} of {status.total} {goals}, {times}: {what}"
