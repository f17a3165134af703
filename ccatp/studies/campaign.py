"""Types of a campaign: cells of factors, crossed with seeds to jobs that can run anywhere in any order."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from hashlib import sha256
from json import dumps
from pathlib import Path
from typing import Any, NamedTuple

from numpy.typing import NDArray

import ccatp
from ccatp.errors import ExitStatus, UsageError
from ccatp.missions import Part

Factor = str | int | float | bool
Factors = Mapping[str, Factor]
Arrays = Mapping[str, NDArray[Any]]
AnyConfig = Any  # of the study's loader; with a section ``run``, whose ``seed`` is that of a job
_SURVEYS = Part("ccatp.config.load:load_config")
# From dotted keys, which override the configuration file, to a configuration.
Load = Callable[[Mapping[str, object]], AnyConfig]


class CampaignError(UsageError):
    """A campaign that cannot be run as requested; finished jobs are kept."""


class CampaignFailed(CampaignError):
    """Jobs failed, a worker died, or the results cannot be written; finished jobs are kept."""

    exit_status = ExitStatus.HELD


class CampaignInterrupted(CampaignError):
    """The user stopped the campaign; finished jobs are kept."""

    exit_status = ExitStatus.INTERRUPTED


class ClusterUnreachable(CampaignError):
    """No scheduler of the cluster answers."""

    exit_status = ExitStatus.UNREACHABLE


@dataclass(frozen=True, slots=True)
class Cell:
    """One combination of factors, as in ``result.json``, and the dotted keys that select it."""

    factors: Factors
    overrides: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Job:
    """The input of a worker: the outcome depends on these four values only."""

    study: str
    factors: Factors
    seed: int
    cfg: Any  # configuration from the study's loader

    @property
    def key(self) -> str:
        """``world=hard,filter=ekf,seed=3``."""
        return ",".join(f"{name}={value}" for name, value in {**self.factors, "seed": self.seed}.items())

    @property
    def fingerprint(self) -> str:
        """Hash of everything on which the outcome depends, including this program's version."""
        whole = [ccatp.__version__, self.study, dict(self.factors), self.seed, self.cfg.model_dump(mode="json")]
        return sha256(dumps(whole, sort_keys=True).encode()).hexdigest()[:16]


NO_ARRAYS: Arrays = {}  # must not be changed; a read-only view cannot be sent to another process


class JobOutcome(NamedTuple):
    """The outcome of a job, or of all jobs of a cell; numbers in ``values`` that are not finite are written as null."""

    values: Mapping[str, Any]
    arrays: Arrays = NO_ARRAYS


class CellResult(NamedTuple):
    """One cell of the result: factors, values (with the number of runs) and arrays."""

    factors: Factors
    values: Mapping[str, Any]
    arrays: Arrays


@dataclass(frozen=True, slots=True)
class Study:
    """A named campaign; workers import ``run_job`` by its name, and outcomes are combined in order of seeds."""

    cells: Callable[[], Sequence[Cell]]
    run_job: Callable[[Job], JobOutcome]
    combine: Callable[[Factors, Sequence[JobOutcome]], JobOutcome]
    columns: str  # of ``table.md``: see ``results.columns_of``
    draw: Callable[[Sequence[CellResult], Path], None]
    # Dotted keys: they override the configuration file, and the command line overrides them.
    defaults: Mapping[str, object] = field(default_factory=dict)
    mirrors: tuple[str, ...] = ("thesis-m1",)  # crossed with the cells; empty if the cells choose the mirror
    runs: int = 20  # seeds of each cell, by default
    loader: Part = _SURVEYS
    # Published values of a cell: ``printed`` in its result.
    published: Callable[[Factors], Mapping[str, Any]] | None = None
    of_config: Callable[["Study", Any], "Study"] | None = None  # the study with the cells that a configuration asks for
    notes: Sequence[str] = ()  # warnings before it runs
    with_peers: Callable[[], Sequence[Cell]] | None = None  # its cells, with those of programs by other authors
    name: str = ""  # name and title are those of the table of studies, see ``find_study``
    title: str = ""


class Shard(NamedTuple):
    """Every ``of``-th job, counted from ``number`` (1 to ``of``)."""

    number: int
    of: int


WHOLE = Shard(1, 1)


def parse_shard(text: str) -> Shard:
    """``2/4`` as the second shard of four. Raises CampaignError: the text is not such a pair."""
    number, slash, of = text.partition("/")
    if slash and number.isdecimal() and of.isdecimal() and 1 <= int(number) <= int(of):
        return Shard(int(number), int(of))
    raise CampaignError(f"--shard {text}: is not i/n with 1 <= i <= n, as in 2/4")


def parse_choice(text: str) -> tuple[str, tuple[str, ...]]:
    """``world=hard,extreme`` as the factor and its levels. Raises CampaignError: there is no factor or no level."""
    name, equals, levels = text.partition("=")
    chosen = tuple(level.strip() for level in levels.split(",") if level.strip())
    if not equals or not name.strip() or not chosen:
        raise CampaignError(f"--only {text}: is not factor=level[,level], as in world=hard,extreme")
    return name.strip(), chosen


def cells_of(study: Study, mirrors: Sequence[str] = (), only: Mapping[str, Sequence[str]] | None = None) -> list[Cell]:
    """The cells of a campaign; ``only``: levels to keep, by factor.

    Raises CampaignError: the study has no such factor or level, or chooses its mirrors itself.
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
        there = list(dict.fromkeys(str(cell.factors[name]) for cell in cells if name in cell.factors))
        if not there:
            known = ", ".join(dict.fromkeys(factor for cell in cells for factor in cell.factors))
            raise CampaignError(f"--only {name}: is no factor of study {study.name}; there are {known}")
        for level in levels:
            if level not in there:
                known = ", ".join(there)
                raise CampaignError(f"--only {name}={level}: study {study.name} has no such level; there are {known}")
        cells = [cell for cell in cells if str(cell.factors.get(name)) in levels]
    return cells


def jobs_of(
    study: Study, cells: Iterable[Cell], load: Load, settings: Mapping[str, object], runs: int
) -> list[list[Job]]:
    """The jobs of each cell, in order of seeds: ``runs`` seeds, beginning with ``run.seed``.

    Raises CampaignError: a setting would override a factor, or there are no runs. Raises ConfigError: a configuration
    is invalid.
    """
    if runs < 1:
        raise CampaignError(f"--runs {runs}: must be at least 1")
    plan = []
    for cell in cells:
        if taken := sorted(set(settings) & set(cell.overrides)):
            raise CampaignError(
                f"{taken[0]} is set by study {study.name} itself; leave it out, or choose cells with --only"
            )
        cfg = load({**study.defaults, **settings, **cell.overrides})
        seeds = range(cfg.run.seed, cfg.run.seed + runs)
        plan.append([Job(study.name, cell.factors, seed, with_seed(cfg, seed)) for seed in seeds])
    return plan


def with_seed(cfg: AnyConfig, seed: int) -> AnyConfig:
    """The same configuration with another seed."""
    return cfg.model_copy(update={"run": cfg.run.model_copy(update={"seed": seed})})
