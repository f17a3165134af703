"""Edge. Where jobs run: in this process, in processes of this machine, or on a cluster."""

import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import connection
from threading import Thread
from typing import Any, NamedTuple

from ccatp.studies.campaign import CampaignError, ClusterUnreachable, Job, Outcome
from ccatp.studies.garbage import settle
from ccatp.studies.threads import limit_threads

_CLUSTER_TIMEOUT_S = 5.0


class Timed(NamedTuple):
    """What came of a job, and how long it took its worker."""

    outcome: Outcome
    took_s: float


class Place(NamedTuple):
    """Where jobs are sent.

    Attributes:
        executor: takes them.
        room: how many it can have at a time; on a cluster workers come and go.
    """

    executor: Executor
    room: Callable[[], int]


class _Here(Executor):
    """Runs each job at once, in this process."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Run it; Ctrl-C gets through."""
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:  # it belongs to whoever asks for the result, as in any executor
            future.set_exception(error)
        return future


def timed(run_job: Callable[[Job], Outcome], job: Job) -> Timed:
    """Do a job."""
    settle()
    started_s = time.perf_counter()
    outcome = run_job(job)
    return Timed(outcome, time.perf_counter() - started_s)


@contextmanager
def place_of(workers: int | None, cluster: str | None, jobs: int) -> Iterator[Place]:
    """Where to run so many jobs.

    Args:
        workers: processes; None takes one for each core. One is this process.
        cluster: address of a scheduler, instead.
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
        yield Place(_Here(), lambda: 1)
    else:
        with _pool(count) as place:
            yield place


@contextmanager
def _pool(count: int) -> Iterator[Place]:
    """Processes of this machine; on an error they are ended in the middle of their jobs."""
    limit_threads()
    before = set(multiprocessing.active_children())
    context = multiprocessing.get_context("spawn")  # a fork would inherit threads and locks in any state
    executor = ProcessPoolExecutor(count, mp_context=context, initializer=prepare_worker)
    try:
        yield Place(executor, lambda: count + 1)  # one more waits, so that no worker does
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
def _cluster(address: str) -> Iterator[Place]:
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
            yield Place(executor, lambda: 2 * max(1, sum(client.nthreads().values())))  # type: ignore[no-untyped-call]
        finally:
            executor.shutdown(wait=False)
