"""Glue. What differs between a survey and a mission among beacons for the supervisor that runs it."""

from pathlib import Path
from typing import Protocol

from ccatp.config.models import Config, ProcessesConfig
from ccatp.config.radio_models import RadioConfig
from ccatp.supervision.children import ProcessSpec
from ccatp.supervision.collecting import Collector, RunAccess
from ccatp.supervision.run_collector import RunCollector
from ccatp.supervision.run_view import BeaconView, RunView, survey_title


class RunKind(Protocol):
    """One kind of run."""

    @property
    def rows(self) -> tuple[ProcessSpec, ...]:
        """Of the process table."""

    @property
    def processes(self) -> ProcessesConfig:
        """When one hangs, and how often they are started anew."""

    @property
    def facts(self) -> dict[str, object]:
        """Of the run, for the log."""

    def collector(self, access: RunAccess) -> Collector:
        """Who listens to it."""

    def view(self, run_dir: Path) -> RunView:
        """Who shows it."""


class SurveyRun:
    """The survey of a mirror.

    Args:
        cfg: the configuration.
        rows: of the process table.
        is_sim: robot and laser system are stand-ins.
    """

    def __init__(self, cfg: Config, rows: tuple[ProcessSpec, ...], *, is_sim: bool) -> None:
        self._cfg, self._is_sim = cfg, is_sim
        self.rows, self.processes = rows, cfg.run
        self.facts: dict[str, object] = {"mirror": cfg.mirror.name, "seed": cfg.run.seed, "sim": is_sim}

    def collector(self, access: RunAccess) -> Collector:
        """Who listens to it."""
        return RunCollector(access, self._cfg)

    def view(self, run_dir: Path) -> RunView:
        """Who shows it."""
        return RunView(survey_title(self._cfg, is_sim=self._is_sim), is_sim=self._is_sim, run_dir=run_dir)


class BeaconRun:
    """A mission among beacons.

    Args:
        cfg: the configuration.
        rows: of the process table.
        is_sim: the robot is a stand-in.
    """

    def __init__(self, cfg: RadioConfig, rows: tuple[ProcessSpec, ...], *, is_sim: bool) -> None:
        self._cfg, self._is_sim = cfg, is_sim
        self.rows, self.processes = rows, cfg.processes
        self.facts: dict[str, object] = {"system": cfg.system, "seed": cfg.run.seed, "sim": is_sim}

    def collector(self, access: RunAccess) -> Collector:
        """Who listens to it."""
        # A survey starts a fifth of a second sooner without the statistics that come along.
        from ccatp.supervision.beacon_collector import BeaconCollector  # noqa: PLC0415

        return BeaconCollector(access, self._cfg)

    def view(self, run_dir: Path) -> RunView:
        """Who shows it."""
        cfg = self._cfg
        what = "follow a radio" if cfg.follow.is_active else "visit waypoints"
        seed = f", seed {cfg.run.seed}" if self._is_sim else ""
        title = f"ccatp {'SIMULATION' if self._is_sim else 'mission'} among beacons: {cfg.system}, {what}{seed}"
        goals = "seconds" if cfg.follow.is_active else "waypoints"
        return BeaconView(title, is_sim=self._is_sim, run_dir=run_dir, goals=goals)
