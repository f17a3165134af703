"""What a campaign is: cells of factors, crossed with seeds into jobs that can run anywhere in any order.

The plan of a campaign: which cells, which seeds, whose share of the jobs.

Which job next: one of each cell to begin with, then what takes longest first, so that no worker waits long.

The spread of many non-negative numbers in little room: histograms that add up over jobs.

A mission has half a million localization errors; a campaign pools hundreds of missions. Bins are 1/1000 of a decade
wide, so a quantile is right to 0.12 %; count, mean, maximum and the share within the limit are exact.
"""

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from hashlib import sha256
from json import dumps
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import ccatp
from ccatp.config.beacon_models import RadioConfig
from ccatp.config.models import Config
from ccatp.core import FloatArray, IntArray
from ccatp.errors import CcatpError, ExitStatus

Factor = str | int | float | bool
Factors = Mapping[str, Factor]
Arrays = Mapping[str, NDArray[Any]]
AnyConfig = Config | RadioConfig
Load = Callable[[Mapping[str, object]], AnyConfig]
"""Dotted keys, stronger than the configuration file, to a configuration."""


class CampaignError(CcatpError):
    """A campaign that cannot be run as asked; what was done before is kept."""

    exit_status = ExitStatus.USAGE


class CampaignFailed(CampaignError):
    """Jobs failed, a worker died, or the results cannot be written; what was done is kept."""

    exit_status = ExitStatus.HELD


class CampaignInterrupted(CampaignError):
    """The user stopped it; what was done is kept."""

    exit_status = ExitStatus.INTERRUPTED


class ClusterUnreachable(CampaignError):
    """No scheduler answers."""

    exit_status = ExitStatus.UNREACHABLE


@dataclass(frozen=True, slots=True)
class Cell:
    """One combination of factors.

    Attributes:
        factors: as they stand in the cell of ``result.json``.
    """

    factors: Factors
    overrides: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Job:
    """All that a worker is given. What comes of it is a function of these four and nothing else."""

    study: str
    factors: Factors
    seed: int
    whole: AnyConfig

    @property
    def cfg(self) -> Config:
        """The configuration of a job on a mirror.

        Raises:
            TypeError: the job is one among radio beacons.
        """
        if not isinstance(self.whole, Config):
            raise TypeError(f"job {self.key} has no mirror; take its radio configuration")
        return self.whole

    @property
    def radio(self) -> RadioConfig:
        """The configuration of a job among radio beacons.

        Raises:
            TypeError: the job is one on a mirror.
        """
        if not isinstance(self.whole, RadioConfig):
            raise TypeError(f"job {self.key} is one on a mirror; take its mission's configuration")
        return self.whole

    @property
    def cell(self) -> str:
        """``world=hard,filter=ekf``."""
        return ",".join(f"{name}={value}" for name, value in self.factors.items())

    @property
    def key(self) -> str:
        """``world=hard,filter=ekf,seed=3``."""
        return f"{self.cell},seed={self.seed}"

    @property
    def fingerprint(self) -> str:
        """Of everything that the outcome depends on, this program's version included."""
        whole = [ccatp.__version__, self.study, dict(self.factors), self.seed, self.whole.model_dump(mode="json")]
        return sha256(dumps(whole, sort_keys=True).encode()).hexdigest()[:16]


class JobOutcome(NamedTuple):
    """What comes of a job, or of all jobs of a cell.

    Attributes:
        values: what JSON can say; numbers that are not finite become null.
    """

    values: Mapping[str, Any]
    arrays: Arrays = MappingProxyType({})


class CellResult(NamedTuple):
    """One cell of the result: its factors, runs and figures, and its arrays."""

    factors: Factors
    values: Mapping[str, Any]
    arrays: Arrays


class Column(NamedTuple):
    """A column of ``table.md``.

    Attributes:
        heading: with unit.
        spec: format of numbers; empty leaves the value as it is.
    """

    heading: str
    key: str
    spec: str = ""


@dataclass(frozen=True, slots=True)
class Study:
    """A campaign that has a name.

    Attributes:
        run_job: a function of a module, which workers import by its name; a pure function of the job.
        combine: factors of a cell and the outcomes of its jobs in the order of their seeds, to figures and arrays.
        columns: of ``table.md``.
        defaults: dotted keys of the study's own: stronger than the configuration file, weaker than the command line.
        mirrors: cells are crossed with these; empty where the study chooses the mirror in its cells.
        runs: seeds of each cell, unless told otherwise.
        is_radio: its configurations are those of robots among radio beacons.
    """

    name: str
    title: str
    cells: Callable[[], Sequence[Cell]]
    run_job: Callable[[Job], JobOutcome]
    combine: Callable[[Factors, Sequence[JobOutcome]], JobOutcome]
    columns: Sequence[Column]
    draw: Callable[[Sequence[CellResult], Path], None]
    defaults: Mapping[str, object] = field(default_factory=dict)
    mirrors: tuple[str, ...] = ("thesis-m1",)
    runs: int = 20
    is_radio: bool = False


def plain(value: Any) -> Any:
    """A value as JSON can say it: numpy's numbers as Python's, what is not finite as None."""
    if isinstance(value, Mapping):
        return {str(key): plain(part) for key, part in value.items()}
    if isinstance(value, np.ndarray | list | tuple):
        return [plain(part) for part in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not np.isfinite(value) else value


class Shard(NamedTuple):
    """Every ``of``-th job, counted from ``number`` (1 to ``of``)."""

    number: int
    of: int


WHOLE = Shard(1, 1)


def parse_shard(text: str) -> Shard:
    """``2/4`` as the second shard of four.

    Raises:
        CampaignError: it is not such a pair.
    """
    number, slash, of = text.partition("/")
    if slash and number.isdecimal() and of.isdecimal() and 1 <= int(number) <= int(of):
        return Shard(int(number), int(of))
    raise CampaignError(f"--shard {text}: is not i/n with 1 <= i <= n, as in 2/4")


def parse_choice(text: str) -> tuple[str, tuple[str, ...]]:
    """``world=hard,extreme`` as the factor and its levels.

    Raises:
        CampaignError: there is no factor or no level.
    """
    name, equals, levels = text.partition("=")
    chosen = tuple(level.strip() for level in levels.split(",") if level.strip())
    if not equals or not name.strip() or not chosen:
        raise CampaignError(f"--only {text}: is not factor=level[,level], as in world=hard,extreme")
    return name.strip(), chosen


def cells_of(study: Study, mirrors: Sequence[str] = (), only: Mapping[str, Sequence[str]] | None = None) -> list[Cell]:
    """The cells of a campaign.

    Args:
        only: levels to keep, by factor; all of the others.

    Raises:
        CampaignError: a factor or level that the study does not have.
    """
    if mirrors and not study.mirrors:
        raise CampaignError(f"study {study.name} chooses its mirrors itself; leave --mirror out")
    cells = list(study.cells())
    if crossed := tuple(mirrors) or study.mirrors:
        cells = [
            Cell({"mirror": mirror, **cell.factors}, {"run.mirror": mirror, **cell.overrides})
            for mirror in crossed
            for cell in cells
        ]
    for name, levels in (only or {}).items():
        cells = _chosen(study.name, cells, name, levels)
    return cells


def _chosen(study: str, cells: Sequence[Cell], name: str, levels: Sequence[str]) -> list[Cell]:
    there = list(dict.fromkeys(str(cell.factors[name]) for cell in cells if name in cell.factors))
    if not there:
        known = ", ".join(dict.fromkeys(factor for cell in cells for factor in cell.factors))
        raise CampaignError(f"--only {name}: is no factor of study {study}; there are {known}")
    for level in levels:
        if level not in there:
            raise CampaignError(f"--only {name}={level}: study {study} has no such level; there are {', '.join(there)}")
    return [cell for cell in cells if str(cell.factors.get(name)) in levels]


def jobs_of(
    study: Study, cells: Iterable[Cell], load: Load, settings: Mapping[str, object], runs: int
) -> list[list[Job]]:
    """The jobs of each cell, seeds in their order.

    Args:
        runs: seeds of each cell, from ``run.seed`` on.

    Raises:
        CampaignError: a setting would overrule a factor, or there are no runs.
        ConfigError: a configuration cannot be used.
    """
    if runs < 1:
        raise CampaignError(f"--runs {runs}: must be at least 1")
    return [_jobs_of_cell(study, cell, load, settings, runs) for cell in cells]


def _jobs_of_cell(study: Study, cell: Cell, load: Load, settings: Mapping[str, object], runs: int) -> list[Job]:
    if taken := sorted(set(settings) & set(cell.overrides)):
        raise CampaignError(
            f"{taken[0]} is set by study {study.name} itself; leave it out, or choose cells with --only"
        )
    cfg = load({**study.defaults, **settings, **cell.overrides})
    seeds = range(cfg.run.seed, cfg.run.seed + runs)
    return [Job(study.name, cell.factors, seed, with_seed(cfg, seed)) for seed in seeds]


def with_seed(cfg: AnyConfig, seed: int) -> AnyConfig:
    """The same configuration with another seed."""
    return cfg.model_copy(update={"run": cfg.run.model_copy(update={"seed": seed})})


class Schedule:
    """The jobs that are still to be handed out.

    Missions of one cell take about equally long, cells differ: a robot with the thesis's gains takes four times as
    long. Handing out what is longest first keeps the end short, when some workers have nothing left to do (Graham
    1969: at most a third longer than the best plan).

    Args:
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


PER_DECADE = 1000
LEAST = 1e-9  # anything smaller falls into the first bin


@dataclass(frozen=True, slots=True)
class Histogram:
    """A histogram with logarithmic bins, empty ones left out.

    Attributes:
        bins: indices of the bins, ascending, shape (k,). Bin i ends at ``LEAST * 10**(i / PER_DECADE)``.
        counts: in each of them, shape (k,).
        largest: of the values; 0 where there are none.
    """

    bins: IntArray
    counts: IntArray
    total: float
    largest: float
    within: int

    @classmethod
    def of(cls, values: FloatArray, limit: float) -> "Histogram":
        """The spread of values, shape (n,).

        Raises:
            ValueError: a value is negative or not finite.
        """
        if values.size and not (np.isfinite(values).all() and values.min() >= 0.0):
            raise ValueError(f"values from {values.min()} to {values.max()}: must be finite and not negative")
        places = np.ceil(PER_DECADE * np.log10(np.maximum(values, LEAST) / LEAST)).astype(np.int64)
        bins, counts = np.unique(places, return_counts=True)
        largest = float(values.max(initial=0.0))
        return cls(bins, counts.astype(np.int64), float(values.sum()), largest, int(np.count_nonzero(values <= limit)))

    @property
    def count(self) -> int:
        """How many values."""
        return int(self.counts.sum())

    @property
    def mean(self) -> float:
        """Their mean; NaN where there are none."""
        return self.total / self.count if self.count else float("nan")

    def quantile(self, share: float) -> float:
        """The value that this share of the values does not exceed; NaN where there are none."""
        if not self.count:
            return float("nan")
        ends = np.cumsum(self.counts)
        rank = share * (self.count - 1)
        place = int(np.searchsorted(ends, rank, side="right"))
        value = self.edges[min(place, len(ends) - 1)] * 10.0 ** (-0.5 / PER_DECADE)  # the bin's middle
        return min(float(value), self.largest)

    @property
    def edges(self) -> FloatArray:
        """Upper ends of the bins, shape (k,)."""
        return np.asarray(LEAST * 10.0 ** (self.bins / PER_DECADE), dtype=np.float64)

    def exceedance(self) -> tuple[FloatArray, FloatArray]:
        """Values and the share of all that is larger, shapes (k,), for a figure."""
        return self.edges, 1.0 - np.cumsum(self.counts) / max(self.count, 1)

    def to_arrays(self, name: str) -> dict[str, NDArray[np.generic]]:
        """As arrays whose names begin with ``name``."""
        figures = np.array([self.total, self.largest, float(self.within)])
        return {f"{name}_bins": self.bins.astype(np.int32), f"{name}_counts": self.counts, f"{name}_figures": figures}

    @classmethod
    def from_arrays(cls, arrays: dict[str, NDArray[np.generic]], name: str) -> "Histogram":
        """What ``to_arrays`` made."""
        total, largest, within = arrays[f"{name}_figures"].astype(np.float64).tolist()
        bins, counts = arrays[f"{name}_bins"].astype(np.int64), arrays[f"{name}_counts"].astype(np.int64)
        return cls(bins, counts, total, largest, int(within))


def pooled(spreads: Sequence[Histogram]) -> Histogram:
    """All of them in one."""
    places = np.concatenate([spread.bins for spread in spreads]) if spreads else np.empty(0, dtype=np.int64)
    counts = np.concatenate([spread.counts for spread in spreads]) if spreads else np.empty(0, dtype=np.int64)
    bins, where = np.unique(places, return_inverse=True)
    sums = np.zeros(len(bins), dtype=np.int64)
    np.add.at(sums, where, counts)
    return Histogram(
        bins,
        sums,
        sum(spread.total for spread in spreads),
        max((spread.largest for spread in spreads), default=0.0),
        sum(spread.within for spread in spreads),
    )
