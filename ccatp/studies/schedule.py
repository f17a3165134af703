"""Pure. Which job next: one of each cell to begin with, then what takes longest first, so that no worker waits long."""

from collections import deque
from collections.abc import Iterable, Mapping, Sequence

from ccatp.studies.campaign import Job


class Schedule:
    """The jobs that are still to be handed out.

    Missions of one cell take about equally long, cells differ: a robot with the thesis's gains takes four times as
    long. Handing out what is longest first keeps the end short, when some workers have nothing left to do (Graham
    1969: at most a third longer than the best plan).

    Args:
        jobs: to do, in the order of the plan.
        past_s: durations of finished jobs by cell, from earlier parts of the campaign.
    """

    def __init__(self, jobs: Iterable[Job], past_s: Mapping[str, Sequence[float]]) -> None:
        self._queues: dict[str, deque[Job]] = {}
        for job in jobs:
            self._queues.setdefault(job.cell, deque()).append(job)
        self._taken: dict[str, list[float]] = {cell: list(past_s.get(cell, ())) for cell in self._queues}
        self._is_tried = {cell for cell, durations in self._taken.items() if durations}
        self._left = {cell: len(queue) for cell, queue in self._queues.items()}
        self.done_s = 0.0

    def __bool__(self) -> bool:
        """Whether a job is still to be handed out."""
        return any(self._queues.values())

    def take(self) -> Job:
        """The next job.

        Raises:
            IndexError: all are handed out.
        """
        waiting = [cell for cell, queue in self._queues.items() if queue]
        if not waiting:
            raise IndexError("all jobs are handed out")
        cell = next((c for c in waiting if c not in self._is_tried), None) or max(waiting, key=self._expected_s)
        self._is_tried.add(cell)
        return self._queues[cell].popleft()

    def done(self, job: Job, took_s: float) -> None:
        """A job has come back after so much time of its worker."""
        self._taken[job.cell].append(took_s)
        self._left[job.cell] -= 1
        self.done_s += took_s

    @property
    def left_s(self) -> float:
        """Time of workers that the jobs not yet back will take, as far as is known."""
        return sum(count * self._expected_s(cell) for cell, count in self._left.items())

    def _expected_s(self, cell: str) -> float:
        taken = self._taken[cell] or [duration for durations in self._taken.values() for duration in durations]
        return sum(taken) / len(taken) if taken else 0.0
