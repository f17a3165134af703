"""What a campaign has done so far: one line for each finished job, safe on the disk before the next begins.

A campaign that is killed at any instant goes on from its ledger. Each shard writes a file of its own, so that shards
may share a directory; all of them are read.

What a campaign shows on standard error: a bar on a terminal, a plain line for each tenth elsewhere.

Writes what came of a campaign: ``result.json``, ``result.npz``, ``table.md`` and the figures.
"""

import base64
import fcntl
import io
import json
import os
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from ccatp.studies.campaign import (
    WHOLE,
    Arrays,
    CampaignError,
    CellResult,
    Column,
    Job,
    JobOutcome,
    Shard,
    Study,
    plain,
)

PATTERN = "jobs*.jsonl"


def make_out(out: Path) -> None:
    """Make a study's directory, before any work.

    Raises:
        CampaignError: it cannot be made.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CampaignError(f"--out: cannot make {out}: {error.strerror or error}; choose another --out") from error


class JobStore:
    """The finished jobs in a directory.

    Args:
        out: the campaign's directory; made if it is not there.
        others: directories whose jobs are taken over.

    Raises:
        CampaignError: ``out`` cannot be made, another campaign writes here, a directory does not exist, or a file holds
            what is no ledger.
    """

    def __init__(self, out: Path, shard: Shard = WHOLE, others: Iterable[Path] = ()) -> None:
        make_out(out)
        name = "jobs.jsonl" if shard == WHOLE else f"jobs-{shard.number}of{shard.of}.jsonl"
        self._done: dict[str, tuple[str, Path, JobOutcome]] = {}
        self._took_s: dict[str, float] = {}
        self._file: BinaryIO = (out / name).open("a+b")
        try:
            _lock(self._file)
            _cut_torn_line(self._file)
            for folder in (out, *others):
                self._read_all(folder)
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> "JobStore":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._file.close()

    def outcome(self, job: Job) -> JobOutcome | None:
        """What came of a job, or None where it is still to do.

        Raises:
            CampaignError: a job of the same name was done under other circumstances.
        """
        found = self._done.get(job.key)
        if found is None:
            return None
        fingerprint, path, outcome = found
        if fingerprint != job.fingerprint:
            raise CampaignError(
                f"{path}: job {job.key} was done with another configuration or version; "
                "give the options of then, or another --out"
            )
        return outcome

    def took_s(self, job: Job) -> float:
        """How long a job took its worker; 0 where it is still to do."""
        return self._took_s.get(job.key, 0.0)

    @property
    def durations_s(self) -> dict[str, list[float]]:
        """How long finished jobs took, by cell."""
        found: dict[str, list[float]] = {}
        for key, took_s in self._took_s.items():
            found.setdefault(key.rpartition(",seed=")[0], []).append(took_s)
        return found

    def add(self, job: Job, outcome: JobOutcome, took_s: float = 0.0) -> None:
        """Note a finished job and how long it took its worker, and return when it is on the disk."""
        record = {
            "key": job.key,
            "fingerprint": job.fingerprint,
            "took_s": round(took_s, 3),
            "values": plain(outcome.values),
            "arrays": _packed(outcome.arrays),
        }
        line = json.dumps(record, allow_nan=False).encode() + b"\n"
        self._file.write(line)
        self._file.flush()
        os.fsync(self._file.fileno())
        self._take(json.loads(line), Path(self._file.name))

    def _read_all(self, folder: Path) -> None:
        if not folder.is_dir():
            raise CampaignError(f"{folder}: is no directory; name one that a campaign wrote")
        for path in sorted(folder.glob(PATTERN)):
            lines = path.read_bytes().split(b"\n")
            for number, line in enumerate(lines[:-1], start=1):  # what follows the last line end is torn
                try:
                    self._take(json.loads(line), path)
                except (ValueError, KeyError, TypeError) as error:
                    raise CampaignError(f"{path}:{number}: is no finished job; remove the line") from error

    def _take(self, record: dict[str, Any], path: Path) -> None:
        outcome = JobOutcome(record["values"], _unpacked(record["arrays"]))
        self._done.setdefault(record["key"], (record["fingerprint"], path, outcome))
        self._took_s.setdefault(record["key"], float(record["took_s"]))


def _lock(file: BinaryIO) -> None:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        raise CampaignError(
            f"{file.name}: another campaign writes there; wait for it or choose another --out"
        ) from error


def _cut_torn_line(file: BinaryIO) -> None:
    """Cut what was being written when the last campaign was killed."""
    file.seek(0)
    whole = file.read()
    file.truncate(whole.rfind(b"\n") + 1)


def _packed(arrays: Arrays) -> str:
    stream = io.BytesIO()
    np.savez_compressed(stream, allow_pickle=False, **arrays)
    return base64.b64encode(stream.getvalue()).decode()


def _unpacked(text: str) -> Arrays:
    with np.load(io.BytesIO(base64.b64decode(text)), allow_pickle=False) as arrays:
        return dict(arrays)


class CampaignView:
    """Progress of a campaign."""

    def __init__(self, name: str, todo: int, kept: int, is_quiet: bool) -> None:
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


def write_results(
    study: Study, cells: Sequence[CellResult], out: Path, about: Mapping[str, Any], *, with_figures: bool
) -> dict[str, Any]:
    """Write all files of a result.

    Args:
        cells: its cells; those without a run are left out of table and figures.
        about: what else ``result.json`` says of the campaign: its wall time, jobs that are missing.

    Returns:
        What ``result.json`` holds.
    """
    rows = [plain({**cell.factors, **cell.values}) for cell in cells]
    result: dict[str, Any] = {"study": study.name, "cells": rows, **plain(about)}
    there = [cell for cell in cells if cell.values["runs"]]
    arrays = {f"{k}/{name}": array for k, cell in enumerate(cells) for name, array in cell.arrays.items()}
    np.savez_compressed(out / "result.npz", allow_pickle=False, **arrays)
    write_whole(out / "table.md", f"# {study.title}\n\n" + table([row for row in rows if row["runs"]], study.columns))
    write_whole(out / "result.json", json.dumps(result, indent=1, allow_nan=False) + "\n")
    if with_figures and there:
        study.draw(there, out)
    return result


def table(rows: Sequence[Mapping[str, Any]], columns: Sequence[Column]) -> str:
    """Cells as a Markdown table: their factors first, then the columns."""
    skipped = {"runs"}
    factors = []
    for row in rows[:1]:
        for name in row:
            if name in skipped:
                break
            factors.append(Column(name, name))
    shown = [*factors, Column("runs", "runs"), *columns]
    lines = ["| " + " | ".join(column.heading for column in shown) + " |", "|" + "---|" * len(shown)]
    lines += ["| " + " | ".join(_text(row, column) for column in shown) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def write_whole(path: Path, text: str) -> None:
    """Write a file so that a reader sees the old one or the new one, never a part."""
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    draft.write_text(text, encoding="utf-8")
    draft.replace(path)


def _text(row: Mapping[str, Any], column: Column) -> str:
    value: Any = row
    for part in column.key.split("."):
        value = value.get(part) if isinstance(value, Mapping) else None
    if value is None or value == []:
        return "-"
    if isinstance(value, list):  # an interval, or remarks
        return (" to " if column.spec else "; ").join(_number(part, column.spec) for part in value)
    return _number(value, column.spec)


def _number(value: Any, spec: str) -> str:
    return format(value, spec) if isinstance(value, int | float) and spec else str(value)
