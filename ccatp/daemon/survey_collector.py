"""Collects a survey from the bus: what its summary needs, and the views of its recording."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from ccatp.config.load import dump_config
from ccatp.config.models import Config
from ccatp.core import FloatArray, PanelId, PanelPose, PointId
from ccatp.daemon.collector import Collector, RunAccess
from ccatp.links.topics import (
    ArrivalMessage,
    DangerEvent,
    Message,
    MissionStatus,
    Timing,
    TrackMessage,
    TruthMessage,
    decode_recorded,
)
from ccatp.mirror.mirror import Mirror, build_mirror, deck_poses
from ccatp.mirror.misalignment import PanelFit, fit_panel
from ccatp.mirror.surface import PanelFitError
from ccatp.records.recorder import iter_messages, recordings
from ccatp.records.store import StoredSurvey, read_survey
from ccatp.records.store_rows import StoreError
from ccatp.records.summary import RunFacts, SummaryBuilder, puck_targets
from ccatp.report.foxglove import Views
from ccatp.survey.planning.route import ORDERS

# A panel's plane has three parameters; the fit says so too, this saves the attempt.
MIN_FIXES = 3
# What a summary is made of; a recording holds twenty times as much.
SUMMARISED = {"mission", "track", "truth", "arrival", "danger_event"}


class RunCollector(Collector):
    """Listens to a survey from its start to its end."""

    def __init__(self, access: RunAccess, cfg: Config) -> None:
        """Subscribe before anybody publishes."""
        metadata = {
            "mirror": cfg.mirror.name,
            "seed": str(cfg.run.seed),
            "world": cfg.world.name,
            "config": dump_config(cfg),  # a later session in the same directory may have another
        }
        super().__init__(access, metadata)
        self._cfg, self._run_dir = cfg, access.run_dir
        self._mirror: Mirror = build_mirror(cfg.mirror)
        self._views = Views(self._mirror, cfg.robot.puck_height_m)
        self._builder: SummaryBuilder | None = None
        self._early: list[Message] = []
        self._code = 0
        self._injected: dict[PanelId, tuple[float, float, float]] | None = None

    def take(self, message: Message) -> None:
        """A message for the summary."""
        if isinstance(message, MissionStatus) and self._builder is None:
            self._begin(message)
        if self._builder is None:
            self._early.append(message)
        else:
            self._add(self._builder, message)

    def views_of(self, message: Message) -> Iterable[tuple[str, float, bytes]]:
        """What viewers are shown of a message beside it."""
        return self._views.of(message)

    def _begin(self, status: MissionStatus) -> SummaryBuilder:
        self._builder = builder = self._builder_for(status)
        for message in self._early:
            self._add(builder, message)
        self._early.clear()
        return builder

    def _builder_for(self, status: MissionStatus) -> SummaryBuilder:
        cfg = self._cfg
        points = ORDERS[cfg.run.order](self._mirror, cfg.run.panels)
        facts = RunFacts(
            mirror=cfg.mirror.name,
            world=cfg.world.name if self._is_sim else None,
            filter=cfg.run.filter,
            seed=cfg.run.seed,
            total_points=status.total,
            lower_bound_s=status.lower_bound_s,
            budget_s=cfg.run.budget_s,
            puck_height_m=cfg.robot.puck_height_m,
            has_truth=self._is_sim,
        )
        targets = puck_targets(self._mirror, points, cfg.robot.puck_height_m)
        return SummaryBuilder(facts, targets, self._mirror.surface.normal)

    def _add(self, builder: SummaryBuilder, message: Message) -> None:
        if isinstance(message, TruthMessage):
            builder.add_truth(message.rows)
        elif isinstance(message, TrackMessage):
            builder.add_track(self._on_deck(message))
        elif isinstance(message, ArrivalMessage):
            builder.add_arrival(PointId(*message.point), message.seq)
        elif isinstance(message, Timing):
            builder.add_ticks(message.tick_us)
        elif isinstance(message, DangerEvent):
            if message.code != self._code:
                builder.add_verdict_event(message.seq, message.code)
            self._code = message.code
        elif isinstance(message, MissionStatus):
            builder.set_mission(message.done, message.skipped, message.elapsed_s, message.left_out)

    def _on_deck(self, track: TrackMessage) -> FloatArray:
        """Rows of seq, t_s, x, y, heading (deck), X, Y, Z of the surface point, as the truth has them."""
        poses = [PanelPose(PanelId(row, col), x, y, heading) for _, _, row, col, x, y, heading, _ in track.rows]
        x, y, heading, z = deck_poses(self._mirror, poses).T
        seq, t_s = np.array([row[:2] for row in track.rows]).T
        return np.column_stack([seq, t_s, x, y, heading, x, y, z])

    def finish(self) -> None:
        """Ask the simulated truth for its last rows and the injected misalignment, and wait for what is on its way."""
        if self._is_sim:
            rows = int(self._ask(b"flush").get("rows", 0))
            self._injected = {
                PanelId(int(row), int(col)): (piston, tip, tilt)
                for row, col, piston, tip, tilt in self._ask(b"misalignment").get("panels", [])
            }
            self._collect_until_truth(rows)
        self.collect(1, None)

    def summary(self, wall_s: float) -> dict[str, Any]:
        """``summary.json`` of what was collected; call it when main has closed the mission's database."""
        survey = self._stored()
        builder = self._builder
        if builder is None and survey is None and (before := _read(self._run_dir / "summary.json")):
            return before  # nothing is known, and that must not replace what was
        if builder is None:
            # Main ended before it said where it stood: the mission's database says as much.
            standings = [] if survey is None else [point.status for point in survey.points]
            done, skipped = standings.count("measured"), standings.count("skipped")
            status = MissionStatus(seq=-1, t_s=0.0, state="", total=len(standings), done=done, skipped=skipped)
            builder = self._begin(status)
            self._add(builder, status)
        fits = {} if survey is None else self._fits(survey)
        builder.set_panels(
            {panel: (fit.piston_m, fit.tip_rad, fit.tilt_rad) for panel, fit in fits.items()}, self._injected
        )
        builder.set_wall(wall_s)
        sessions = [self._earlier(path) for path in recordings(self._run_dir / "telemetry.mcap")[:-1]]
        for session in reversed([session for session in sessions if session is not None]):
            builder.precede(session)
        return builder.build()

    def _earlier(self, path: Path) -> SummaryBuilder | None:
        """What an earlier session of the mission left in its recording; nothing where it never said where it stood."""
        builder: SummaryBuilder | None = None
        early: list[Message] = []
        for recorded in iter_messages(path):
            if recorded.topic not in SUMMARISED:
                continue
            message = decode_recorded(recorded.topic, recorded.payload)
            if not isinstance(message, Message):
                continue
            if builder is None and isinstance(message, MissionStatus):
                builder = self._builder_for(message)
                for one in early:
                    self._add(builder, one)
            if builder is None:
                early.append(message)
            else:
                self._add(builder, message)
        return builder

    def _stored(self) -> StoredSurvey | None:
        path = self._run_dir / "mission.sqlite"
        if not path.exists():  # main ended before it made one
            return None
        try:
            return read_survey(path, self._mirror.name)  # it needs no room on the disk
        except StoreError as error:
            self.remarks.append(f"the summary is without panels: {error}")
            return None

    def _fits(self, survey: StoredSurvey) -> dict[PanelId, PanelFit]:
        fixes = survey.fixes
        fits = {}
        for panel in sorted({PanelId(stored.point.row, stored.point.col) for stored in fixes}):
            own = [stored.fix for stored in fixes if stored.point.panel == panel]
            if len(own) < MIN_FIXES:
                continue
            points = np.array([fix.position_m for fix in own])
            covariances = np.array([fix.covariance_m2 for fix in own]).reshape(-1, 3, 3)
            try:
                fits[panel] = fit_panel(self._mirror, panel, points, covariances, self._cfg.robot.puck_height_m)
            except PanelFitError:
                continue  # fixes on one line: a survey that ended early
        return fits


def _read(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}
