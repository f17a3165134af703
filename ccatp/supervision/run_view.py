"""Glue. What a run shows on the terminal: progress where there is one, plain lines where there is none."""

import json
import sys
import time
from pathlib import Path
from types import TracebackType
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from ccatp.config.models import Config
from ccatp.repetition import Sparing
from ccatp.summary import format_table
from ccatp.wire.topics import MissionStatus, Track

LINES_OF_A_KIND, LINES_PERIOD_S = 3, 10.0
STYLES = {"info": "", "warning": "yellow", "error": "bold red"}


class _PatientConsole(Console):
    """A terminal that may go away: the survey goes on without it."""

    def on_broken_pipe(self) -> None:
        """Say nothing more."""
        self.quiet = True

    def _check_buffer(self) -> None:
        try:
            super()._check_buffer()
        except OSError:
            self.quiet = True


class RunView:
    """Progress and messages on standard error; the summary on standard output.

    Args:
        title: what runs.
        is_sim: mark it visibly as a simulation.
        run_dir: where the run is written.
        goals: what there are so many of to be done.
    """

    def __init__(self, title: str, *, is_sim: bool, run_dir: Path, goals: str = "points") -> None:
        """Say what runs."""
        self._console: Console = _PatientConsole(stderr=True, highlight=False)
        self._is_terminal = self._console.is_terminal
        self._sparing = Sparing(LINES_OF_A_KIND, LINES_PERIOD_S)
        self._has_pose = False
        self._told_tenths = 0
        self._goals = goals
        self._console.print(f"{title}; writing {run_dir}", soft_wrap=True, markup=False)
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[state]}"),
            console=self._console,
            auto_refresh=False,
        )
        self._task = self._progress.add_task("SIM" if is_sim else goals, total=None, state="starting")

    def __enter__(self) -> "RunView":
        if self._is_terminal:
            self._progress.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self._is_terminal:
            self._progress.stop()

    def say(self, level: str, text: str) -> None:
        """One line for the operator; of those that come again and again a few. ``log.jsonl`` has them all."""
        told = self._sparing.take(level, text, time.monotonic())
        if told is not None:
            self._console.print(f"{level}: {told}", style=STYLES[level], markup=False, soft_wrap=True)

    def pose(self, track: Track) -> None:
        """The first pose shows that the robot is there."""
        if not self._has_pose and track.rows:
            self._has_pose = True
            _, t_s, row, col, x, y, heading, _ = track.rows[-1]
            where = f"panel {row}-{col}, x {x:.4f} m, y {y:.4f} m, heading {heading:.4f} rad"
            self.say("info", f"first pose at {t_s:.2f} s: {where}")

    def status(self, status: MissionStatus) -> None:
        """Points done, state, ETA, error."""
        text = self.text_of(status)
        if self._is_terminal:
            self._progress.update(self._task, completed=status.done, total=status.total, state=text)
            self._progress.refresh()
            return
        tenths = 10 * status.done // max(status.total, 1)
        if tenths > self._told_tenths:
            self._told_tenths = tenths
            self._console.print(
                f"{10 * tenths} %: {status.done} of {status.total} {self._goals}, {text}", soft_wrap=True
            )

    def text_of(self, status: MissionStatus) -> str:
        """State, place, times, error."""
        times = f"{_clock(status.elapsed_s)} elapsed, {_clock(status.eta_s)} to go"
        arrival = f", arrival {status.error_mm:.2f} mm" if status.error_mm else ""
        return f"{_where(status.state, status.point)}, {times}{arrival}"

    def show_summary(self, summary: dict[str, Any], *, as_json: bool) -> None:
        """The end: JSON alone on standard output, or a table."""
        if as_json:
            json.dump(summary, sys.stdout, indent=1)
            sys.stdout.write("\n")
        else:
            sys.stdout.write(format_table(summary) + "\n")
        sys.stdout.flush()

    def show_report(self, where: str) -> None:
        """Where the report is, or why there is none; on standard error, so that JSON stays alone."""
        self._console.print(f"report  {where}", soft_wrap=True, markup=False)


def survey_title(cfg: Config, *, is_sim: bool) -> str:
    """What runs, of a survey."""
    what = "SIMULATION" if is_sim else "survey"
    world = f", world {cfg.world.name}, seed {cfg.run.seed}" if is_sim else ""
    return f"ccatp {what} of {cfg.mirror.name}{world}, filter {cfg.run.filter}"


class BeaconView(RunView):
    """The same of a mission among beacons."""

    def text_of(self, status: MissionStatus) -> str:
        """State, place, time, uncertainty."""
        cause = f" ({status.cause})" if status.cause else ""
        where = f"{_where(status.state + cause, status.point)}, {_clock(status.elapsed_s)} elapsed"
        return f"{where}, position known to {0.1 * status.error_mm:.1f} cm"


def _where(state: str, point: str) -> str:
    return f"{state} {point}" if point else state


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes}:{rest:02d}"
