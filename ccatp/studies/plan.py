"""Pure. The plan of a campaign: which cells, which seeds, whose share of the jobs."""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from ccatp.studies.campaign import AnyConfig, CampaignError, Cell, Job, Load, Study


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


def jobs_of(
    study: Study, cells: Iterable[Cell], load: Load, settings: Mapping[str, object], runs: int
) -> list[list[Job]]:
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
        raise CampaignError(
            f"{taken[0]} is set by study {study.name} itself; leave it out, or choose cells with --only"
        )
    cfg = load({**study.defaults, **settings, **cell.overrides})
    seeds = range(cfg.run.seed, cfg.run.seed + runs)
    return [Job(study.name, cell.factors, seed, with_seed(cfg, seed)) for seed in seeds]


def with_seed(cfg: AnyConfig, seed: int) -> AnyConfig:
    """The same configuration with another seed."""
    return cfg.model_copy(update={"run": cfg.run.model_copy(update={"seed": seed})})
