"""Pure. Seams as position measurements: where an edge sensor changes its value, it stands over a panel's edge."""

from math import cos, sin, sqrt
from typing import NamedTuple

import numpy as np

from ccatp.config.models import RobotConfig
from ccatp.filters.base import FloatArray
from ccatp.localization.crossing import Transition
from ccatp.localization.survey_model import E0, E1, PSI, STATES, A, V, W, X
from ccatp.localization.terrain import Slope
from ccatp.mirror.mirror import Mirror
from ccatp.samples import PanelId

# An edge is taken for a seam where the sensor is expected within this part of a panel's size from one; whatever else it
# can be (the rim, the next seam) is at least ten times further.
_REACH = 0.05
_UNIFORM = 1.0 / 12.0  # variance of a uniform distribution over one interval
_TIMING_FLOOR_M2 = 1e-10  # (10 um)^2: the sensor's own repeatability, UNVERIFIED


class Edge(NamedTuple):
    """A panel's edge that a sensor has crossed.

    Attributes:
        k: the deck axis across it, 0 or 1.
        position_m: where the map has it, along that axis.
        offset: index of the state that holds how far it lies from there.
        is_new: it was not crossed before, its offset is unknown.
    """

    k: int
    position_m: float
    offset: int
    is_new: bool


class Line(NamedTuple):
    """One sensor over one edge: ``sensor - edge - offset = 0`` along one axis.

    Attributes:
        residual_m: zero minus the expectation.
        H: row of the measurement model, shape (1, n).
        variance_m2: of the sensor's place at the transition.
    """

    residual_m: float
    H: FloatArray
    variance_m2: float


class SeamLines:
    """Turns transitions of the edge sensors into lines.

    An edge lies some tenths of a millimetre from where the map has it, but all four sensors cross the same edge: its
    offset is a state, so that what they say *against each other* (heading, travel from front to rear) counts with the
    precision of the timing, and only what they say together with that of the map.

    Args:
        mirror: where the seams are.
        robot: where the sensors are.
    """

    def __init__(self, mirror: Mirror, robot: RobotConfig) -> None:
        self._mirror = mirror
        self._sensors = robot.edge_sensors_m
        panel = next(iter(mirror.panels.values()))
        self._reach_m = _REACH * 2.0 * min(panel.half_x_m, panel.half_y_m)
        self._half = {"x": panel.half_x_m, "y": panel.half_y_m}
        self._edges: dict[int, tuple[str, float, PanelId]] = {}

    def forget(self) -> None:
        """The pose was found anew: the offsets belong to another one."""
        self._edges.clear()

    def meet(self, transition: Transition, t_s: float, x: FloatArray, slope: Slope) -> Edge | None:
        """Which edge a transition belongs to; None where no seam is near.

        Args:
            transition: one sensor's.
            t_s: time of the state, s.
            x: state, shape (n,).
            slope: of the surface under the robot.
        """
        place, (along_x, along_y), _ = self._sensor(transition, t_s, x, slope)
        seam = self._mirror.nearest_seam(*place)
        if seam is None or abs(seam.distance_m) > self._reach_m:
            return None
        k = 0 if seam.axis == "x" else 1
        speed = (along_x, along_y)[k]
        edge_m, panel = self._edge(seam.axis, seam.position_m, place, is_high=(speed > 0.0) is transition.is_on)
        state = E1 if transition.is_on else E0
        edge = (seam.axis, edge_m, panel)
        is_new = self._edges.get(state) != edge
        self._edges[state] = edge
        return Edge(k, edge_m, state, is_new)

    def line(self, edge: Edge, transition: Transition, t_s: float, x: FloatArray, slope: Slope) -> Line:
        """What a transition over ``edge`` says about the state; arguments as in ``meet``."""
        place, speeds, (forward, left, lever) = self._sensor(transition, t_s, x, slope, edge.k)
        late_s = t_s - transition.t_s
        v = float(x[V]) - float(x[A]) * late_s
        H = np.zeros((1, STATES))
        row = H[0]
        row[X + edge.k] = 1.0
        row[PSI] = lever - v * late_s * left
        row[V] = -late_s * forward
        row[A] = late_s * late_s * forward
        row[W] = -late_s * row[PSI]
        row[edge.offset] = -1.0
        variance = (speeds[edge.k] * transition.interval_s) ** 2 * _UNIFORM + _TIMING_FLOOR_M2
        return Line(edge.position_m + float(x[edge.offset]) - place[edge.k], H, variance)

    def _sensor(
        self, transition: Transition, t_s: float, x: FloatArray, slope: Slope, k: int = 0
    ) -> tuple[tuple[float, float], tuple[float, float], tuple[float, float, float]]:
        """Place (m) and velocity (m/s) of a sensor at its transition; along axis k: heading, left, lever of a turn."""
        late_s = t_s - transition.t_s
        ox, oy = self._sensors[transition.corner]
        x_m, y_m, psi, v, a, w = x[:6].tolist()
        v -= a * late_s
        hx, hy, lx, ly = axes_on(slope, psi - w * late_s)
        # A point of the body moves by v h, and by w times its lever turned by a quarter.
        turn_x, turn_y = ox * lx - oy * hx, ox * ly - oy * hy
        place = x_m - v * late_s * hx + ox * hx + oy * lx, y_m - v * late_s * hy + ox * hy + oy * ly
        velocity = v * hx + w * turn_x, v * hy + w * turn_y
        return place, velocity, ((hx, lx, turn_x) if k == 0 else (hy, ly, turn_y))

    def _edge(self, axis: str, position_m: float, place: tuple[float, float], is_high: bool) -> tuple[float, PanelId]:
        """The edge above (``is_high``) or below a seam's centre line, and its panel."""
        k = 0 if axis == "x" else 1
        inside = [place[0], place[1]]
        inside[k] = position_m + (self._half[axis] if is_high else -self._half[axis])
        panel = self._mirror.panels[self._mirror.nearest_panel(*inside)]
        centre = (panel.x_m, panel.y_m)[k]
        return centre - self._half[axis] if is_high else centre + self._half[axis], panel.id


def axes_on(slope: Slope, psi: float) -> tuple[float, float, float, float]:
    """Deck components (hx, hy, lx, ly) of the robot's x and y axes, as ``Mirror.body_axes``."""
    fx, fy = slope[0], slope[1]
    s2 = 1.0 + fx * fx
    s, norm = sqrt(s2), sqrt(s2 + fy * fy)
    ex, ey = -fx * fy / (norm * s), s / norm
    c, d = cos(psi), sin(psi)
    return c / s + d * ex, d * ey, c * ex - d / s, c * ey
