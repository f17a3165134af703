"""Glue. Runs the jobs of a campaign wherever there is room, and puts their outcomes together.

The outcome of a job does not depend on where or when it runs, and outcomes are combined in the order of the plan: the
cells are the same whatever the number of workers.
"""

import time
from collections.abc import Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Future, wait
from dataclasses import dataclass, field
from pathlib import Path
from traceback import format_exception
from typing import Any

from ccatp.errors import CcatpError
from ccatp.studies.campaign import CampaignFailed, CampaignInterrupted, CellResult, Job, Load, Outcome, Study
from ccatp.studies.executors import Place, Timed, place_of, timed
from ccatp.studies.ledger import Ledger
from ccatp.studies.plan import WHOLE, Shard, cells_of, jobs_of
from ccatp.studies.progress import CampaignView
from ccatp.studies.results import write_results
from ccatp.studies.schedule import Schedule

# One bad seed must not cost a night; what fails this often is wrong everywhere.
_MOST_FAILURES = 5
FAILURES = "failures.txt"


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
    with Ledger(options.out, options.shard, options.others) as ledger:
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


def _cell(study: Study, jobs: Sequence[Job], outcomes: Sequence[Outcome | None]) -> CellResult:
    there = [outcome for outcome in outcomes if outcome is not None]
    values, arrays = study.combine(jobs[0].factors, there) if there else Outcome({})
    return CellResult(jobs[0].factors, {"runs": len(there), **values}, arrays)


def _run_jobs(
    study: Study, jobs: Sequence[Job], ledger: Ledger, view: CampaignView, options: CampaignOptions
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


def _hand_out(study: Study, schedule: Schedule, place: Place, under_way: dict[Future[Timed], Job]) -> None:
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
