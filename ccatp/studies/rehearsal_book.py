"""Pure. Truth and estimate of every frame of a rehearsal, on their way to the summary."""

from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np

from ccatp.assembly import Parts
from ccatp.mirror.alignment import PanelMisalignment
from ccatp.mirror.batches import deck_poses
from ccatp.mission import Mission
from ccatp.samples import FloatArray, PanelId, PanelPose
from ccatp.sim.world import TruthRow
from ccatp.summary import RunFacts, SummaryBuilder, puck_targets

_BATCH = 1000  # frames that go to the summary at a time
_RECENT = 64  # frames of truth at hand: more than any delay of the sensors


class RunBook:
    """Keeps rows as they come and converts a thousand at a time.

    Args:
        parts: of the run.
        with_track: keep true and estimated pose of every frame.

    Attributes:
        builder: builds the summary.
    """

    def __init__(self, parts: Parts, *, with_track: bool) -> None:
        """Nothing has happened yet."""
        cfg, mirror = parts.cfg, parts.mirror
        facts = RunFacts(
            mirror=cfg.mirror.name,
            world=cfg.world.name,
            filter=cfg.run.filter,
            seed=cfg.run.seed,
            total_points=parts.total_points,
            lower_bound_s=parts.lower_bound_s,
            budget_s=cfg.run.budget_s,
            puck_height_m=cfg.robot.puck_height_m,
            has_truth=True,
        )
        targets = puck_targets(mirror, parts.points, cfg.robot.puck_height_m)
        self.builder = SummaryBuilder(facts, targets, mirror.surface.normal)
        self._mirror, self._with_track = mirror, with_track
        self._truth: list[TruthRow] = []
        self._recent: deque[TruthRow] = deque(maxlen=_RECENT)
        self._estimates: list[tuple[int, float, PanelPose]] = []
        self._true_rows: list[FloatArray] = []
        self._track_rows: list[FloatArray] = []

    def note_truth(self, row: TruthRow) -> None:
        """The truth at the newest frame."""
        self._truth.append(row)
        self._recent.append(row)

    def note_estimate(self, seq: int, t_s: float, pose: PanelPose) -> None:
        """The estimate after frame ``seq``."""
        self._estimates.append((seq, t_s, pose))
        if len(self._estimates) >= _BATCH:
            self._flush()

    def truth_at(self, seq: int) -> TruthRow:
        """The truth at one of the newest frames."""
        return next(row for row in self._recent if row[0] == seq)

    def _flush(self) -> None:
        if self._truth:
            truth = np.array(self._truth, dtype=np.float64)
            self._truth.clear()
            self.builder.add_truth(truth)
            if self._with_track:
                self._true_rows.append(truth[:, :5])
        if self._estimates:
            seqs, times_s, poses = zip(*self._estimates, strict=True)
            self._estimates.clear()
            x, y, heading, z = deck_poses(self._mirror, poses).T
            rows = np.column_stack([np.array(seqs, dtype=np.float64), times_s, x, y, heading, x, y, z])
            self.builder.add_track(rows)
            if self._with_track:
                self._track_rows.append(rows[:, :5])

    def summary(
        self,
        mission: Mission,
        mission_time_s: float,
        fits: Mapping[PanelId, tuple[float, float, float]],
        misalignments: Mapping[PanelId, PanelMisalignment],
    ) -> dict[str, Any]:
        """The summary of the whole run.

        Args:
            mission: at its end.
            mission_time_s: robot time from start to end.
            fits: panels as fitted: piston (m), tip and tilt (rad).
            misalignments: panels as they really are.
        """
        self._flush()
        injected = {panel: (m.piston_m, m.tip_rad, m.tilt_rad) for panel, m in misalignments.items()}
        self.builder.set_mission(len(mission.done), len(mission.skipped), mission_time_s)
        self.builder.set_panels(fits, injected)
        return self.builder.build()

    def track(self) -> FloatArray | None:
        """Rows of t, true x, y, heading, estimated x, y, heading, shape (k, 7), after the summary; None without."""
        if not self._track_rows:
            return None
        true, rows = np.concatenate(self._true_rows), np.concatenate(self._track_rows)
        _, i, j = np.intersect1d(true[:, 0], rows[:, 0], return_indices=True)
        return np.column_stack([true[i, 1:], rows[j, 2:]])
