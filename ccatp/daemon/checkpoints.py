"""Checkpoint of a main loop, and its parts and database: new, resumed, or taken over."""

import math
from collections.abc import Sequence
from pathlib import Path

from ccatp.config.models import Config, LimitsConfig
from ccatp.core import DeckPose, PointId
from ccatp.daemon.danger_loop import FILE as EMERGENCIES
from ccatp.daemon.danger_loop import active_ids
from ccatp.daemon.process import ProcessArgs
from ccatp.errors import CcatpError, ExitStatus
from ccatp.localizer import Localizer
from ccatp.mirror.mirror import build_mirror
from ccatp.records.checkpoint import FILE, Checkpoint, CheckpointFile, read_checkpoint
from ccatp.records.store import MissionStore, PlannedPoint, StoreError
from ccatp.survey.composition import SurveyParts, assemble
from ccatp.survey.heading_recovery import TakeoverState, doubted
from ccatp.survey.planning.route import ORDERS
from ccatp.survey.state import (
    HELD,
    IDLE,
    MEASURING,
    SETTLING,
    EmergencyKnown,
    MissionState,
    Pause,
    SurveyOutcome,
    SurveyState,
)
from ccatp.survey.statechart import Mission

# Frames between two records: ten a second.
PERIOD_FRAMES = 10
STANDING = (IDLE, SETTLING, MEASURING, HELD, MissionState.DONE)
# Below this a robot that is in a standing state is at rest.
_STILL_M_S, _STILL_RAD_S = 0.002, 0.01


class CheckpointWriter:
    """Keeps the checkpoint up to date; ``boot`` is the robot's."""

    def __init__(self, run_dir: Path, localizer: Localizer, mission: Mission, is_patient: bool) -> None:
        before = read_checkpoint(run_dir / FILE)
        self._count, self._last_fix = (0, "") if before is None else (before.count, before.last_fix)
        self._file = CheckpointFile(run_dir / FILE, is_patient=is_patient)
        self._localizer, self._mission = localizer, mission
        self._in_force = ("", "")
        self._left = 1
        self.boot = -1

    def write_if_due(self, seq: int, t_s: float, elapsed_s: float) -> None:
        """Write in every tenth frame, and in each while the mission is held."""
        self._left -= 1
        if self._left <= 0 or self._mission.state.mode is HELD:
            self.write(seq, t_s, elapsed_s)

    def write(self, seq: int, t_s: float, elapsed_s: float) -> None:
        """Write the state of frame ``seq``; durably where abort or hold changed."""
        localizer, state = self._localizer, self._mission.state
        self._left = PERIOD_FRAMES
        in_force = in_force_of(state)
        has_changed, self._in_force = in_force != self._in_force, in_force
        if state.done:
            self._last_fix = "{}-{}-{}".format(*state.done[-1])
        pose, sigma_m, sigma_rad = localizer.deck_pose, localizer.position_sigma_m, localizer.heading_sigma_rad
        if not all(map(math.isfinite, (pose.x_m, pose.y_m, pose.heading_rad, sigma_m, sigma_rad))):
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
            sigma_m=sigma_m,
            heading_sigma_rad=sigma_rad,
            speed_m_s=localizer.speed_m_s,
            rate_rad_s=localizer.rate_rad_s,
            state=str(state.mode),
            abort_cause=in_force[0],
            held_cause=in_force[1],
            elapsed_s=elapsed_s,
            last_fix=self._last_fix,
        )
        self._file.write(record, is_durable=has_changed)

    def close(self) -> None:
        """Write the record that waits."""
        self._file.close()


def in_force_of(state: SurveyState) -> tuple[str, str]:
    """Cause of an abort, and of a hold that needs an operator; empty without one.

    A survey that was stopped on its way home goes home when it is resumed. An earthquake is kept by the danger loop.
    """
    if state.mode is MissionState.DONE and state.outcome is not SurveyOutcome.STOPPED:
        return "", ""
    return state.abort_cause, state.cause if state.is_held_by_hand else ""


def recovery_from(
    run_dir: Path, limits: LimitsConfig, skipped: tuple[PointId, ...] = (), held_cause: str = ""
) -> TakeoverState | None:
    """State of a survey that goes on, from its run directory; ``None`` without a checkpoint.

    The limits bound the motion since then. ``held_cause`` is a reason to begin held; a hold in force takes precedence.

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


def build_parts(cfg: Config, args: ProcessArgs) -> tuple[SurveyParts, MissionStore]:
    """All parts of the main loop and the mission's database."""
    mirror = build_mirror(cfg.mirror)
    points = ORDERS[cfg.run.order](mirror, cfg.run.panels)
    try:
        store = _open_store(cfg, args, mirror.name, points)
    except StoreError as error:
        raise StoreUnusable(str(error)) from error
    done = store.measured_points()
    recovery = None
    if args.is_taking_over:
        # A resumed run tries skipped points again; a main loop that takes over does not.
        skipped = tuple(p.point for p in store.points() if p.status == "skipped") if args.is_restarted else ()
        left = [point for point in points if point not in done and point not in skipped]
        held_cause = _why_held(len(done), left) if args.is_held else ""
        recovery = recovery_from(args.run_dir, cfg.limits, skipped, held_cause)
        if recovery is not None and not args.is_restarted:
            recovery = recovery._replace(elapsed_s=0.0)
    parts = assemble(cfg, done, recovery)
    if recovery is None and args.is_held:
        latched = [f"'ccatp clear {one}'" for one in active_ids(args.run_dir / EMERGENCIES)]
        before = f"the last run ended with an emergency that is not cleared: {', '.join(latched)}; " if latched else ""
        parts.mission.handle(Pause(before + _why_held(len(done), points)))
        parts.mission.handle(EmergencyKnown())
    return parts, store


def _why_held(done: int, left: Sequence[PointId]) -> str:
    goes_on = f"goes on with point {left[0].row}-{left[0].col}-{left[0].point}" if left else "ends it"
    measured = f"{done} points are measured and will be left out, {len(left)} are to do"
    return f"restarted: {measured}; 'ccatp resume' {goes_on}"


def _open_store(cfg: Config, args: ProcessArgs, mirror: str, points: Sequence[PointId]) -> MissionStore:
    path = args.run_dir / "mission.sqlite"
    if args.is_resuming or (args.is_restarted and path.exists()):
        return MissionStore.open(path, mirror=mirror)
    grid = cfg.mirror.panels
    planned = []
    for point in points:
        row, column = divmod(point.point - 1, len(grid.points_x_mm))
        planned.append(PlannedPoint(point, 1e-3 * grid.points_x_mm[column], 1e-3 * grid.points_y_mm[row]))
    text = (args.run_dir / "config.toml").read_text(encoding="utf-8")
    return MissionStore.create(path, mirror=mirror, seed=cfg.run.seed, config_toml=text, points=planned)
