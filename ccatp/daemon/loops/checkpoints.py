"""Builds the parts and the database of a main loop: new, resumed, or taken over from a checkpoint."""

from collections.abc import Collection, Sequence

from ccatp.conditions.mission import RESTARTED
from ccatp.config.models import Config
from ccatp.core import Cause, EmergencyKind, PointId
from ccatp.daemon.loops.emergency_file import EMERGENCIES_FILE, latched_kinds
from ccatp.daemon.supervision.process import ProcessArgs
from ccatp.daemon.supervision.run_dir import read_run_id
from ccatp.errors import CcatpError, ExitStatus
from ccatp.mirror.mirror import build_mirror
from ccatp.records.checkpoint import AT_BASE, CHECKPOINT_FILE, CheckpointError, read_checkpoint
from ccatp.records.store import MissionStore, StoreError, planned_point
from ccatp.survey.composition import Checkpoint, SurveyParts, assemble, take_over
from ccatp.survey.events import EmergencyKnown, EmergencyLatched, Pause, SurveyOutcome, TakenOver
from ccatp.survey.planning.route import ORDERS


class StoreUnusable(CcatpError):
    """The mission's database cannot be created or read."""

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
    checkpoint = read_checkpoint(args.run_dir / CHECKPOINT_FILE, Checkpoint) if args.is_taking_over else None
    run_id = read_run_id(args.run_dir)
    if run_id and checkpoint is not None and checkpoint.run_id != run_id:
        raise CheckpointError(f"{args.run_dir / CHECKPOINT_FILE}: is of another run, {AT_BASE}")
    skipped: tuple[PointId, ...] = ()
    if checkpoint is None:
        parts = assemble(cfg, measured)
    elif args.is_restarted:
        skipped = tuple(stored.point for stored in store.points() if stored.status == "skipped")
        parts = take_over(cfg, checkpoint, TakenOver(measured, skipped, checkpoint.elapsed_s))
    else:
        parts = take_over(cfg, checkpoint, TakenOver(measured, is_new_run=True))
    if args.is_held and not parts.mission.state.is_held_by_hand:
        # A robot at base is not sent there again: it stands until the emergency is cleared and an operator resumes.
        if checkpoint is None or checkpoint.state.outcome is SurveyOutcome.AT_BASE:
            parts.mission.handle(EmergencyKnown())
        parts.mission.handle(Pause(_why_held(points, measured, skipped)))
    if latched := latched_kinds(args.run_dir / EMERGENCIES_FILE):
        parts.mission.handle(EmergencyLatched(EmergencyKind.EARTHQUAKE in latched))
    return parts, store


def _why_held(points: Sequence[PointId], measured: Collection[PointId], skipped: Collection[PointId]) -> Cause:
    left = [point for point in points if point not in measured and point not in skipped]
    goes_on = f"continues with point {left[0].row}-{left[0].col}-{left[0].point}" if left else "ends it"
    return RESTARTED.cause(done=len(measured), left=len(left), goes_on=goes_on)


def _open_store(cfg: Config, args: ProcessArgs, mirror: str, points: Sequence[PointId]) -> MissionStore:
    path, run_id = args.run_dir / "mission.sqlite", read_run_id(args.run_dir)
    if args.is_resuming or (args.is_restarted and path.exists()):
        return MissionStore.open(path, mirror=mirror, run_id=run_id)
    planned = [planned_point(point, cfg.mirror.panels) for point in points]
    text = (args.run_dir / "config.toml").read_text(encoding="utf-8")
    return MissionStore.create(path, mirror=mirror, seed=cfg.run.seed, config_toml=text, points=planned, run_id=run_id)
