"""What a campaign is: cells of factors, crossed with seeds into jobs that can run anywhere in any order."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from hashlib import sha256
from json import dumps
from pathlib import Path
from typing import Any, NamedTuple

from numpy.typing import NDArray

import ccatp
from ccatp.config.beacon_models import RadioConfig, RecordingsConfig
from ccatp.config.models import Config
from ccatp.errors import ExitStatus, UsageError

Factor = str | int | float | bool
Factors = Mapping[str, Factor]
Arrays = Mapping[str, NDArray[Any]]
AnyConfig = Config | RadioConfig | RecordingsConfig
# Dotted keys, stronger than the configuration file, to a configuration.
Load = Callable[[Mapping[str, object]], AnyConfig]


class CampaignError(UsageError):
    """A campaign that cannot be run as asked; what was done before is kept."""


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
    """One combination of factors, as they stand in ``result.json``, and the dotted keys that make it."""

    factors: Factors
    overrides: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Job:
    """All that a worker is given: the outcome is a function of these four and nothing else."""

    study: str
    factors: Factors
    seed: int
    cfg: Any  # what the study's loader gives

    @property
    def key(self) -> str:
        """``world=hard,filter=ekf,seed=3``."""
        return ",".join(f"{name}={value}" for name, value in {**self.factors, "seed": self.seed}.items())

    @property
    def fingerprint(self) -> str:
        """Of everything that the outcome depends on, this program's version included."""
        whole = [ccatp.__version__, self.study, dict(self.factors), self.seed, self.cfg.model_dump(mode="json")]
        return sha256(dumps(whole, sort_keys=True).encode()).hexdigest()[:16]


NO_ARRAYS: Arrays = {}  # not to be written to; a read-only view could not cross to another process


class JobOutcome(NamedTuple):
    """The outcome of a job, or of all jobs of a cell; numbers in ``values`` that are not finite become null."""

    values: Mapping[str, Any]
    arrays: Arrays = NO_ARRAYS


class CellResult(NamedTuple):
    """One cell of the result: its factors, runs and figures, and its arrays."""

    factors: Factors
    values: Mapping[str, Any]
    arrays: Arrays


@dataclass(frozen=True, slots=True)
class Study:
    """A campaign that has a name; workers import ``run_job`` by its name, outcomes are combined in order of seeds."""

    cells: Callable[[], Sequence[Cell]]
    run_job: Callable[[Job], JobOutcome]
    combine: Callable[[Factors, Sequence[JobOutcome]], JobOutcome]
    columns: str  # of ``table.md``: see ``results.columns_of``
    draw: Callable[[Sequence[CellResult], Path], None]
    # Dotted keys: stronger than the configuration file, weaker than the command line.
    defaults: Mapping[str, object] = field(default_factory=dict)
    mirrors: tuple[str, ...] = ("thesis-m1",)  # crossed with the cells; empty where these choose the mirror
    runs: int = 20  # seeds of each cell, by default
    loader: str = "load_config"  # of its configurations, in ``ccatp.config.load``
    # What was published of a cell: ``printed`` in its result.
    published: Callable[[Factors], Mapping[str, Any]] | None = None
    with_peers: Callable[[], Sequence[Cell]] | None = None  # its cells with those of other people's programs
    name: str = ""  # both as in the table of studies, see ``find_study``
    title: str = ""


class Shard(NamedTuple):
    """Every ``of``-th job, counted from ``number`` (1 to ``of``)."""

    number: int
    of: int


WHOLE = Shard(1, 1)


def parse_shard(text: str) -> Shard:
    """``2/4`` as the second shard of four (raises CampaignError: it is not such a pair)."""
    number, slash, of = text.partition("/")
    if slash and number.isdecimal() and of.isdecimal() and 1 <= int(number) <= int(of):
        return Shard(int(number), int(of))
    raise CampaignError(f"--shard {text}: is not i/n with 1 <= i <= n, as in 2/4")


def parse_choice(text: str) -> tuple[str, tuple[str, ...]]:
    """``world=hard,extreme`` as the factor and its levels (raises CampaignError: there is no factor or no level)."""
    name, equals, levels = text.partition("=")
    chosen = tuple(level.strip() for level in levels.split(",") if level.strip())
    if not equals or not name.strip() or not chosen:
        raise CampaignError(f"--only {text}: is not factor=level[,level], as in world=hard,extreme")
    return name.strip(), chosen


def cells_of(study: Study, mirrors: Sequence[str] = (), only: Mapping[str, Sequence[str]] | None = None) -> list[Cell]:
    """The cells of a campaign; ``only``: levels to keep, by factor (raises CampaignError: the study has no such)."""
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
    """The jobs of each cell, ``runs`` seeds from ``run.seed`` on in their order.

    CampaignError: a setting would overrule a factor, or there are no runs. ConfigError: a configuration is of no use.
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
