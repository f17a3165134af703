"""Edge. What a campaign shows on standard error: a bar on a terminal, a plain line for each tenth elsewhere."""

import time
from pathlib import Path
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn


class CampaignView:
    """Progress of a campaign.

    Args:
        name: of the study.
        todo: jobs to do now.
        kept: jobs that are done already.
        is_quiet: show nothing.
    """

    def __init__(self, name: str, todo: int, kept: int, is_quiet: bool) -> None:
        """Say what is to do."""
        self._name, self._todo, self._count, self._told = name, todo, 0, 0
        self._console = Console(stderr=True, highlight=False, quiet=is_quiet)
        self._is_live = self._console.is_terminal and todo > 0
        self._began_s = time.monotonic()
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.fields[left]}"),
            console=self._console,
        )
        self._task = self._progress.add_task(f"study {name}", total=todo, left="")
        already = f", {kept} done before" if kept else ""
        self._say(f"study {name}: {todo} jobs to do{already}")

    def __enter__(self) -> "CampaignView":
        if self._is_live:
            self._progress.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self._is_live:
            self._progress.stop()

    def done(self, key: str, done_s: float, left_s: float) -> None:
        """One more job is done.

        Args:
            key: its name.
            done_s: what all that are done took their workers.
            left_s: what those still to come are expected to take.
        """
        self._count += 1
        left = time_left(time.monotonic() - self._began_s, done_s, left_s)
        if self._is_live:
            self._progress.update(self._task, completed=self._count, left=left)
            return
        tenths = 10 * self._count // self._todo
        if tenths > self._told:
            self._told = tenths
            share = f"{self._count} of {self._todo} jobs ({100 * self._count // self._todo} %)"
            self._say(f"study {self._name}: {share}, {left}; last {key}")

    def end(self, missing: int, total: int, out: Path) -> None:
        """Say what there is now."""
        if missing:
            self._say(
                f"study {self._name}: {total - missing} of {total} jobs are done; the other shards, "
                f"or the same command without --shard, do the {missing} that are missing"
            )
        else:
            self._say(f"study {self._name}: all {total} jobs are done; results are in {out}")

    def _say(self, text: str) -> None:
        self._console.print(f"ccatp: {text}", markup=False, soft_wrap=True)


def time_left(elapsed_s: float, done_s: float, left_s: float) -> str:
    """``1:02:03 left``, from the pace so far: time that passed per time of workers."""
    seconds = round(elapsed_s / done_s * left_s) if done_s > 0.0 else 0
    return f"{seconds // 3600}:{seconds // 60 % 60:02d}:{seconds % 60:02d} left"
