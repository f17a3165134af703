"""Pure. What a campaign is: cells of factors, crossed with seeds into jobs that can run anywhere in any order."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from hashlib import sha256
from json import dumps
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import ccatp
from ccatp.config.models import Config
from ccatp.config.radio_models import RadioConfig
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


class Outcome(NamedTuple):
    """What comes of a job, or of all jobs of a cell.

    Attributes:
        values: what JSON can say; numbers that are not finite become null.
        arrays: small ones, by name.
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
        is_radio: its configurations are those of robots among radio beacons.
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
