"""A rehearsal that keeps what the Cramér-Rao bound is computed from: true way, seams, fixes."""

from array import array
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ccatp.config.models import Config
from ccatp.core import Fix, FloatArray, PanelId, PointId
from ccatp.estimation.fixes import deck_foot
from ccatp.estimation.seams import EdgeScanner, SensorTransition
from ccatp.links.robot_messages import Sensors
from ccatp.mirror.mirror import Mirror
from ccatp.studies.sil_run import SilResult, SilRun

T, X, Y, HX, HY, LX, LY, FX, FY, RIGHT, LEFT, RIGHT_SCALE, LEFT_SCALE, ORDERED = range(14)
"""Columns of the way.

T: time, s. X, Y: robot origin, deck frame, m. HX, HY, LX, LY: deck components of the robot's x and y axes. FX, FY:
slopes of the surface. RIGHT, LEFT: wheel angles since boot, rad. RIGHT_SCALE, LEFT_SCALE: travel of the body over
travel of the nominal wheel in the frame that ends here. ORDERED: 1 where a set point of that frame was not zero.
"""
COLUMNS = 14


class SeamPass(NamedTuple):
    """An edge sensor changed its value over a panel's edge.

    Attributes:
        frame: index of the row that ends the frame in which it did.
        axis: deck axis across the edge, 0 or 1.
        edge: which edge: axis, panel, and whether it is the one on the high side.
    """

    frame: int
    corner: int
    interval_s: float
    axis: int
    edge: tuple[int, PanelId, bool]


class StopFix(NamedTuple):
    """A fix at rest.

    Attributes:
        point: where it was taken; None where it was not for a point.
        covariance_m2: of the foot (x, y), deck frame, from the lengths alone, shape (2, 2).
        error_m: true minus estimated position before the fix (x, y), m.
    """

    frame: int
    point: PointId | None
    panel: PanelId
    covariance_m2: FloatArray
    error_m: tuple[float, float]


@dataclass(frozen=True, slots=True)
class TrueRecord:
    """What happened in one rehearsal.

    Attributes:
        way: a row per frame from the boot on, columns as named above, shape (k, 14).
    """

    way: FloatArray
    passes: tuple[SeamPass, ...]
    fixes: tuple[StopFix, ...]
    base_m: float


class RecordedSilRun(SilRun):
    """A rehearsal with its record; everything random stays as it is without."""

    def __init__(self, cfg: Config, *, with_track: bool = False) -> None:
        super().__init__(cfg, with_track=with_track)
        self._way = array("d")
        self._scanner = EdgeScanner()
        self._transitions: list[SensorTransition] = []
        self._fixes: list[StopFix] = []

    def record(self) -> TrueRecord:
        """The record so far."""
        way = np.frombuffer(self._way, dtype=np.float64).reshape(-1, COLUMNS).copy()
        sensors = self.cfg.robot.edge_sensors_m
        passes = passes_of(self.mirror, sensors, way, self._transitions, self.robot.frame_s)
        return TrueRecord(way, passes, tuple(self._fixes), self.robot.world.wheels.base_m)

    def _note_truth(self) -> None:
        super()._note_truth()
        p = self.robot.world.plant
        right_set, _, left_set, _ = p.servo
        self._way.extend(
            (
                self.robot.t_s, p.x_m, p.y_m, p.hx, p.hy, p.lx, p.ly, p.fx, p.fy, p.right_angle_rad, p.left_angle_rad,
                p.right_scale, p.left_scale, float(right_set != 0.0 or left_set != 0.0),
            )
        )  # fmt: skip

    def _serve(self, frame: Sensors, dt_s: float) -> None:
        self._transitions += self._scanner.scan(frame.edge)
        super()._serve(frame, dt_s)

    def _fuse(self, fix: Fix) -> None:
        plant, deck = self.robot.world.plant, self.localizer.deck_pose
        panel = self.mirror.nearest_panel(plant.x_m, plant.y_m)
        covariance = deck_foot(self.mirror, fix, self.cfg.robot.puck_height_m).covariance_m2
        error_m = plant.x_m - deck.x_m, plant.y_m - deck.y_m
        row = len(self._way) // COLUMNS - 1
        self._fixes.append(StopFix(row, self.mission.measuring_point, panel, covariance, error_m))
        super()._fuse(fix)


def rehearse_recorded(cfg: Config, *, with_track: bool = False) -> tuple[SilResult, TrueRecord]:
    """Survey the mirror of a configuration in its world, and keep the record.

    Args:
        cfg: the configuration; ``run.seed`` seeds everything.
        with_track: keep true and estimated pose of every frame.
    """
    rehearsing = RecordedSilRun(cfg, with_track=with_track)
    return rehearsing.run(), rehearsing.record()


def passes_of(
    mirror: Mirror,
    sensors_m: tuple[tuple[float, float], ...],
    way: FloatArray,
    transitions: list[SensorTransition],
    frame_s: float,
) -> tuple[SeamPass, ...]:
    """Which edges the transitions belong to, from the true way; those over the rim are left out.

    Args:
        sensors_m: places of the edge sensors, robot frame.
        way: as in ``TrueRecord``, its first row at t = 0.
    """
    found = []
    for transition in transitions:
        at = transition.t_s / frame_s
        frame = min(int(np.ceil(at - 1e-9)), len(way) - 1)
        part = at - (frame - 1)
        row = way[frame - 1] + part * (way[frame] - way[frame - 1])
        ahead, left = sensors_m[transition.corner]
        place = (float(row[X] + ahead * row[HX] + left * row[LX]), float(row[Y] + ahead * row[HY] + left * row[LY]))
        seam = mirror.nearest_seam(*place)
        panel = mirror.panels[mirror.nearest_panel(*place)]
        if seam is None:
            continue
        axis = 0 if seam.axis == "x" else 1
        beyond_m = place[axis] - (panel.x_m, panel.y_m)[axis]
        edge = axis, panel.id, beyond_m > 0.0
        found.append(SeamPass(frame, transition.corner, transition.interval_s, axis, edge))
    return tuple(found)
