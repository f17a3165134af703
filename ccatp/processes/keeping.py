"""Glue. What the main loop writes down for a successor, and what it takes over from a predecessor."""

import math
from pathlib import Path

from ccatp.config.models import LimitsConfig
from ccatp.localizer import Localizer
from ccatp.mission import Mission
from ccatp.samples import DeckPose, PointId
from ccatp.storage.checkpoint import FILE, Checkpoint, CheckpointFile, read_checkpoint
from ccatp.surveying.recovery import Recovery, doubted
from ccatp.surveying.states import HELD, IDLE, MEASURING, SETTLING, Outcome, State

# Frames between two records: ten a second.
PERIOD_FRAMES = 10
STANDING = (IDLE, SETTLING, MEASURING, HELD, State.DONE)
# Standing still is a matter of a second; a robot that was not at rest yet may still be on its way.
_STILL_M_S, _STILL_RAD_S = 0.002, 0.01


class Keeper:
    """Keeps the checkpoint up to date.

    Args:
        run_dir: where it is.
        localizer: knows the pose.
        mission: knows what is in force.
        is_patient: simulated time waits for the writer.
    """

    def __init__(self, run_dir: Path, localizer: Localizer, mission: Mission, *, is_patient: bool) -> None:
        """Number on from the last record there."""
        before = read_checkpoint(run_dir / FILE)
        self._count = 0 if before is None else before.count
        self._file = CheckpointFile(run_dir / FILE, is_patient=is_patient)
        self._localizer, self._mission = localizer, mission
        self._in_force = ("", "")
        self._left = 1
        self.boot = -1
        self._last_fix = "" if before is None else before.last_fix

    def frame(self, seq: int, t_s: float, elapsed_s: float) -> None:
        """A frame was served; now and then it is written down."""
        self._left -= 1
        if self._left <= 0 or self._mission.state is HELD:
            self.keep(seq, t_s, elapsed_s)

    def keep(self, seq: int, t_s: float, elapsed_s: float) -> None:
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
    if mission.state is State.DONE and mission.outcome is not Outcome.STOPPED:
        return "", ""
    return mission.abort_cause, mission.cause if mission.is_held_by_hand else ""


def recovery_from(
    run_dir: Path, limits: LimitsConfig, skipped: tuple[PointId, ...] = (), held_cause: str = ""
) -> Recovery | None:
    """What a run directory says of a survey that goes on; ``None`` where nobody wrote anything down.

    Args:
        run_dir: the run directory.
        limits: how quickly a robot can have begun to move.
        skipped: points that stay given up.
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
    return Recovery(
        DeckPose(record.x_m, record.y_m, record.heading_rad),
        sigma_m,
        sigma_rad,
        record.elapsed_s,
        skipped,
        record.abort_cause,
        record.held_cause or held_cause,
    )
