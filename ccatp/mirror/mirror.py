"""The geometry of a mirror for the robot: surface, frames, panels, rim and poses."""

from collections.abc import Mapping, Sequence
from itertools import groupby
from math import atan2, cos, hypot, pi, sin
from typing import Literal

import numpy as np

from ccatp.config.models import MirrorConfig
from ccatp.core import DeckPose, FloatArray, PanelId, PanelPose, PointId, Vector3
from ccatp.kinematics import wrap_pi
from ccatp.mirror.layout import POINTS_PER_PANEL, POINTS_PER_ROW, Panel, PanelGrid
from ccatp.mirror.rim import build_rim
from ccatp.mirror.surface import Axes, Surface, UnknownPanelError, build_surface

# Length of the way home over the straight line. Planned ways follow rows, columns and the steps of the rim, and are up
# to 1.47 times as long on the mirrors of the telescope.
_HOME_DETOUR = 1.5


class Mirror:
    """A telescope mirror: geometry only, without state. Points are in metres.

    It stands in the world by p_mirror = R (p_world - origin), R = [[1, 0, 0], [0, c, s], [0, -s, c]]; the deck frame is
    the mirror frame turned by pi about its y axis where ``drive_side`` is -1, else the mirror frame. ``surface`` is in
    the deck frame, ``rim`` in the deck plane, ``collimators_m`` (k, 3) of the laser ``channels`` in the world frame.
    ``gravity_deck``: unit vector of gravity.
    """

    def __init__(self, cfg: MirrorConfig) -> None:
        x, y, z = cfg.frame.origin_world_mm
        self.origin_m = x * 1e-3, y * 1e-3, z * 1e-3
        self.c, self.s = cos(cfg.frame.rotation_about_x_rad), sin(cfg.frame.rotation_about_x_rad)
        self.drive_side: int = cfg.frame.reflecting_side_sign
        self.gravity_deck = self.rotate_deck_from_world(cfg.frame.gravity_world)
        self.name, self.overhang = cfg.name, cfg.overhang
        self.gap_m = cfg.panels.gap_mm * 1e-3
        self.surface = build_surface(cfg.surface, self.drive_side)
        self.grid = PanelGrid(cfg.panels)
        self.rows, self.cols = self.grid.rows, self.grid.cols
        half = self.grid.half_x_m, self.grid.half_y_m
        self.panels: dict[PanelId, Panel] = {
            pid: Panel(pid, x, y, *half, self.surface.point(x, y), self.surface.axes(x, y))
            for pid in self.grid.ids
            for x, y in (self.grid.centre(pid),)
        }
        self.rim = build_rim(self.grid)
        self._points_x = tuple(x * 1e-3 for x in cfg.panels.points_x_mm)
        self._points_y = tuple(y * 1e-3 for y in cfg.panels.points_y_mm)
        # The data have offsets along the axes of the mirror frame; on M1 the deck's x has the opposite direction.
        adjusters = _named(cfg.panels.adjusters_mm, cfg.adjusters.order)
        self._adjusters = {name: (self.drive_side * x * 1e-3, y * 1e-3) for name, (x, y) in adjusters.items()}
        self.channels = cfg.collimators.channels
        self.collimators_m: FloatArray = np.array(cfg.collimators.positions_world_mm, dtype=np.float64) * 1e-3
        self.panel_at, self.is_on_panel = self.grid.panel_at, self.grid.is_on_panel
        self.nearest_panel, self.nearest_seam = self.grid.nearest_panel, self.grid.nearest_seam
        self.surface_point = self.surface.point
        base = cfg.base
        self.base_panel_pose = PanelPose(
            PanelId(base.row, base.col), base.x_mm * 1e-3, base.y_mm * 1e-3, base.heading_rad
        )
        self.base_pose = self.deck_pose(self.base_panel_pose)

    def home_way_m(self, x_m: float, y_m: float) -> float:
        """Upper estimate of the length of the way from a place on the deck to base, without planning a route."""
        return _HOME_DETOUR * hypot(x_m - self.base_pose.x_m, y_m - self.base_pose.y_m)

    def deck_from_mirror(self, p: Vector3) -> Vector3:
        """Deck coordinates of a point given in the mirror frame, m; also the inverse."""
        return p if self.drive_side > 0 else (-p[0], p[1], -p[2])

    mirror_from_deck = deck_from_mirror

    def mirror_from_world(self, p: Vector3) -> Vector3:
        """Mirror coordinates of a point given in the world frame, m."""
        dx, dy, dz = p[0] - self.origin_m[0], p[1] - self.origin_m[1], p[2] - self.origin_m[2]
        return dx, self.c * dy + self.s * dz, self.c * dz - self.s * dy

    def world_from_mirror(self, p: Vector3) -> Vector3:
        """World coordinates of a point given in the mirror frame, m."""
        x, y, z = p
        o = self.origin_m
        return x + o[0], self.c * y - self.s * z + o[1], self.s * y + self.c * z + o[2]

    def world_from_deck(self, p: Vector3) -> Vector3:
        """World coordinates of a point given in the deck frame, m."""
        return self.world_from_mirror(self.mirror_from_deck(p))

    def deck_from_world(self, p: Vector3) -> Vector3:
        """Deck coordinates of a point given in the world frame, m."""
        return self.deck_from_mirror(self.mirror_from_world(p))

    def rotate_world_from_deck(self, v: Vector3) -> Vector3:
        """World components of a vector given in the deck frame."""
        x, y, z = self.mirror_from_deck(v)
        return x, self.c * y - self.s * z, self.s * y + self.c * z

    def rotate_deck_from_world(self, v: Vector3) -> Vector3:
        """Deck components of a vector given in the world frame."""
        x, y, z = v
        return self.deck_from_mirror((x, self.c * y + self.s * z, self.c * z - self.s * y))

    def panel(self, panel: PanelId) -> Panel:
        """The panel with this row and column; raises ``UnknownPanelError``."""
        try:
            return self.panels[panel]
        except KeyError:
            raise UnknownPanelError(f"{self.name} has no panel in row {panel[0]}, column {panel[1]}") from None

    def point_on_deck(self, pid: PointId) -> tuple[float, float]:
        """Deck (x, y) of a measurement point (thesis fig. 2.2), m.

        The nominal offset in the panel's plane is projected on the surface along the panel's normal. Raises
        ``UnknownPanelError``: no such panel, or no such number of a point.
        """
        if not 1 <= pid.point <= POINTS_PER_PANEL:
            raise UnknownPanelError(f"measurement point {pid.point} of panel {pid[:2]}: numbers run from 1 to 9")
        j, i = divmod(pid.point - 1, POINTS_PER_ROW)
        return self._dropped(self.panel(pid.panel), self._points_x[i], self._points_y[j])

    def point_ids(self, panel: PanelId) -> tuple[PointId, ...]:
        """The nine measurement points of a panel, in the order of their numbers."""
        return tuple(PointId(panel.row, panel.col, k) for k in range(1, POINTS_PER_PANEL + 1))

    def adjusters_on_deck(self, panel: PanelId) -> dict[str, tuple[float, float]]:
        """Deck (x, y) of each vertical adjuster of a panel, m."""
        p = self.panel(panel)
        return {name: self._dropped(p, x, y) for name, (x, y) in self._adjusters.items()}

    def deck_pose(self, p: PanelPose) -> DeckPose:
        """Deck pose of a pose in a panel frame; raises ``UnknownPanelError``."""
        panel = self.panel(p.panel)
        x, y = self._dropped(panel, p.x_m, p.y_m)
        e1, e2, n = self.surface.axes(x, y)
        c, s = cos(p.heading_rad), sin(p.heading_rad)
        # The heading lies in the tangent plane at the robot and projects on (c, s, 0) of the panel frame.
        ux, uy, uz = panel.rotate_to_deck((c, s, 0.0))
        zx, zy, zz = panel.axes[2]
        lift = -_dot((ux, uy, uz), n) / _dot(panel.axes[2], n)
        h = ux + lift * zx, uy + lift * zy, uz + lift * zz
        return DeckPose(x, y, atan2(_dot(h, e2), _dot(h, e1)))

    def panel_pose(self, panel: PanelId, p: DeckPose) -> PanelPose:
        """Pose in the frame of ``panel``, which need not be the one under the robot; raises ``UnknownPanelError``."""
        found = self.panel(panel)
        x, y, _ = found.from_deck(self.surface.point(p.x_m, p.y_m))
        hx, hy, _ = found.rotate_from_deck(self.robot_axes(p)[0])
        return PanelPose(panel, x, y, atan2(hy, hx))

    def robot_axes(self, p: DeckPose) -> Axes:
        """Axes (h, n x h, n) of the robot frame in the deck frame; ``h = cos(psi) e1 + sin(psi) e2``."""
        (e1x, _, e1z), (e2x, e2y, e2z), n = self.surface.axes(p.x_m, p.y_m)
        c, s = cos(p.heading_rad), sin(p.heading_rad)
        return (c * e1x + s * e2x, s * e2y, c * e1z + s * e2z), (c * e2x - s * e1x, c * e2y, c * e2z - s * e1z), n

    def deck_from_robot(self, p: DeckPose, v: Vector3) -> Vector3:
        """Deck coordinates of a point given in the frame of a robot at ``p``, m."""
        (hx, hy, hz), (lx, ly, lz), (nx, ny, nz) = self.robot_axes(p)
        a, b, c = v
        x, y, z = self.surface.point(p.x_m, p.y_m)
        return x + a * hx + b * lx + c * nx, y + a * hy + b * ly + c * ny, z + a * hz + b * lz + c * nz

    def body_axes(self, p: DeckPose) -> tuple[float, float, float, float]:
        """Deck-plane components (hx, hy, lx, ly) of the robot's x axis h and y axis l.

        A point (ox, oy, 0) of the robot frame lies at deck ``(x + ox hx + oy lx, y + ox hy + oy ly)``.
        """
        e1, e2, _ = self.surface.axes(p.x_m, p.y_m)
        c, s = cos(p.heading_rad), sin(p.heading_rad)
        return c * e1[0] + s * e2[0], s * e2[1], c * e2[0] - s * e1[0], c * e2[1]

    def body_offset(self, p: DeckPose, ox: float, oy: float) -> tuple[float, float]:
        """Deck (x, y) of the robot-frame point (ox, oy, 0) on the tangent plane, m."""
        hx, hy, lx, ly = self.body_axes(p)
        return p.x_m + ox * hx + oy * lx, p.y_m + ox * hy + oy * ly

    def puck_world(self, p: DeckPose, height_m: float) -> Vector3:
        """World position of the puck's centre: surface point plus ``height_m`` along the normal, m."""
        x, y, z = self.surface.point(p.x_m, p.y_m)
        nx, ny, nz = self.surface.normal(p.x_m, p.y_m)
        return self.world_from_deck((x + height_m * nx, y + height_m * ny, z + height_m * nz))

    def foot_of_puck(self, world: Vector3, height_m: float) -> tuple[float, float, float]:
        """Deck foot (x, y) of a puck and its height above the surface, m; raises ``ConvergenceError`` far from it."""
        x, y, distance = self.surface.foot(self.deck_from_world(world))
        return x, y, distance - height_m

    def seam_normal_angle(self, panel: PanelId, axis: Literal["x", "y"], x: float, y: float) -> float:
        """Angle in the frame of ``panel`` of the normal of the seam ``axis`` = const through a deck point, rad.

        The normal is the seam's tangent turned within the panel plane to the side on which ``axis`` grows.
        """
        fx, fy = self.surface.gradient(x, y)
        tangent = (0.0, 1.0, fy) if axis == "x" else (1.0, 0.0, fx)
        tx, ty, _ = self.panel(panel).rotate_from_deck(tangent)
        return wrap_pi(atan2(ty, tx) + (-pi / 2.0 if axis == "x" else pi / 2.0))

    def gravity_in_robot(self, p: DeckPose) -> Vector3:
        """Unit vector of gravity in the frame of a robot at ``p``."""
        gx, gy, gz = self.gravity_deck
        (hx, hy, hz), (lx, ly, lz), (nx, ny, nz) = self.robot_axes(p)
        return hx * gx + hy * gy + hz * gz, lx * gx + ly * gy + lz * gz, nx * gx + ny * gy + nz * gz

    def _dropped(self, panel: Panel, x: float, y: float) -> tuple[float, float]:
        deck_x, deck_y, _ = self.surface.drop(panel.to_deck((x, y, 0.0)), panel.axes[2])
        return deck_x, deck_y


def _dot(a: Vector3, b: Vector3) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


# Names of the observatory's own tool, by the signs of an adjuster's x and y in the axes of the mirror frame.
_OBSERVATORY = {(-1, 1): "v1", (-1, -1): "v2", (1, 1): "v3", (1, -1): "v4", (0, 0): "v5"}


def _named(adjusters_mm: Mapping[str, tuple[float, float]], order: str) -> dict[str, tuple[float, float]]:
    """Offsets of the adjusters by their names in an order."""
    if order == "manufacturer":
        return dict(adjusters_mm)
    return dict(sorted((_OBSERVATORY[_sign(x), _sign(y)], (x, y)) for x, y in adjusters_mm.values()))


def _sign(value: float) -> int:
    return (value > 0.0) - (value < 0.0)


def build_mirror(cfg: MirrorConfig) -> Mirror:
    """The geometry of a mirror from its validated configuration."""
    return Mirror(cfg)


# Newton steps along the panel's normal to the surface. They start at most some mm away, where the slope is almost the
# same: the first step leaves 2e-7 m, the second less than rounding.
_DROP_STEPS = 2


def deck_rows(mirror: Mirror, panels: Sequence[tuple[int, int]], places: FloatArray) -> FloatArray:
    """``Mirror.deck_pose`` of many poses: deck x, y (m), heading (rad) and height (m), shape (k, 4).

    ``places`` (k, 3) are x, y (m) and heading (rad) in the frames of the panels (row, column).
    """
    rows = np.empty((len(panels), 4))
    start = 0
    for panel, run in groupby(panels):
        end = start + sum(1 for _ in run)
        rows[start:end] = _on_panel(mirror.surface, mirror.panel(PanelId(*panel)), places[start:end])
        start = end
    return rows


def _on_panel(surface: Surface, panel: Panel, places: FloatArray) -> FloatArray:
    axes = np.array(panel.axes)
    points = np.array(panel.origin) + places[:, :2] @ axes[:2]
    for _ in range(_DROP_STEPS):
        x, y, z = points.T
        f, fx, fy = surface.heights_and_gradients(x, y)
        gap = (f - z) / (axes[2, 2] - fx * axes[2, 0] - fy * axes[2, 1])
        points += gap[:, None] * axes[2]
    x, y, z = points.T
    fx, fy = surface.gradients(x, y)
    # The heading lies in the tangent plane at the robot and projects on (cos, sin, 0) of the panel frame.
    c, d = np.cos(places[:, 2]), np.sin(places[:, 2])
    ax, ay, az = (c * p + d * q for p, q in zip(axes[0], axes[1], strict=True))
    bx, by, bz = axes[2]
    along = (az - fx * ax - fy * ay) / (bz - fx * bx - fy * by)
    hx, hy, hz = ax - along * bx, ay - along * by, az - along * bz
    # Its components along the axes e1 and e2 of ``Surface.axes``, both times sqrt(1 + fx^2).
    s2 = 1.0 + fx * fx
    heading = np.arctan2((s2 * hy + fy * hz - fx * fy * hx) / np.sqrt(s2 + fy * fy), hx + fx * hz)
    return np.column_stack([x, y, heading, z])
