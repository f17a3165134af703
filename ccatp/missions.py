"""The kinds of missions: one value for each, found by the name that a configuration gives as ``system``.

A configuration without ``system`` is one of a survey. A part of a kind is the place of an object, ``module:name``,
which is imported when it is used: a process imports only what it needs of the one kind that it serves. Another package
adds a kind by an entry point of the group ``ccatp.missions``.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from typing import Any

# Places of the kinds of this package, and the group of entry points of those of others.
BUILT_IN = ("ccatp.survey.kind:SURVEY", "ccatp.beacons.kind:BEACONS")
GROUP = "ccatp.missions"
SURVEY = "survey"


@dataclass(frozen=True, slots=True)
class Part:
    """An object of a kind by its place, ``module:name``; the comments of ``MissionKind`` give its type."""

    place: str

    @property
    def name(self) -> str:
        """Its name in its module."""
        return self.place.partition(":")[2]

    def get(self) -> Any:
        """Import it."""
        return getattr(import_module(self.place.partition(":")[0]), self.name)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MissionKind:
    """One kind of mission.

    ``systems``: values of ``system`` in its configurations. ``title``: a mission of this kind, in messages.
    ``subject``: what its ``RunText.subject`` is, in log and recording. ``no_resume``: why no mission can be continued
    from its run directory; ``None``: it can. ``no_faults``: why its simulated robot takes no fault plan, with advice;
    ``None``: it takes one. ``conditions``: module whose import registers the kind's own rows; empty: none. ``waits``:
    what the robot waits for in modes that only this kind has; in those of ``stands`` it does not move.
    """

    systems: tuple[str, ...]
    title: str
    subject: str = "system"
    no_resume: str | None = None
    no_faults: str | None = "plans are for surveys; leave it out"
    # Configuration. ``C`` below is its class, which has what ``config.mission.MissionConfig`` lists.
    load: Part  # config.load.LoadConfig
    shipped: Part | None = None  # Callable[[C], C]: what a configuration is compared with, if not that of its system
    # The run: texts, what is checked before it begins, processes, summary.
    text: Part = Part("ccatp.daemon.supervision.run_text:plain_text")  # Callable[[C], RunText]
    check: Part | None = None  # Callable[[run_dir.RunOptions, C], None], raises ConfigError
    without_effect: Part | None = None  # Callable[[C, bool], list[str]]: lines on keys that do nothing; bool: simulated
    resumed: Part | None = None  # Callable[[C, Path], None], raises ConfigError: the run in a folder is another one
    processes: Part = Part("ccatp.daemon.supervision.supervisor:WITHOUT_LASER")  # tuple[ProcessSpec, ...]
    record: Part = Part("ccatp.records.run_record:status_record")  # Callable[[C, Path, RobotClock, bool], RunRecord]
    # Main loop, danger loop, simulated robot.
    runner: Part  # Callable[[C, ProcessArgs], AbstractContextManager[Callable[[MissionHost], MissionRunner]]]
    limits: Part = Part("ccatp.daemon.loops.mission_runner:usual_limits")  # Callable[[C], LoopLimits]
    rules: Part = Part("ccatp.safety.rules:emergency_rules")  # Callable[[C], safety.rules.SafetyRules]
    stand_in: Part  # Callable[[C, dataloop.StandInOptions], dataloop.StandIn]
    # Views: the web page of a run, the report on it, its tables in Python.
    page: Part | None = None  # Callable[[C, Path, bool], report.dashboard.hub.Page]; None: it has no page
    report: Part | None = None  # Callable[[Path], report.html.RunReport]; None: it has no report
    analysis: Part | None = None  # Callable[[Path], analysis.run.Run]; None: it has no tables
    # What it adds to the tables of the package.
    conditions: str = ""
    waits: Mapping[str, str] = field(default_factory=dict)
    stands: tuple[str, ...] = ()
    topics: Part | None = None  # tuple[links.topics.Topic, ...]
    commands: tuple[Part, ...] = ()  # of click.Command, for the section of studies
    studies: Mapping[str, tuple[str, str]] = field(default_factory=dict)  # as ``studies.STUDIES``
    races: Part | None = None  # Callable[[], Iterable[studies.bench_cases.Race]]


@cache
def built_in() -> tuple[MissionKind, ...]:
    """The kinds of this package."""
    return tuple(Part(place).get() for place in BUILT_IN)


@cache
def _of_others() -> tuple[MissionKind, ...]:
    from importlib.metadata import entry_points  # noqa: PLC0415 - 20 ms, which only an unknown name costs

    return tuple(point.load() for point in entry_points(group=GROUP))


def all_kinds() -> tuple[MissionKind, ...]:
    """The kinds of this package, and those of other packages that are installed."""
    return (*built_in(), *_of_others())


# What is searched for a name, in this order: the installed packages only for one that is not known here.
SEARCHED = built_in, all_kinds


def find_kind(system: object) -> MissionKind | None:
    """The kind whose configurations name ``system``; ``None``: there is none."""
    for kinds in SEARCHED:
        for kind in kinds():
            if system in kind.systems:
                return kind
    return None


def kind_of(cfg: Any) -> MissionKind:
    """The kind of a loaded configuration. Raises LookupError: its class belongs to no kind."""
    kind = find_kind(cfg.system)
    if kind is None:
        raise LookupError(f"no kind of mission has the system {cfg.system!r}")
    return kind
