"""Pure. The robot's centre and the rim on the map: a notch's tip passes between the edge sensors unseen.

At an inner corner of the stepped rim the empty quadrant points at the robot like a wedge. Driven at along its bisector,
the front sensors, 180 mm apart, leave the panels only when its tip has come under the centre. Where the position is
known, the map sees it coming; where it is not, four corner sensors cannot.
"""

from collections.abc import Sequence
from math import cos, inf, sin

from ccatp.config.models import DangerConfig, RobotConfig
from ccatp.hazards.edge_map import RimMap
from ccatp.hazards.edge_rule import PoseEstimate
from ccatp.samples import WheelSample

# Where the clearance is wide, it is looked up this often at least: a fix may move the estimate.
LOOK_PERIOD_S = 0.1
# Sum of the wheel rates that is motion and not encoder noise (0.3 mm/s).
MOVING_RAD_S = 0.02


class OriginRule:
    """Declares an edge when the centre drives at the rim and is closer to it than half the sensors' lead.

    A straight rim never gets that close: the sensors meet it first. Ends when the centre is ``map_margin_m`` further
    away than it takes to declare.

    Args:
        rim: the mirror's outline.
        robot: wheels and sensor places.
        cfg: sigmas and margin.

    Attributes:
        direction: 0, or the sign of the motion that is barred.
        clearance_m, limit_m: the centre's distance to the rim at the last look, and what it must not fall below.
        declared: how often an edge was declared.
    """

    def __init__(self, rim: RimMap, robot: RobotConfig, cfg: DangerConfig) -> None:
        """Nothing barred."""
        self._rim = rim
        self._lead_m = min(min(abs(x), abs(y)) for x, y in robot.edge_sensors_m)
        self._sigmas, self._margin_m = cfg.map_sigmas, cfg.map_margin_m
        self._fastest_m_s = robot.wheel_radius_m * robot.max_wheel_rad_s
        self.declared = 0
        self.reset()

    def reset(self) -> None:
        """Forget: the robot's clock began anew."""
        self.direction = 0
        self.clearance_m, self.limit_m = inf, 0.0
        self._look_at_s = -inf

    def step(self, t_s: float, estimate: PoseEstimate, wheels: Sequence[WheelSample]) -> None:
        """Look up the clearance, where it may have come near the limit.

        Args:
            t_s: time of the frame.
            estimate: a fresh pose.
            wheels: the frame's encoder samples.
        """
        if t_s < self._look_at_s:
            return
        x, y = estimate.x_m, estimate.y_m
        self.clearance_m = clearance = self._rim.signed_distance_m(x, y)
        self.limit_m = limit = min(0.5 * self._lead_m + self._sigmas * estimate.sigma_m, self._lead_m)
        if self.direction == 0:
            self._look_at_s = t_s + min(max(clearance - limit, 0.0) / self._fastest_m_s, LOOK_PERIOD_S)
            if clearance < limit:
                self._judge(estimate, wheels)
        elif clearance > limit + self._margin_m:
            self.direction = 0

    def _judge(self, estimate: PoseEstimate, wheels: Sequence[WheelSample]) -> None:
        _, right, left = wheels[-1] if wheels else (0.0, None, None)
        if right is None or left is None:
            return
        total = right + left
        if abs(total) < MOVING_RAD_S:
            return
        direction = 1 if total > 0.0 else -1
        ahead_m = direction * self._margin_m
        x = estimate.x_m + ahead_m * cos(estimate.heading_rad)
        y = estimate.y_m + ahead_m * sin(estimate.heading_rad)
        if self._rim.signed_distance_m(x, y) < self.clearance_m:
            self.direction = direction
            self.declared += 1
