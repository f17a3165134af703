"""Glue. Runs the jobs of a campaign on whatever executor there is, and puts their outcomes together.

The outcome of a job does not depend on where or when it runs, and outcomes are combined in the order of the plan: the
cells are the same whatever the number of workers.
"""

import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing.connection import wait
from pathlib import Path
from threading import Thread
from typing import Any

from ccatp.errors import CcatpError
from ccatp.studies.campaign import CampaignError, CellResult, Job, Load, Outcome, Study
from ccatp.studies.ledger import Ledger
from ccatp.studies.plan import WHOLE, Shard, cells_of, jobs_of
from ccatp.studies.progress import CampaignView
from ccatp.studies.results import write_results
from ccatp.studies.threads import limit_threads

_CLUSTER_TIMEOUT_S = 20.0


@dataclass(frozen=True, slots=True)
class CampaignOptions:
    """How a campaign is run.

    Attributes:
        out: directory of ledger and results.
        runs: seeds of each cell; None takes the study's.
        workers: processes; None takes one for each core.
        cluster: address of a scheduler, in place of processes here.
        shard: part of the jobs.
        others: directories whose finished jobs are taken over.
        mirrors, only: see ``cells_of``.
        settings: dotted keys of the command line.
        with_figures: draw.
        is_quiet: no progress.
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
        CampaignError: the campaign cannot be run as asked, a job failed, or a worker died; what is done is kept.
        ConfigError: a configuration cannot be used.
    """
    started_s = time.perf_counter()
    cells = cells_of(study, options.mirrors, options.only)
    plan = jobs_of(study, cells, load, options.settings, study.runs if options.runs is None else options.runs)
    with Ledger(options.out, options.shard, options.others) as ledger:
        jobs = [job for group in plan for job in group]
        left = [job for job in jobs if ledger.outcome(job) is None]
        own = set(range(options.shard.number - 1, len(jobs), options.shard.of))
        todo = [job for index, job in enumerate(jobs) if index in own and ledger.outcome(job) is None]
        with CampaignView(study.name, len(todo), len(jobs) - len(left), options.is_quiet) as view:
            _run_jobs(study, todo, ledger, view, options)
        found = [[ledger.outcome(job) for job in group] for group in plan]
    results = [_cell(study, group, outcomes) for group, outcomes in zip(plan, found, strict=True)]
    missing = sum(outcome is None for outcomes in found for outcome in outcomes)
    view.end(missing, len(jobs), options.out)
    wall_s = time.perf_counter() - started_s
    return write_results(study, results, options.out, wall_s, missing, with_figures=options.with_figures)


def _cell(study: Study, jobs: Sequence[Job], outcomes: Sequence[Outcome | None]) -> CellResult:
    there = [outcome for outcome in outcomes if outcome is not None]
    values, arrays = study.combine(jobs[0].factors, there) if there else Outcome({})
    return CellResult(jobs[0].factors, {"runs": len(there), **values}, arrays)


def _run_jobs(study: Study, jobs: Sequence[Job], ledger: Ledger, view: CampaignView, options: CampaignOptions) -> None:
    if not jobs:
        return
    if options.cluster is None and options.workers == 1:
        for job in jobs:
            _note(job, lambda job=job: study.run_job(job), ledger, view, options.out)  # type: ignore[misc]
        return
    with _executor(options, len(jobs)) as executor:
        futures: dict[Future[Outcome], Job] = {executor.submit(study.run_job, job): job for job in jobs}
        for future in as_completed(futures):
            _note(futures[future], future.result, ledger, view, options.out)


def _note(job: Job, result: Callable[[], Outcome], ledger: Ledger, view: CampaignView, out: Path) -> None:
    try:
        outcome = result()
    except BrokenExecutor as error:
        raise CampaignError(
            f"a worker died, perhaps for want of memory; what is done is kept in {out}: "
            "start again with the same options, or with fewer --workers"
        ) from error
    except CcatpError:
        raise
    except Exception as error:
        raise CampaignError(
            f"job {job.key} failed: {type(error).__name__}: {error}; what is done is kept in {out}"
        ) from error
    ledger.add(job, outcome)
    view.done(job.key)


@contextmanager
def _executor(options: CampaignOptions, jobs: int) -> Iterator[Executor]:
    with _cluster(options.cluster) if options.cluster else _pool(options.workers, jobs) as executor:
        yield executor


@contextmanager
def _pool(workers: int | None, jobs: int) -> Iterator[Executor]:
    """Processes of this machine; on an error they are ended in the middle of their jobs."""
    count = min(workers or len(os.sched_getaffinity(0)), jobs)
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
    parent = multiprocessing.parent_process()
    if parent is not None:
        Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()


def _end_with(sentinel: int) -> None:
    wait([sentinel])
    os._exit(1)


@contextmanager
def _cluster(address: str) -> Iterator[Executor]:
    try:
        from distributed import Client  # noqa: PLC0415 - belongs to an extra
    except ImportError as error:
        raise CampaignError("--cluster needs distributed: install ccatp[cluster]") from error
    try:
        client = Client(address, timeout=_CLUSTER_TIMEOUT_S, set_as_default=False)  # type: ignore[no-untyped-call]
    except (OSError, ValueError) as error:
        raise CampaignError(
            f"--cluster {address}: no scheduler answers there ({error}); start one, or correct the address"
        ) from error
    with client:
        executor = client.get_executor(pure=False)  # type: ignore[no-untyped-call]
        try:
            yield executor
        finally:
            executor.shutdown(wait=False, cancel_futures=True)
