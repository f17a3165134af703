"""Checkpoint of a main loop, and its parts and database: new, resumed, or taken over."""

from collections.abc import Collection, Sequence
from math import isfinite
from pathlib import Path

from msgspec.structs import replace

from ccatp.config.models import Config
from ccatp.core import PointId
from ccatp.daemon.danger_loop import FILE as EMERGENCIES
from ccatp.daemon.danger_loop import active_ids
from ccatp.daemon.process import ProcessArgs
from ccatp.daemon.run_dir import read_run_id
from ccatp.errors import CcatpError, ExitStatus
from ccatp.localizer import Localizer
from ccatp.mirror.mirror import build_mirror
from ccatp.records.checkpoint import AT_BASE, FILE, CheckpointError, CheckpointFile, read_checkpoint
from ccatp.records.store import MissionStore, StoredPoint, StoreError
from ccatp.survey.composition import Checkpoint, SurveyParts, assemble, take_over
from ccatp.survey.planning.route import ORDERS
from ccatp.survey.state import HELD, EmergencyKnown, Pause, SurveyState, TakenOver
from ccatp.survey.statechart import Mission

# Frames between two records: ten a second.
PERIOD_FRAMES = 10


class CheckpointWriter:
    """Keeps the checkpoint up to date; ``boot`` is the robot's."""

    def __init__(self, run_dir: Path, localizer: Localizer, mission: Mission, is_patient: bool) -> None:
        self._file = CheckpointFile(run_dir / FILE, is_patient=is_patient)
        self._localizer, self._mission = localizer, mission
        self._run_id = read_run_id(run_dir)
        self._written: SurveyState | None = None
        self._in_force = ("", "")
        self._left = 1
        self.boot = -1

    def is_due(self) -> bool:
        """Asked in each frame: in every tenth, in that of an abort, and where the state changed during a hold."""
        self._left -= 1
        state = self._mission.state
        is_new = state.abort_cause != self._in_force[0] or (state.mode is HELD and state is not self._written)
        return is_new or self._left <= 0

    def write(self, seq: int, t_s: float, elapsed_s: float) -> None:
        """Write the state of frame ``seq``; durably where abort or hold changed."""
        state = self._written = self._mission.state
        self._left = PERIOD_FRAMES
        record = Checkpoint.of(self._localizer, state, seq, t_s, elapsed_s, self.boot, self._run_id)
        pose = record.pose
        if not isfinite(pose.x_m + pose.y_m + pose.heading_rad + record.sigma_m + record.heading_sigma_rad):
            return  # the last good one is a better guess
        before, self._in_force = self._in_force, (state.abort_cause, state.cause if state.is_held_by_hand else "")
        self._file.write(record, is_durable=self._in_force != before)

    def close(self) -> None:
        """Write the record that waits."""
        self._file.close()


class StoreUnusable(CcatpError):
    """The mission's database cannot be made or read."""

    exit_status = ExitStatus.USAGE


def build_parts(cfg: Config, args: ProcessArgs) -> tuple[SurveyParts, MissionStore]:
    """All parts of the main loop and the mission's database."""
    mirror = build_mirror(cfg.mirror)
    points = ORDERS[cfg.run.order](mirror, cfg.run.panels)
    try:
        store = _open_store(cfg, args, mirror.name, points)
    except StoreError as error:
        raise StoreUnusable(str(error)) from error
    measured = tuple(stored.point for stored in store.fixes())
    checkpoint = read_checkpoint(args.run_dir / FILE, Checkpoint) if args.is_taking_over else None
    run_id = read_run_id(args.run_dir)
    if run_id and checkpoint is not None and checkpoint.run_id != run_id:
        raise CheckpointError(f"{args.run_dir / FILE}: is of another run, {AT_BASE}")
    skipped: tuple[PointId, ...] = ()
    if checkpoint is None:
        parts = assemble(cfg, measured)
        parts.mission.state = replace(parts.mission.state, done=measured)
    elif args.is_restarted:
        skipped = tuple(stored.point for stored in store.points() if stored.status == "skipped")
        parts = take_over(cfg, checkpoint, TakenOver(measured, skipped, checkpoint.elapsed_s))
    else:
        parts = take_over(cfg, checkpoint, TakenOver(measured, is_new_run=True))
    if args.is_held and not parts.mission.state.is_held_by_hand:
        before = ""
        if checkpoint is None:
            parts.mission.handle(EmergencyKnown())
            latched = [f"'ccatp clear {one}'" for one in active_ids(args.run_dir / EMERGENCIES)]
            if latched:
                before = f"the last run ended with an emergency that is not cleared: {', '.join(latched)}; "
        parts.mission.handle(Pause(before + _why_held(points, measured, skipped)))
    return parts, store


def _why_held(points: Sequence[PointId], measured: Collection[PointId], skipped: Collection[PointId]) -> str:
    left = [point for point in points if point not in measured and point not in skipped]
    goes_on = f"goes on with point {left[0].row}-{left[0].col}-{left[0].point}" if left else "ends it"
    counts = f"{len(measured)} points are measured and will be left out, {len(left)} are to do"
    return f"restarted: {counts}; 'ccatp resume' {goes_on}"


def _open_store(cfg: Config, args: ProcessArgs, mirror: str, points: Sequence[PointId]) -> MissionStore:
    path, run_id = args.run_dir / "mission.sqlite", read_run_id(args.run_dir)
    if args.is_resuming or (args.is_restarted and path.exists()):
        return MissionStore.open(path, mirror=mirror, run_id=run_id)
    grid = cfg.mirror.panels
    planned = []
    for point in points:
        row, column = divmod(point.point - 1, len(grid.points_x_mm))
        planned.append(StoredPoint(point, 1e-3 * grid.points_x_mm[column], 1e-3 * grid.points_y_mm[row]))
    text = (args.run_dir / "config.toml").read_text(encoding="utf-8")
    return MissionStore.create(path, mirror=mirror, seed=cfg.run.seed, config_toml=text, points=planned, run_id=run_id)
