"""Runs the jobs of a campaign and puts their outcomes together in the order of the plan, whoever worked on them."""

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
_MOST_FAILURES = 5  # one bad seed must not cost a night; what fails this often is wrong everywhere


def settle() -> None:
    """Collect garbage, and exempt what is left: modules and tables stay to the end.

    A mission makes tuples by the million and hardly a cycle; going through all modules for them costs 3 % of its time.
    """
    gc.collect()
    gc.freeze()


# -- finished jobs ----------------------------------------------------------------------------------------------------


def make_out(out: Path) -> None:
    """Make a study's directory, before any work (raises CampaignError: it cannot be made)."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CampaignError(f"--out: cannot make {out}: {error.strerror or error}; choose another --out") from error


class Finished(NamedTuple):
    """A finished job, as a file has it."""

    fingerprint: str
    path: Path
    outcome: JobOutcome
    took_s: float


@contextmanager
def open_store(out: Path, shard: Shard = WHOLE, others: Iterable[Path] = ()) -> "Iterator[JobStore]":
    """The finished jobs in a directory, which is made if it is not there.

    Each shard writes a file of its own; all of them are read, and those in ``others`` are taken over. CampaignError:
    ``out`` cannot be made, another campaign writes here, a directory does not exist, or a line is not a finished job.
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
        file.truncate(file.read().rfind(b"\n") + 1)  # what was being written at the last kill
        store = JobStore(file, path)
        for folder in (out, *others):
            store.read_all(folder)
        yield store


class JobStore:
    """Finished jobs: one line each, safe on the disk before the next begins, so that a killed campaign continues."""

    def __init__(self, file: BinaryIO, path: Path) -> None:
        self._file, self._path = file, path
        self._done: dict[str, Finished] = {}

    def find(self, job: Job) -> Finished | None:
        """A finished job, None where it is to do (raises CampaignError: done under other circumstances)."""
        found = self._done.get(job.key)
        if found is not None and found.fingerprint != job.fingerprint:
            raise CampaignError(
                f"{found.path}: job {job.key} was done with another configuration or version; "
                "give the options of then, or another --out"
            )
        return found

    def add(self, job: Job, outcome: JobOutcome, took_s: float = 0.0) -> None:
        """Keep a finished job and its working time; returns when it is on the disk."""
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
        """The jobs of all shards in a directory."""
        if not folder.is_dir():
            raise CampaignError(f"{folder}: is no directory; name one that a campaign wrote")
        for path in sorted(folder.glob("jobs*.jsonl")):
            lines = path.read_bytes().split(b"\n")
            for number, line in enumerate(lines[:-1], start=1):  # what follows the last line end is torn
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
    """Do a job; its outcome and working time, s."""
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
    """What a job died of, by its message: an error with arguments of its own would end the pool as it arrives."""


Ended = Iterator[tuple[Job, "Future[tuple[JobOutcome, float]]"]]


@contextmanager
def _started(study: Study, jobs: Sequence[Job], workers: int | None, cluster: str | None) -> Iterator[Ended]:
    """The jobs as they are finished: on the cluster, in this process (one worker), or in processes of this machine."""
    count = min(workers or len(os.sched_getaffinity(0)), len(jobs))
    if count == 1 and not cluster:
        yield _in_turn(study, jobs)
        return
    with _cluster(cluster) if cluster else _pool(count) as executor:
        sent = {executor.submit(timed, study.run_job, job): job for job in jobs}
        yield ((sent.pop(future), future) for future in as_completed(list(sent)))  # outcomes are large: none is kept


def _in_turn(study: Study, jobs: Sequence[Job]) -> Ended:
    for job in jobs:
        future: Future[tuple[JobOutcome, float]] = Future()
        try:
            future.set_result(timed(study.run_job, job))
        except Exception as error:  # raised when the result is taken, as by any executor
            future.set_exception(error)
        yield job, future


@contextmanager
def _pool(count: int) -> Iterator[Executor]:
    """Processes of this machine; on an error they are ended in the middle of their jobs."""
    limit_threads()
    before = set(multiprocessing.active_children())
    context = multiprocessing.get_context("spawn")  # a fork would inherit threads and locks in any state
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
    """Leave Ctrl-C to the parent, and end with it however it ends."""
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
    """How a campaign is run."""

    out: Path
    runs: int | None = None  # seeds of each cell; else the study's
    workers: int | None = None  # processes; else one for each core
    cluster: str | None = None
    shard: Shard = WHOLE
    others: tuple[Path, ...] = ()  # directories whose finished jobs are taken over
    mirrors: tuple[str, ...] = ()
    only: Mapping[str, Sequence[str]] = field(default_factory=dict)
    settings: Mapping[str, object] = field(default_factory=dict)
    with_figures: bool = True


def run_campaign(study: Study, load: Load, options: CampaignOptions) -> dict[str, Any]:
    """Do what is left of a campaign and write its results; what ``result.json`` holds.

    While jobs of other shards are missing it says how many, in ``missing``. Raises CampaignError (it cannot be run as
    asked), CampaignFailed (jobs failed, a worker died, the directory cannot be written), CampaignInterrupted (Ctrl-C),
    ClusterUnreachable, ConfigError; what is done is kept.
    """
    try:
        return _run(study, load, options)
    except KeyboardInterrupt as error:
        raise CampaignInterrupted(
            f"interrupted; what is done is kept in {options.out}: the same command goes on from there"
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
    """The jobs of a cell together, and what was published of it."""
    values, arrays = study.combine(factors, outcomes) if outcomes else JobOutcome({})
    printed = {"printed": study.published(factors)} if study.published and outcomes else {}
    return CellResult(factors, {"runs": len(outcomes), **values, **printed}, arrays)


def _print(console: Console, study: Study, text: str) -> None:
    console.print(f"ccatp: study {study.name}: {text}", markup=False, soft_wrap=True)


def _run_jobs(
    study: Study, jobs: Sequence[Job], store: JobStore, console: Console, options: CampaignOptions
) -> list[str]:
    """Do the jobs; a line for each that failed. Shows a bar on a terminal, a line for each tenth elsewhere."""
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
            except Exception as error:  # whatever a mission dies of, the others go on
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
