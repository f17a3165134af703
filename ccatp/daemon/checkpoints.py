"""What a main loop saves for its successor, and its parts and database: new, resumed, or taken over."""

import math
from collections.abc import Sequence
from pathlib import Path

from ccatp.config.models import LimitsConfig
from ccatp.core import DeckPose, PointId
from ccatp.daemon.danger_loop import FILE as EMERGENCIES
from ccatp.daemon.danger_loop import active_ids
from ccatp.daemon.process import ProcessArgs
from ccatp.errors import CcatpError, ExitStatus
from ccatp.localizer import Localizer
from ccatp.mirror.mirror import build_mirror
from ccatp.records.checkpoint import FILE, Checkpoint, CheckpointFile, read_checkpoint
from ccatp.records.store import MissionStore
from ccatp.records.store_rows import PlannedPoint, StoreError
from ccatp.survey.composition import SurveyParts, assemble
from ccatp.survey.heading_recovery import TakeoverState, doubted
from ccatp.survey.mission import Mission
from ccatp.survey.planning.route import ORDERS
from ccatp.survey.state import HELD, IDLE, MEASURING, SETTLING, MissionState, SurveyOutcome

# Frames between two records: ten a second.
PERIOD_FRAMES = 10
STANDING = (IDLE, SETTLING, MEASURING, HELD, MissionState.DONE)
# Standing still is a matter of a second; a robot that was not at rest yet may still be on its way.
_STILL_M_S, _STILL_RAD_S = 0.002, 0.01


class CheckpointWriter:
    """Keeps the checkpoint up to date."""

    def __init__(self, run_dir: Path, localizer: Localizer, mission: Mission, *, is_patient: bool) -> None:
        before = read_checkpoint(run_dir / FILE)
        self._count = 0 if before is None else before.count
        self._file = CheckpointFile(run_dir / FILE, is_patient=is_patient)
        self._localizer, self._mission = localizer, mission
        self._in_force = ("", "")
        self._left = 1
        self.boot = -1
        self._last_fix = "" if before is None else before.last_fix

    def write_if_due(self, seq: int, t_s: float, elapsed_s: float) -> None:
        """A frame was served; now and then it is written down."""
        self._left -= 1
        if self._left <= 0 or self._mission.state is HELD:
            self.write(seq, t_s, elapsed_s)

    def write(self, seq: int, t_s: float, elapsed_s: float) -> None:
        """Write down where the robot is and what is in force; the latter for good, if it changed."""
        localizer, mission = self._localizer, self._mission
        self._left = PERIOD_FRAMES
        in_force = in_force_of(mission)
        is_news, self._in_force = in_force != self._in_force, in_force
        if mission.done:
            self._last_fix = "{}-{}-{}".format(*mission.done[-1])
        pose = localizer.deck_pose
        numbers = (pose.x_m, pose.y_m, pose.heading_rad, localizer.position_sigma_m, localizer.heading_sigma_rad)
        if not all(map(math.isfinite, numbers)):
            return  # the last good one is a better guess
        self._count += 1
        record = Checkpoint(
            count=self._count,
            boot=self.boot,
            seq=seq,
            t_s=t_s,
            x_m=pose.x_m,
            y_m=pose.y_m,
            heading_rad=pose.heading_rad,
            sigma_m=numbers[3],
            heading_sigma_rad=numbers[4],
            speed_m_s=localizer.speed_m_s,
            rate_rad_s=localizer.rate_rad_s,
            state=str(mission.state),
            abort_cause=in_force[0],
            held_cause=in_force[1],
            elapsed_s=elapsed_s,
            last_fix=self._last_fix,
        )
        self._file.write(record, is_durable=is_news)

    def close(self) -> None:
        """Write what waits."""
        self._file.close()


def in_force_of(mission: Mission) -> tuple[str, str]:
    """Why the survey was given up, and why it waits for an operator; empty where it did or does not.

    One that was stopped on its way home goes home when it goes on. An earthquake is kept by the danger loop.
    """
    if mission.state is MissionState.DONE and mission.outcome is not SurveyOutcome.STOPPED:
        return "", ""
    return mission.abort_cause, mission.cause if mission.is_held_by_hand else ""


def recovery_from(
    run_dir: Path, limits: LimitsConfig, skipped: tuple[PointId, ...] = (), held_cause: str = ""
) -> TakeoverState | None:
    """What a run directory says of a survey that goes on; ``None`` where nobody wrote anything down.

    Args:
        limits: how quickly a robot can have begun to move.
        held_cause: why it begins held, if it does; a hold that is in force goes before.

    Raises:
        CheckpointError: it is damaged.
    """
    record = read_checkpoint(run_dir / FILE)
    if record is None:
        return None
    speeds = record.speed_m_s, record.rate_rad_s
    is_still = abs(speeds[0]) < _STILL_M_S and abs(speeds[1]) < _STILL_RAD_S
    sigma_m, sigma_rad = doubted(
        (record.sigma_m, record.heading_sigma_rad),
        speeds,
        (limits.a_max_m_s2, limits.alpha_max_rad_s2),
        stood=is_still and record.state in STANDING,
    )
    return TakeoverState(
        DeckPose(record.x_m, record.y_m, record.heading_rad),
        sigma_m,
        sigma_rad,
        record.elapsed_s,
        skipped,
        record.abort_cause,
        record.held_cause or held_cause,
    )


class StoreUnusable(CcatpError):
    """The mission's database cannot be made or read."""

    exit_status = ExitStatus.USAGE


def build_parts(args: ProcessArgs) -> tuple[SurveyParts, MissionStore]:
    """All parts of the main loop and the mission's database."""
    cfg = args.config
    mirror = build_mirror(cfg.mirror)
    points = ORDERS[cfg.run.order](mirror, cfg.run.panels)
    try:
        store = _open_store(args, mirror.name, points)
    except StoreError as error:
        raise StoreUnusable(str(error)) from error
    done = store.measured_points()
    recovery = _recovery(args, store, points, done)
    parts = assemble(cfg, done, recovery)
    if recovery is None and args.is_held:
        latched = [f"'ccatp clear {one}'" for one in active_ids(args.run_dir / EMERGENCIES)]
        before = f"the last run ended with an emergency that is not cleared: {', '.join(latched)}; " if latched else ""
        parts.mission.pause(before + _why_held(len(done), points))
        parts.mission.know_emergency()
    return parts, store


def _recovery(
    args: ProcessArgs, store: MissionStore, points: Sequence[PointId], done: set[PointId]
) -> TakeoverState | None:
    if not args.is_taking_over:
        return None
    # A run that is resumed tries again what was skipped; a main loop that takes over does not.
    skipped = tuple(p.point for p in store.points() if p.status == "skipped") if args.is_restarted else ()
    left = [point for point in points if point not in done and point not in skipped]
    recovery = recovery_from(
        args.run_dir, args.config.limits, skipped, _why_held(len(done), left) if args.is_held else ""
    )
    return recovery if recovery is None or args.is_restarted else recovery._replace(elapsed_s=0.0)


def _why_held(done: int, left: Sequence[PointId]) -> str:
    goes_on = f"goes on with point {left[0].row}-{left[0].col}-{left[0].point}" if left else "ends it"
    measured = f"{done} points are measured and will be left out, {len(left)} are to do"
    return f"restarted: {measured}; 'ccatp resume' {goes_on}"


def _open_store(args: ProcessArgs, mirror: str, points: Sequence[PointId]) -> MissionStore:
    path = args.run_dir / "mission.sqlite"
    if args.is_resuming or (args.is_restarted and path.exists()):
        return MissionStore.open(path, mirror=mirror)
    cfg = args.config
    grid = cfg.mirror.panels
    planned = []
    for point in points:
        row, column = divmod(point.point - 1, len(grid.points_x_mm))
        planned.append(PlannedPoint(point, 1e-3 * grid.points_x_mm[column], 1e-3 * grid.points_y_mm[row]))
    text = (args.run_dir / "config.toml").read_text(encoding="utf-8")
    return MissionStore.create(path, mirror=mirror, seed=cfg.run.seed, config_toml=text, points=planned)
