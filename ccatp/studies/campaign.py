"""Pure. What a campaign is: cells of factors, crossed with seeds into jobs that can run anywhere in any order."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from hashlib import sha256
from json import dumps
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import ccatp
from ccatp.config.models import Config
from ccatp.errors import CcatpError, ExitStatus

Factor = str | int | float | bool
Factors = Mapping[str, Factor]
Arrays = Mapping[str, NDArray[Any]]
Load = Callable[[Mapping[str, object]], Config]
"""Dotted keys, stronger than the configuration file, to a configuration."""


class CampaignError(CcatpError):
    """A campaign that cannot be run as asked; what was done before is kept."""

    exit_status = ExitStatus.USAGE


@dataclass(frozen=True, slots=True)
class Cell:
    """One combination of factors.

    Attributes:
        factors: as they stand in the cell of ``result.json``.
        overrides: dotted configuration keys that make the cell.
    """

    factors: Factors
    overrides: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Job:
    """All that a worker is given. What comes of it is a function of these four and nothing else."""

    study: str
    factors: Factors
    seed: int
    cfg: Config

    @property
    def key(self) -> str:
        """``world=hard,filter=ekf,seed=3``."""
        return ",".join(f"{name}={value}" for name, value in (*self.factors.items(), ("seed", self.seed)))

    @property
    def fingerprint(self) -> str:
        """Of everything that the outcome depends on, this program's version included."""
        whole = [ccatp.__version__, self.study, dict(self.factors), self.seed, self.cfg.model_dump(mode="json")]
        return sha256(dumps(whole, sort_keys=True).encode()).hexdigest()[:16]


class Outcome(NamedTuple):
    """What comes of a job, or of all jobs of a cell.

    Attributes:
        values: what JSON can say; numbers that are not finite become null.
        arrays: small ones, by name.
    """

    values: Mapping[str, Any]
    arrays: Arrays = {}


class CellResult(NamedTuple):
    """One cell of the result: its factors, runs and figures, and its arrays."""

    factors: Factors
    values: Mapping[str, Any]
    arrays: Arrays


class Column(NamedTuple):
    """A column of ``table.md``.

    Attributes:
        heading: with unit.
        key: dotted path into the cell.
        spec: format of numbers; empty leaves the value as it is.
    """

    heading: str
    key: str
    spec: str = ""


@dataclass(frozen=True, slots=True)
class Study:
    """A campaign that has a name.

    Attributes:
        name: on the command line.
        title: one line.
        cells: builds the cells.
        run_job: a function of a module, which workers import by its name; a pure function of the job.
        combine: factors of a cell and the outcomes of its jobs in the order of their seeds, to figures and arrays.
        columns: of ``table.md``.
        draw: writes figures into a directory.
        defaults: dotted keys of the study's own: stronger than the configuration file, weaker than the command line.
        mirrors: cells are crossed with these; empty where the study chooses the mirror in its cells.
        runs: seeds of each cell, unless told otherwise.
    """

    name: str
    title: str
    cells: Callable[[], Sequence[Cell]]
    run_job: Callable[[Job], Outcome]
    combine: Callable[[Factors, Sequence[Outcome]], Outcome]
    columns: Sequence[Column]
    draw: Callable[[Sequence[CellResult], Path], None]
    defaults: Mapping[str, object] = field(default_factory=dict)
    mirrors: tuple[str, ...] = ("thesis-m1",)
    runs: int = 20


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
        study: the study.
        mirrors: in place of the study's.
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


def jobs_of(study: Study, cells: Iterable[Cell], load: Load, settings: Mapping[str, object], runs: int) -> list[list[Job]]:
    """The jobs of each cell, seeds in their order.

    Args:
        study: the study.
        cells: its cells.
        load: the loader of configurations.
        settings: dotted keys of the command line.
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
        raise CampaignError(f"{taken[0]} is set by study {study.name} itself; leave it out, or choose cells with --only")
    cfg = load({**study.defaults, **settings, **cell.overrides})
    seeds = range(cfg.run.seed, cfg.run.seed + runs)
    return [Job(study.name, cell.factors, seed, with_seed(cfg, seed)) for seed in seeds]


def with_seed(cfg: Config, seed: int) -> Config:
    """The same configuration with another seed."""
    return cfg.model_copy(update={"run": cfg.run.model_copy(update={"seed": seed})})


def plain(value: Any) -> Any:
    """A value as JSON can say it: numpy's numbers as Python's, what is not finite as None."""
    if isinstance(value, Mapping):
        return {str(key): plain(part) for key, part in value.items()}
    if isinstance(value, np.ndarray | list | tuple):
        return [plain(part) for part in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not np.isfinite(value) else value
