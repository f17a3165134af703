"""Runs the jobs of a campaign wherever there is room, and puts their outcomes together.

The outcome of a job does not depend on where or when it runs, and outcomes are combined in the order of the plan: the
cells are the same whatever the number of workers.

The collector of garbage, kept from what will never be garbage.

One thread for the linear algebra: on matrices this small more of them cost time, and fight the workers.

Where jobs run: in this process, in processes of this machine, or on a cluster.
"""

import gc
import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing import connection
from pathlib import Path
from threading import Thread
from traceback import format_exception
from typing import Any, NamedTuple

from ccatp.errors import CcatpError
from ccatp.studies.campaign import (
    WHOLE,
    CampaignError,
    CampaignFailed,
    CampaignInterrupted,
    CellResult,
    ClusterUnreachable,
    Job,
    JobOutcome,
    Load,
    Schedule,
    Shard,
    Study,
    cells_of,
    jobs_of,
)
from ccatp.studies.job_store import CampaignView, JobStore, write_results


def settle() -> None:
    """Collect what is garbage now, and look no more at what is not: modules and tables stay to the end.

    A mission makes tuples by the million and hardly a cycle; going through everything imported again and again for
    them costs it 3 % of its time.
    """
    gc.collect()
    gc.freeze()


VARIABLES = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def limit_threads() -> None:
    """Ask for one thread, for this process and its children. Has an effect only before numpy is imported."""
    for name in VARIABLES:
        os.environ.setdefault(name, "1")


_CLUSTER_TIMEOUT_S = 5.0


class Timed(NamedTuple):
    """What came of a job, and how long it took its worker."""

    outcome: JobOutcome
    took_s: float


class JobExecutor(NamedTuple):
    """Where jobs are sent.

    Attributes:
        room: how many it can have at a time; on a cluster workers come and go.
    """

    executor: Executor
    room: Callable[[], int]


class _SerialExecutor(Executor):
    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:  # it belongs to whoever asks for the result, as in any executor
            future.set_exception(error)
        return future


def timed(run_job: Callable[[Job], JobOutcome], job: Job) -> Timed:
    """Do a job."""
    settle()
    started_s = time.perf_counter()
    outcome = run_job(job)
    return Timed(outcome, time.perf_counter() - started_s)


@contextmanager
def place_of(workers: int | None, cluster: str | None, jobs: int) -> Iterator[JobExecutor]:
    """Where to run so many jobs.

    Args:
        workers: processes; None takes one for each core. One is this process.
        jobs: there are; more workers would idle.

    Raises:
        CampaignError: the cluster's client is not installed.
        ClusterUnreachable: no scheduler answers.
    """
    count = min(workers or len(os.sched_getaffinity(0)), jobs)
    if cluster:
        with _cluster(cluster) as place:
            yield place
    elif count == 1:
        yield JobExecutor(_SerialExecutor(), lambda: 1)
    else:
        with _pool(count) as place:
            yield place


@contextmanager
def _pool(count: int) -> Iterator[JobExecutor]:
    """Processes of this machine; on an error they are ended in the middle of their jobs."""
    limit_threads()
    before = set(multiprocessing.active_children())
    context = multiprocessing.get_context("spawn")  # a fork would inherit threads and locks in any state
    executor = ProcessPoolExecutor(count, mp_context=context, initializer=prepare_worker)
    try:
        yield JobExecutor(executor, lambda: count + 1)  # one more waits, so that no worker does
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
    parent = multiprocessing.parent_process()
    if parent is not None:
        Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()


def _end_with(sentinel: int) -> None:
    connection.wait([sentinel])
    os._exit(1)


@contextmanager
def _cluster(address: str) -> Iterator[JobExecutor]:
    try:
        from distributed import Client  # noqa: PLC0415 - belongs to an extra
    except ImportError as error:
        raise CampaignError("--cluster needs distributed: install ccatp[cluster]") from error
    try:
        client = Client(address, timeout=_CLUSTER_TIMEOUT_S, set_as_default=False)  # type: ignore[no-untyped-call]
    except (OSError, ValueError) as error:
        raise ClusterUnreachable(
            f"--cluster {address}: no scheduler answers there ({error}); start one, or correct the address"
        ) from error
    with client:
        executor = client.get_executor(pure=False)  # type: ignore[no-untyped-call]
        try:
            yield JobExecutor(executor, lambda: 2 * max(1, sum(client.nthreads().values())))  # type: ignore[no-untyped-call]
        finally:
            executor.shutdown(wait=False)


# One bad seed must not cost a night; what fails this often is wrong everywhere.
_MOST_FAILURES = 5
FAILURES = "failures.txt"


@dataclass(frozen=True, slots=True)
class CampaignOptions:
    """How a campaign is run.

    Attributes:
        runs: seeds of each cell; None takes the study's.
        workers: processes; None takes one for each core.
        others: directories whose finished jobs are taken over.
        mirrors, only: see ``cells_of``.
    """

    out: Path
    runs: int | None = None
    workers: int | None = None
    cluster: str | None = None
    shard: Shard = WHOLE
    others: tuple[Path, ...] = ()
    mirrors: tuple[str, ...] = ()
    only: Mapping[str, Sequence[str]] = field(default_factory=dict)
    settings: Mapping[str, object] = field(default_factory=dict)
    with_figures: bool = True
    is_quiet: bool = False


def run_campaign(study: Study, load: Load, options: CampaignOptions) -> dict[str, Any]:
    """Do what is left of a campaign and write its results.

    Returns:
        What ``result.json`` holds. While jobs of other shards are missing it says how many, in ``missing``.

    Raises:
        CampaignError: the campaign cannot be run as asked.
        CampaignFailed: jobs failed, a worker died, or the directory cannot be written; what is done is kept.
        CampaignInterrupted: Ctrl-C; what is done is kept.
        ClusterUnreachable: no scheduler answers.
        ConfigError: a configuration cannot be used.
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
    with JobStore(options.out, options.shard, options.others) as ledger:
        jobs = [job for group in plan for job in group]
        own = set(range(options.shard.number - 1, len(jobs), options.shard.of))
        done = {job.key for job in jobs if ledger.outcome(job) is not None}
        todo = [job for index, job in enumerate(jobs) if index in own and job.key not in done]
        with CampaignView(study.name, len(todo), len(done), options.is_quiet) as view:
            failures = _run_jobs(study, todo, ledger, view, options) if todo else []
        found = [[ledger.outcome(job) for job in group] for group in plan]
        work_s = sum(ledger.took_s(job) for job in jobs)
    results = [_cell(study, group, outcomes) for group, outcomes in zip(plan, found, strict=True)]
    missing = sum(outcome is None for outcomes in found for outcome in outcomes)
    about: dict[str, Any] = {
        "wall_s": round(time.perf_counter() - started_s, 3),
        "work_s": round(work_s, 3),
        "settings": dict(options.settings),
        **({"missing": missing} if missing else {}),
    }
    result = write_results(study, results, options.out, about, with_figures=options.with_figures)
    if failures:
        raise CampaignFailed(
            f"{len(failures)} of {len(todo)} jobs failed, the first: {failures[0]}; see {options.out / FAILURES}; "
            "the results are those of the others: the same command tries again"
        )
    view.end(missing, len(jobs), options.out)
    return result


def _cell(study: Study, jobs: Sequence[Job], outcomes: Sequence[JobOutcome | None]) -> CellResult:
    there = [outcome for outcome in outcomes if outcome is not None]
    values, arrays = study.combine(jobs[0].factors, there) if there else JobOutcome({})
    return CellResult(jobs[0].factors, {"runs": len(there), **values}, arrays)


def _run_jobs(
    study: Study, jobs: Sequence[Job], ledger: JobStore, view: CampaignView, options: CampaignOptions
) -> list[str]:
    """Do the jobs; what failed is told, a line each."""
    schedule = Schedule(jobs, ledger.durations_s)
    failures: list[str] = []
    with place_of(options.workers, options.cluster, len(jobs)) as place:
        under_way: dict[Future[Timed], Job] = {}
        while schedule or under_way:
            _hand_out(study, schedule, place, under_way)
            for future in wait(under_way, return_when=FIRST_COMPLETED).done:
                job = under_way.pop(future)
                try:
                    outcome, took_s = _result(future, options.out)
                except CcatpError:
                    raise
                except Exception as error:  # whatever a mission dies of, the others go on
                    failures.append(_noted(job, error, options.out))
                    if len(failures) == _MOST_FAILURES:
                        raise CampaignFailed(
                            f"{_MOST_FAILURES} jobs failed, the last: {failures[-1]}; see {options.out / FAILURES}; "
                            f"what is done is kept in {options.out}"
                        ) from error
                    continue
                ledger.add(job, outcome, took_s)
                schedule.done(job, took_s)
                view.done(job.key, schedule.done_s, schedule.left_s)
    return failures


def _hand_out(study: Study, schedule: Schedule, place: JobExecutor, under_way: dict[Future[Timed], Job]) -> None:
    room = place.room()
    while schedule and len(under_way) < room:
        job = schedule.take()
        under_way[place.executor.submit(timed, study.run_job, job)] = job


def _result(future: Future[Timed], out: Path) -> Timed:
    try:
        return future.result()
    except BrokenExecutor as error:
        raise CampaignFailed(
            f"a worker died, perhaps for want of memory; what is done is kept in {out}: "
            "start again with the same options, or with fewer --workers"
        ) from error
    except CancelledError as error:
        raise CampaignFailed(
            f"the cluster has given up a job, perhaps its scheduler ended; what is done is kept in {out}: "
            "start again with the same options"
        ) from error


def _noted(job: Job, error: BaseException, out: Path) -> str:
    with (out / FAILURES).open("a", encoding="utf-8") as file:
        file.write(f"{job.key}\n{''.join(format_exception(error))}\n")
    return f"{job.key}: {type(error).__name__}: {error}"
