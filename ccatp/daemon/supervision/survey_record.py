"""The record of a survey: its summary from the messages, the database and the recordings of earlier sessions."""

import json
from collections.abc import Callable, Iterable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from ccatp.config.models import Config
from ccatp.core import FloatArray, PanelId, PointId, unreliable_points
from ccatp.links.topics import (
    ArrivalMessage,
    DangerEvent,
    FixMessage,
    Message,
    MissionStatus,
    SessionMessage,
    Timing,
    TrackMessage,
    TruthMessage,
)
from ccatp.mirror.mirror import Mirror, build_mirror, deck_rows
from ccatp.records.recorder import TELEMETRY, RecordedMessage, RobotClock, decode_recorded, recordings
from ccatp.records.run_record import RunRecord
from ccatp.records.store import StoredSurvey, StoreError, read_survey
from ccatp.records.summary import PanelFits, SummaryBuilder
from ccatp.records.timeline import iter_places, read_timeline
from ccatp.report.foxglove import Views
from ccatp.survey.events import SurveyOutcome

# Topics of a survey's summary; a recording holds twenty times as much.
SUMMARISED = {"mission", "track", "truth", "arrival", "fix", "danger_event"}


class _SurveySession:
    """Messages of one session of a survey."""

    def __init__(self, cfg: Config, mirror: Mirror, *, is_sim: bool) -> None:
        self._mirror = mirror
        self._code = 0
        self.has_status = False
        self._frames_before = 0  # of the robot's present boot; danger names frames by the robot's own numbers
        self.builder = SummaryBuilder(cfg, mirror, is_sim=is_sim)

    def take(self, message: Message) -> None:
        builder = self.builder
        if isinstance(message, TruthMessage):
            builder.add_truth(message.rows)
        elif isinstance(message, TrackMessage):
            builder.add_track(self._on_deck(message))
        elif isinstance(message, ArrivalMessage):
            builder.add_arrival(PointId(*message.point), message.seq)
        elif isinstance(message, FixMessage):
            if message.point is not None and not message.is_set_aside:
                builder.add_fix(PointId(*message.point), message.position_m)
        elif isinstance(message, Timing):
            builder.add_ticks(message.tick_us)
        elif isinstance(message, DangerEvent):
            if message.code != self._code:
                builder.add_verdict_event(message.seq + self._frames_before, message.code)
            self._code = message.code
        elif isinstance(message, SessionMessage):
            self._frames_before = message.frames_before
        elif isinstance(message, MissionStatus):
            if not self.has_status:  # only the first: a main loop that takes over plans only the rest
                self.has_status = True
                builder.set_plan(message.total, message.lower_bound_s)
            is_complete = message.outcome == SurveyOutcome.COMPLETE
            builder.set_mission(
                message.done, message.skipped, message.elapsed_s, message.left_out, is_complete=is_complete
            )
            builder.add_grip(message.friction, message.grip)

    def _on_deck(self, track: TrackMessage) -> FloatArray:
        """Rows of seq, t_s, x, y, heading (deck), X, Y, Z of the surface point, in the format of the truth."""
        rows = np.array(track.rows)
        deck = deck_rows(self._mirror, [row[2:4] for row in track.rows], rows[:, 4:7])
        return np.column_stack([rows[:, :2], deck[:, :3], deck[:, :2], deck[:, 3]])


class SurveyRecord(RunRecord):
    """Messages of a survey, for its summary; its views for Foxglove and PlotJuggler."""

    def __init__(self, cfg: Config, run_dir: Path, clock: RobotClock, is_sim: bool) -> None:
        self._cfg = cfg
        self._run_dir = run_dir
        self._is_sim = is_sim
        self.mirror = build_mirror(cfg.mirror)
        self._session = _SurveySession(cfg, self.mirror, is_sim=is_sim)
        self._views = Views(self.mirror, cfg.robot.puck_height_m, clock)
        self._injected: PanelFits | None = None
        self._remarks: list[str] = []

    @property
    def remarks(self) -> Sequence[str]:
        """Warnings for the operator at the end."""
        return self._remarks

    def prepare(self) -> None:
        """As ``RunRecord.prepare``: SciPy would delay the start of each run by a fifth of a second."""
        import_module("ccatp.mirror.panel_alignment")

    def take(self, message: Message) -> None:
        """Take one message of the run."""
        self._session.take(message)

    def views_of(self, message: Message) -> Iterable[RecordedMessage]:
        """The views of a message."""
        return self._views.of(message)

    def ask_truth(self, request: Callable[[bytes], dict[str, Any]]) -> None:
        """Ask for the true misalignment of the simulated panels: rows of row, column, piston, tip, tilt."""
        rows: list[list[float]] = request(b"misalignment").get("panels", [])
        self._injected = {PanelId(int(row), int(col)): (piston, tip, tilt) for row, col, piston, tip, tilt in rows}

    def build(self, wall_s: float) -> dict[str, Any]:
        """The summary, after main has closed the mission's database."""
        survey = self._stored()
        standings = [] if survey is None else [point.status for point in survey.points]
        if not self._session.has_status:
            if survey is None and (before := _read(self._run_dir / "summary.json")):
                return before  # keep the earlier summary, because nothing is known of this session
            self.take(MissionStatus(seq=-1, t_s=0.0, state="", total=len(standings)))
        builder = self._session.builder
        if survey is not None:  # the last status of a main that was terminated may be lost
            builder.set_counts(standings.count("measured"), standings.count("skipped"))
            builder.set_unreliable(unreliable_points(survey.fixes))
        builder.set_panels({} if survey is None else self._fits(survey), self._injected)
        for path in reversed(recordings(self._run_dir / TELEMETRY)[:-1]):
            earlier = _SurveySession(self._cfg, self.mirror, is_sim=self._is_sim)
            timeline = read_timeline(path, is_simulation=self._is_sim)
            for place, topic, _, payload in iter_places(path):
                if topic in SUMMARISED and isinstance(message := decode_recorded(topic, payload), Message):
                    earlier.take(timeline.on_axis(place, message))
            if earlier.has_status:
                builder.precede(earlier.builder)
        return builder.build(wall_s)

    def _stored(self) -> StoredSurvey | None:
        path = self._run_dir / "mission.sqlite"
        if not path.exists():  # main ended before it created one
            return None
        try:
            return read_survey(path, self.mirror.name)  # works on a full disk, too
        except StoreError as error:
            self._remarks.append(f"the summary is without panels: {error}")
            return None

    def _fits(self, survey: StoredSurvey) -> PanelFits:
        from ccatp.mirror.panel_alignment import fit_panels  # noqa: PLC0415 - see prepare

        return fit_panels(self.mirror, survey.fixes, self._cfg.robot.puck_height_m)


def _read(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}
