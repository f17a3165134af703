"""Keeps the checkpoint of a survey up to date."""

from math import isfinite
from pathlib import Path

from ccatp.core import NO_CAUSE
from ccatp.daemon.supervision.run_dir import read_run_id
from ccatp.localizer import Localizer
from ccatp.records.checkpoint import CHECKPOINT_FILE, CheckpointFile
from ccatp.survey.composition import Checkpoint
from ccatp.survey.events import HELD
from ccatp.survey.state import SurveyState
from ccatp.survey.statechart import Mission

# Period of the checkpoint in frames, ten per second.
PERIOD_FRAMES = 10


class CheckpointWriter:
    """Keeps the checkpoint up to date; ``boot``: boot number of the robot."""

    def __init__(self, run_dir: Path, localizer: Localizer, mission: Mission, is_patient: bool) -> None:
        self._file = CheckpointFile(run_dir / CHECKPOINT_FILE, is_patient=is_patient)
        self._localizer, self._mission = localizer, mission
        self._run_id = read_run_id(run_dir)
        self._written: SurveyState | None = None
        self._in_force = (NO_CAUSE, NO_CAUSE)
        self._period = -1
        self.boot = -1

    def is_due(self, seq: int) -> bool:
        """Whether to write in this frame: the first of ten, that of an abort, or a change of the state in a hold."""
        if seq // PERIOD_FRAMES != self._period:
            return True
        state = self._mission.state
        return state.abort_cause != self._in_force[0] or (state.mode is HELD and state is not self._written)

    def write(self, seq: int, t_s: float, elapsed_s: float) -> None:
        """Write the state of frame ``seq``; durably if abort or hold changed."""
        state = self._written = self._mission.state
        self._period = seq // PERIOD_FRAMES
        record = Checkpoint.of(
            self._localizer, state, seq, t_s, elapsed_s=elapsed_s, boot=self.boot, run_id=self._run_id
        )
        pose = record.pose
        if not isfinite(pose.x_m + pose.y_m + pose.heading_rad + record.sigma_m + record.heading_sigma_rad):
            return  # keep the last valid one
        before, self._in_force = self._in_force, (state.abort_cause, state.cause if state.is_held_by_hand else NO_CAUSE)
        self._file.write(record, is_durable=self._in_force != before)

    def close(self) -> None:
        """Write the waiting record."""
        self._file.close()
