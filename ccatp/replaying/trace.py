"""Pure. Poses of a robot, frame by frame."""

from array import array
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ccatp.mirror.batches import FloatArray, deck_poses
from ccatp.mirror.mirror import Mirror
from ccatp.samples import IntArray, PanelId, PanelPose


class Trace(NamedTuple):
    """Poses after k frames.

    Attributes:
        seq: numbers of the frames, growing, shape (k,).
        t_s: robot time, shape (k,).
        pose: deck x, y (m) and heading (rad), shape (k, 3).
        height_m: of the surface there, deck frame, shape (k,).
        covariance: of ``pose``, shape (k, 3, 3); None where it is not known.
    """

    seq: IntArray
    t_s: FloatArray
    pose: FloatArray
    height_m: FloatArray
    covariance: FloatArray | None = None

    @property
    def place(self) -> FloatArray:
        """Points on the surface, deck frame, m, shape (k, 3)."""
        return np.column_stack([self.pose[:, :2], self.height_m])

    def moved_to(self, mirror: Mirror, pose: FloatArray, covariance: FloatArray) -> "Trace":
        """The same frames with other poses (k, 3) and covariances (k, 3, 3)."""
        heights = mirror.surface.heights_m(pose[:, 0], pose[:, 1])
        return Trace(self.seq, self.t_s, pose, heights, covariance)


class TraceBuilder:
    """Collects poses in panel frames, in little memory."""

    def __init__(self) -> None:
        self._names = array("q")  # frame, row, column
        self._rows = array("d")  # time, x, y, heading
        self._covariances = array("d")

    def add(self, seq: int, t_s: float, row: int, col: int, pose: tuple[float, float, float]) -> None:
        """A pose (x, y, heading) in the frame of panel (row, col)."""
        self._names.extend((seq, row, col))
        self._rows.extend((t_s, *pose))

    def add_covariance(self, covariance: FloatArray) -> None:
        """Of the pose added last, deck frame, shape (3, 3)."""
        self._covariances.extend(covariance.ravel().tolist())

    def build(self, mirror: Mirror) -> Trace:
        """The trace, in the deck frame."""
        names = np.array(self._names, dtype=np.int64).reshape(-1, 3)
        rows = np.array(self._rows).reshape(-1, 4)
        poses = [
            PanelPose(PanelId(row, col), x, y, heading)
            for (_, row, col), (_, x, y, heading) in zip(names.tolist(), rows.tolist(), strict=True)
        ]
        deck = deck_poses(mirror, poses)
        covariance = np.array(self._covariances).reshape(-1, 3, 3) if self._covariances else None
        return Trace(names[:, 0], rows[:, 0], deck[:, :3], deck[:, 3], covariance)


def trace_of_truth(rows: Sequence[Sequence[float]] | FloatArray) -> Trace:
    """The simulated truth; rows as in the topic ``truth``."""
    table = np.asarray(rows, dtype=np.float64).reshape(-1, 11)
    return Trace(table[:, 0].astype(np.int64), table[:, 1], table[:, 2:5], table[:, 7])
