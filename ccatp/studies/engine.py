"""Runs the jobs of a campaign on any number of workers, and combines their outcomes in the order of the plan."""

import base64
import fcntl
import gc
import io
import json
import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import timedelta
from multiprocessing import connection
from pathlib import Path
from threading import Thread
from traceback import format_exception
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from ccatp.errors import CcatpError
from ccatp.report.plots import check_drawing
from ccatp.studies import limit_threads
from ccatp.studies.campaign import (
    WHOLE,
    CampaignError,
    CampaignFailed,
    CampaignInterrupted,
    CellResult,
    ClusterUnreachable,
    Factors,
    Job,
    JobOutcome,
    Load,
    Shard,
    Study,
    cells_of,
    jobs_of,
)
from ccatp.studies.results import plain, write_results

FAILURES = "failures.txt"
CLUSTER_TIMEOUT_S = 5.0
_MOST_FAILURES = 5  # a campaign continues after fewer failures; this many indicate a general error


def settle() -> None:
    """Collect garbage, and exclude the remaining objects (modules and tables) from later collections.

    A mission creates millions of tuples and hardly a reference cycle; scanning all modules takes 3 % of its time.
    """
    gc.collect()
    gc.freeze()


# -- finished jobs ----------------------------------------------------------------------------------------------------


def make_out(out: Path) -> None:
    """Make a study's directory, before any job runs. Raises CampaignError: it cannot be made."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CampaignError(f"--out: cannot make {out}: {error.strerror or error}; choose another --out") from error


class Finished(NamedTuple):
    """A finished job, as read from a file."""

    fingerprint: str
    path: Path
    outcome: JobOutcome
    took_s: float


@contextmanager
def open_store(out: Path, shard: Shard = WHOLE, others: Iterable[Path] = ()) -> "Iterator[JobStore]":
    """The finished jobs in a directory, which is made if it does not exist.

    Each shard writes its own file. The files of all shards are read, and those in the directories ``others``. Raises
    CampaignError: ``out`` cannot be made, another campaign writes there, a directory does not exist, or a line is not a
    finished job.
    """
    make_out(out)
    path = out / ("jobs.jsonl" if shard == WHOLE else f"jobs-{shard.number}of{shard.of}.jsonl")
    with path.open("a+b") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            why = "another campaign writes there; wait for it or choose another --out"
            raise CampaignError(f"{path}: {why}") from error
        file.seek(0)
        file.truncate(file.read().rfind(b"\n") + 1)  # drops an incomplete last line of a killed campaign
        store = JobStore(file, path)
        for folder in (out, *others):
            store.read_all(folder)
        yield store


class JobStore:
    """Finished jobs, one line each, written to the disk at once, so that a killed campaign can continue."""

    def __init__(self, file: BinaryIO, path: Path) -> None:
        self._file, self._path = file, path
        self._done: dict[str, Finished] = {}

    def find(self, job: Job) -> Finished | None:
        """A finished job, or None. Raises CampaignError: it was done with another configuration or version."""
        found = self._done.get(job.key)
        if found is not None and found.fingerprint != job.fingerprint:
            raise CampaignError(
                f"{found.path}: job {job.key} was done with another configuration or version; "
                "give the options of then, or another --out"
            )
        return found

    def add(self, job: Job, outcome: JobOutcome, took_s: float = 0.0) -> None:
        """Write a finished job and its computing time, s; returns when it is on the disk."""
        stream = io.BytesIO()
        np.savez_compressed(stream, allow_pickle=False, **outcome.arrays)
        record = {
            "key": job.key,
            "fingerprint": job.fingerprint,
            "took_s": round(took_s, 3),
            "values": plain(outcome.values),
            "arrays": base64.b64encode(stream.getvalue()).decode(),
        }
        line = json.dumps(record, allow_nan=False).encode() + b"\n"
        self._file.write(line)
        self._file.flush()
        os.fsync(self._file.fileno())
        self._take(line, self._path)

    def read_all(self, folder: Path) -> None:
        """Read the jobs of all shards in a directory. Raises CampaignError: no directory, or an invalid line."""
        if not folder.is_dir():
            raise CampaignError(f"{folder}: is no directory; name one that a campaign wrote")
        for path in sorted(folder.glob("jobs*.jsonl")):
            lines = path.read_bytes().split(b"\n")
            for number, line in enumerate(lines[:-1], start=1):  # text after the last line end is incomplete
                try:
                    self._take(line, path)
                except (ValueError, KeyError, TypeError) as error:
                    raise CampaignError(f"{path}:{number}: is no finished job; remove the line") from error

    def _take(self, line: bytes, path: Path) -> None:
        record = json.loads(line)
        with np.load(io.BytesIO(base64.b64decode(record["arrays"])), allow_pickle=False) as stored:
            outcome = JobOutcome(record["values"], dict(stored))
        self._done.setdefault(record["key"], Finished(record["fingerprint"], path, outcome, float(record["took_s"])))


# -- where jobs run ---------------------------------------------------------------------------------------------------


def timed(run_job: Callable[[Job], JobOutcome], job: Job) -> tuple[JobOutcome, float]:
    """Run a job; returns its outcome and computing time, s."""
    settle()
    started_s = time.perf_counter()
    try:
        outcome = run_job(job)
    except CcatpError as error:
        plain = CcatpError(str(error))
        plain.exit_status = error.exit_status
        raise plain from error
    except Exception as error:
        raise JobError(f"{type(error).__name__}: {error}") from error
    return outcome, time.perf_counter() - started_s


class JobError(Exception):
    """Message of a job's error. An exception with other arguments cannot be unpickled, which would break the pool."""


Ended = Iterator[tuple[Job, "Future[tuple[JobOutcome, float]]"]]


@contextmanager
def _started(study: Study, jobs: Sequence[Job], workers: int | None, cluster: str | None) -> Iterator[Ended]:
    """The jobs in order of completion, run on the cluster, in this process (one worker) or in processes."""
    count = min(workers or len(os.sched_getaffinity(0)), len(jobs))
    if count == 1 and not cluster:
        yield _in_turn(study, jobs)
        return
    with _cluster(cluster) if cluster else _pool(count) as executor:
        sent = {executor.submit(timed, study.run_job, job): job for job in jobs}
        yield ((sent.pop(future), future) for future in as_completed(list(sent)))  # outcomes are large: do not keep any


def _in_turn(study: Study, jobs: Sequence[Job]) -> Ended:
    for job in jobs:
        future: Future[tuple[JobOutcome, float]] = Future()
        try:
            future.set_result(timed(study.run_job, job))
        except Exception as error:  # raised by ``future.result``, as with any executor
            future.set_exception(error)
        yield job, future


@contextmanager
def _pool(count: int) -> Iterator[Executor]:
    """Processes of this machine; on an error they are terminated, even during a job."""
    limit_threads()
    before = set(multiprocessing.active_children())
    context = multiprocessing.get_context("spawn")  # a fork would copy locks that threads hold
    executor = ProcessPoolExecutor(count, mp_context=context, initializer=prepare_worker)
    try:
        yield executor
    except BaseException:
        executor.shutdown(wait=False, cancel_futures=True)
        for child in set(multiprocessing.active_children()) - before:
            child.terminate()
        raise
    finally:
        executor.shutdown(wait=True)


def prepare_worker() -> None:
    """Ignore Ctrl-C, which the parent handles, and exit when the parent ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if (parent := multiprocessing.parent_process()) is not None:
        Thread(target=lambda: (connection.wait([parent.sentinel]), os._exit(1)), daemon=True).start()


@contextmanager
def _cluster(address: str) -> Iterator[Executor]:
    try:
        from distributed import Client  # noqa: PLC0415 - belongs to an extra
    except ImportError as error:
        raise CampaignError("--cluster needs distributed: install ccatp[cluster]") from error
    try:
        client = Client(address, timeout=CLUSTER_TIMEOUT_S, set_as_default=False)  # type: ignore[no-untyped-call]
    except (OSError, ValueError) as error:
        raise ClusterUnreachable(
            f"--cluster {address}: no scheduler answers there ({error}); start one, or correct the address"
        ) from error
    with client:
        executor = client.get_executor(pure=False)  # type: ignore[no-untyped-call]
        try:
            yield executor
        finally:
            executor.shutdown(wait=False)


# -- campaigns --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class CampaignOptions:
    """Options of a campaign."""

    out: Path
    runs: int | None = None  # seeds of each cell; None: the study's number
    workers: int | None = None  # processes; None: one for each core
    cluster: str | None = None
    shard: Shard = WHOLE
    others: tuple[Path, ...] = ()  # directories whose finished jobs are used
    mirrors: tuple[str, ...] = ()
    only: Mapping[str, Sequence[str]] = field(default_factory=dict)
    settings: Mapping[str, object] = field(default_factory=dict)
    with_figures: bool = True


def run_campaign(study: Study, load: Load, options: CampaignOptions) -> dict[str, Any]:
    """Run the jobs of a campaign that are not finished, and write its results; returns the contents of ``result.json``.

    ``missing`` in the result: number of jobs of other shards that are not finished. Raises CampaignError (it cannot be
    run as requested), CampaignFailed (jobs failed, a worker died, the directory cannot be written), CampaignInterrupted
    (Ctrl-C), ClusterUnreachable, ConfigError; finished jobs are kept.
    """
    try:
        return _run(study, load, options)
    except KeyboardInterrupt as error:
        raise CampaignInterrupted(
            f"interrupted; what is done is kept in {options.out}: the same command continues from there"
        ) from error
    except OSError as error:
        raise CampaignFailed(
            f"{error.filename or options.out}: {error.strerror or error}; "
            "make room or choose another --out: what is done is kept"
        ) from error


def _run(study: Study, load: Load, options: CampaignOptions) -> dict[str, Any]:
    started_s = time.perf_counter()
    cells = cells_of(study, options.mirrors, options.only)
    plan = jobs_of(study, cells, load, options.settings, study.runs if options.runs is None else options.runs)
    jobs = [job for group in plan for job in group]
    console = Console(stderr=True, highlight=False)
    if options.with_figures:
        make_out(options.out)
        check_drawing(options.out)
    with open_store(options.out, options.shard, options.others) as store:
        done = {job.key for job in jobs if store.find(job) is not None}
        todo = [job for job in jobs[options.shard.number - 1 :: options.shard.of] if job.key not in done]
        todo.sort(key=lambda job: job.seed)  # one job of each cell first
        _print(console, study, f"{len(todo)} jobs to do" + (f", {len(done)} done before" if done else ""))
        failures = _run_jobs(study, todo, store, console, options) if todo else []
        found = [[one for job in group if (one := store.find(job)) is not None] for group in plan]
    parts = zip(cells, found, strict=True)
    results = [cell_result(study, cell.factors, [one.outcome for one in there]) for cell, there in parts]
    missing = len(jobs) - sum(map(len, found))
    about: dict[str, Any] = {
        "wall_s": round(time.perf_counter() - started_s, 3),
        "work_s": round(sum(one.took_s for there in found for one in there), 3),
        "settings": dict(options.settings),
        **({"missing": missing} if missing else {}),
    }
    result = write_results(study, results, options.out, about, with_figures=options.with_figures)
    if failures:
        raise CampaignFailed(
            f"{len(failures)} of {len(todo)} jobs failed, the first: {failures[0]}; see {options.out / FAILURES}; "
            "the results are those of the others: the same command tries again"
        )
    others = f"the other shards, or the same command without --shard, do the {missing} that are missing"
    text = f"{len(jobs) - missing} of {len(jobs)} jobs are done; {others}"
    _print(console, study, text if missing else f"all {len(jobs)} jobs are done; results are in {options.out}")
    return result


def cell_result(study: Study, factors: Factors, outcomes: Sequence[JobOutcome]) -> CellResult:
    """Combined outcomes of a cell, with its published values."""
    values, arrays = study.combine(factors, outcomes) if outcomes else JobOutcome({})
    printed = {"printed": study.published(factors)} if study.published and outcomes else {}
    return CellResult(factors, {"runs": len(outcomes), **values, **printed}, arrays)


def _print(console: Console, study: Study, text: str) -> None:
    console.print(f"ccatp: study {study.name}: {text}", markup=False, soft_wrap=True)


def _run_jobs(
    study: Study, jobs: Sequence[Job], store: JobStore, console: Console, options: CampaignOptions
) -> list[str]:
    """Run the jobs; returns a line for each that failed.

    Shows a progress bar on a terminal, otherwise a line for each tenth of the jobs.
    """
    failures: list[str] = []
    began_s, total = time.monotonic(), len(jobs)
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    progress = Progress(*columns, TimeRemainingColumn(), console=console, disable=not console.is_terminal)
    with _started(study, jobs, options.workers, options.cluster) as finished, progress:
        task = progress.add_task(f"study {study.name}", total=total)
        for count, (job, future) in enumerate(finished, start=1):
            try:
                outcome, took_s = future.result()
            except (BrokenExecutor, CancelledError) as error:
                what, how = "a worker died, perhaps for want of memory", "the same options, or with fewer --workers"
                if isinstance(error, CancelledError):
                    what, how = "the cluster has given up a job, perhaps its scheduler ended", "the same options"
                raise CampaignFailed(
                    f"{what}; what is done is kept in {options.out}: start again with {how}"
                ) from error
            except CcatpError:
                raise
            except Exception as error:  # after an error of one job the others continue
                what = str(error) if isinstance(error, JobError) else f"{type(error).__name__}: {error}"
                failures.append(f"{job.key}: {what}")
                with (options.out / FAILURES).open("a", encoding="utf-8") as file:
                    file.write(f"{job.key}\n{''.join(format_exception(error))}\n")
                if len(failures) == _MOST_FAILURES:
                    raise CampaignFailed(
                        f"{_MOST_FAILURES} jobs failed, the last: {failures[-1]}; see {options.out / FAILURES}; "
                        f"what is done is kept in {options.out}"
                    ) from error
            else:
                store.add(job, outcome, took_s)
            progress.update(task, completed=count)
            if not console.is_terminal and 10 * count // total > 10 * (count - 1) // total:
                left = timedelta(seconds=round((time.monotonic() - began_s) / count * (total - count)))
                _print(
                    console, study, f"{count} of {total} jobs ({100 * count // total} %), {left} left; last {job.key}"
                )
    return failures
