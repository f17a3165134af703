"""Single drives over a seam and to the rim on the simulated plant, judged by two edge rules.

The robot drives on constant set points; its wheels slip, its sensors err and the panels' edges lie as the world says
(creep and vibration are left out). The rules see what the danger loop sees: edge and encoder samples frame by frame,
and an estimate of the pose every fifth frame.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import cos, hypot, pi, sin
from typing import NamedTuple, Protocol

import numpy as np

from ccatp.config.models import Config
from ccatp.core import DeckPose, EdgeSample, EventCode, PanelId, WheelSample
from ccatp.danger import DangerMonitor
from ccatp.links.robot_messages import CommandEcho, Sensors
from ccatp.links.topics import EstimateMessage, is_estimate_due
from ccatp.mirror.layout import Panel
from ccatp.mirror.mirror import Mirror
from ccatp.sim.plant import Plant
from ccatp.sim.sensors import SensorSuite, named

RULES = ("thesis", "shipped")
OFF_S = 0.1
"""Threshold of the thesis's rule: a gap of 1 cm at 0.1 m/s."""
_MARGIN_M = 0.01  # the first sensor begins this far before a seam, the last one ends this far behind it
_APPROACH_M = 0.03  # the first sensor begins this far before the rim
_BESIDE_M = 0.10  # drives to the rim meet it within this of a panel's middle
_ASKEW_RAD = 0.05  # a turn in place begins within this of an axis
_RUN_DOWN_S = 1.0  # a robot without set point has stopped after this: a dozen time constants
_BLIND_M = 0.4  # an edge that nobody saw by now is not going to be seen


@dataclass(frozen=True, slots=True)
class EdgeErrors:
    """How wrong the estimate is that the rules get, drawn once per drive.

    Attributes:
        position_m: standard deviation in x and in y, also what the estimate says of itself.
    """

    position_m: float
    heading_rad: float


def drive_frame(seq: int, t_s: float, enc: list[WheelSample], edge: list[EdgeSample]) -> Sensors:
    """A sensors frame with what the rules read."""
    return Sensors(seq, t_s, [], enc, edge, None, (0.0, 0.0), 1.0, CommandEcho(0, 0.0, 0.0, False), [])


class EdgeRuleUnderTest(Protocol):
    """Judges frame by frame."""

    def judge(self, frame: Sensors, estimate: EstimateMessage) -> bool:
        """Whether there is an edge."""


class OffTimeRule:
    """The thesis's rule (3.4.1): an edge where a sensor has been off for the time that the gap takes at 0.1 m/s."""

    def __init__(self, off_s: float) -> None:
        self._off_s = off_s
        self._since_s: list[float | None] = [None] * 4

    def judge(self, frame: Sensors, estimate: EstimateMessage) -> bool:
        """Whether a sensor has been off for so long; once it is back on its time begins anew."""
        del estimate  # the rule knows no map
        found = False
        for t_s, *values in frame.edge:
            for k, value in enumerate(values):
                begun_s = self._since_s[k]
                if value == 1:
                    self._since_s[k] = None
                elif begun_s is None:
                    self._since_s[k] = t_s
                else:
                    found = found or t_s - begun_s > self._off_s
        return found


class MapRule:
    """The daemon's rule: travel against the map.

    Args:
        cfg: robot and danger sections.
    """

    def __init__(self, mirror: Mirror, cfg: Config) -> None:
        self._monitor = DangerMonitor(mirror, cfg.robot, cfg.danger)

    def judge(self, frame: Sensors, estimate: EstimateMessage) -> bool:
        """Whether the verdict's code is that of an edge."""
        return self._monitor.step(frame, estimate).code is EventCode.NEAR_EDGE


def build_rule(name: str, mirror: Mirror, cfg: Config, off_s: float) -> EdgeRuleUnderTest:
    """A rule by its name out of ``RULES``.

    Raises:
        ValueError: no such rule.
    """
    if name == "thesis":
        return OffTimeRule(off_s)
    if name == "shipped":
        return MapRule(mirror, cfg)
    raise ValueError(f"no edge rule is called {name!r}: take one of {', '.join(RULES)}")


class Rig:
    """One robot on its way, with what it reads.

    Args:
        cfg: robot, world, sim.
    """

    def __init__(
        self, mirror: Mirror, cfg: Config, start: DeckPose, errors: EdgeErrors, rng: np.random.Generator
    ) -> None:
        slip_rng, error_rng, sensors_rng = rng.spawn(3)
        world, robot = cfg.world, cfg.robot
        self.plant = plant = Plant(
            mirror.surface,
            start,
            wheel_radius_m=robot.wheel_radius_m,
            wheel_base_m=robot.wheel_base_m,
            wheel_lag_s=cfg.sim.robot.wheel_lag_s,
        )
        # Nobody steers here, so both wheels slip alike: what is asked is the angle at the edge, not the way there.
        plant.right_scale = plant.left_scale = 1.0 - float(slip_rng.uniform(world.slip_min, world.slip_max))
        self._sensors = SensorSuite(
            mirror,
            cfg.sim.robot,
            world,
            robot.edge_sensors_m,
            sensors_rng,
            panels=cfg.mirror.panels,
            lag_s=cfg.sim.robot.wheel_lag_s,
        )
        self._sensors.edges.place(plant)
        dx, dy, turn = error_rng.standard_normal(3).tolist()
        self._error = errors.position_m * dx, errors.position_m * dy, errors.heading_rad * turn
        self._sigma_m = errors.position_m
        self._frame_s = 1.0 / cfg.sim.robot.frame_hz
        self._seq = 0
        self._sensors.enter(0)
        self._estimate = self._estimated()

    def frame(self, right_rad_s: float, left_rad_s: float) -> tuple[Sensors, EstimateMessage]:
        """Drive one frame on these set points; what is known at its end: the frame, and the estimate before it."""
        estimate, sensors, plant = self._estimate, self._sensors, self.plant
        t_s = self._seq * self._frame_s
        plant.step(t_s, self._frame_s, right_rad_s, left_rad_s)
        self._seq += 1
        sensors.enter(self._seq)
        edge = named(EdgeSample, sensors.read_edges(plant))
        enc = named(WheelSample, sensors.read_encoders(plant))
        if is_estimate_due(self._seq):
            self._estimate = self._estimated()
        return drive_frame(self._seq, self._seq * self._frame_s, enc, edge), estimate

    @property
    def places(self) -> list[tuple[float, float]]:
        """Deck places of the edge sensors, m."""
        return self._sensors.edges.places

    def _estimated(self) -> EstimateMessage:
        p, (dx, dy, turn) = self.plant, self._error
        return EstimateMessage(
            seq=self._seq,
            t_s=self._seq * self._frame_s,
            x_m=p.x_m + dx,
            y_m=p.y_m + dy,
            heading_rad=p.heading_rad + turn,
            sigma_m=self._sigma_m,
            state="driving",
        )

    def at_speed(self, v_m_s: float, omega_rad_s: float, cfg: Config) -> tuple[float, float]:
        """Set points (right, left) of a twist; the wheels have them from the beginning."""
        r, half = cfg.robot.wheel_radius_m, 0.5 * cfg.robot.wheel_base_m
        set_points = (v_m_s + omega_rad_s * half) / r, (v_m_s - omega_rad_s * half) / r
        self.plant.right_rad_s, self.plant.left_rad_s = set_points
        return set_points


def transit(
    mirror: Mirror, cfg: Config, v_m_s: float, angle_rad: float | None, errors: EdgeErrors, rng: np.random.Generator
) -> tuple[bool, ...]:
    """Cross a seam between two columns, or turn by a quarter beside it; whether each rule took it for an edge.

    Args:
        cfg: robot, world, sim, danger.
        angle_rad: between the way and the seam's normal; None turns in place.

    Returns:
        A flag for each of ``RULES``.
    """
    place_rng, rig_rng = rng.spawn(2)
    panel = _pick(place_rng, _inner(mirror))
    seam_m = panel.x_m + panel.half_x_m + 0.5 * mirror.gap_m
    ahead, left = cfg.robot.edge_sensors_m[0]
    if angle_rad is None:
        reach_m = hypot(ahead, left)
        start = DeckPose(
            seam_m + place_rng.uniform(-reach_m, reach_m),
            panel.y_m + place_rng.uniform(-1.0, 1.0) * (panel.half_y_m - reach_m - _MARGIN_M),
            0.5 * pi * int(place_rng.integers(4)) + place_rng.uniform(-_ASKEW_RAD, _ASKEW_RAD),
        )
        omega_rad_s = v_m_s / reach_m * int(place_rng.choice((-1, 1)))
        drive_s, v_m_s = 0.5 * pi / abs(omega_rad_s), 0.0
    else:
        reach_m, omega_rad_s = ahead * cos(angle_rad) + left * sin(angle_rad), 0.0
        half_way_m = (reach_m + _MARGIN_M + 0.5 * mirror.gap_m) / cos(angle_rad)
        heading_rad = angle_rad * int(place_rng.choice((-1, 1))) + pi * int(place_rng.integers(2))
        beside_m = max(panel.half_y_m - reach_m - half_way_m * sin(angle_rad), 0.0)
        middle_m = panel.y_m + place_rng.uniform(-beside_m, beside_m)
        start = DeckPose(seam_m - half_way_m * cos(heading_rad), middle_m - half_way_m * sin(heading_rad), heading_rad)
        drive_s = 2.0 * half_way_m / (v_m_s * (1.0 - cfg.world.slip_max))
    rig = Rig(mirror, cfg, start, errors, rig_rng)
    set_points = rig.at_speed(v_m_s, omega_rad_s, cfg)
    rules = [build_rule(name, mirror, cfg, OFF_S) for name in RULES]
    found = [False] * len(rules)
    for _ in range(round(drive_s * cfg.sim.robot.frame_hz)):
        seen = rig.frame(*set_points)
        for k, rule in enumerate(rules):
            found[k] = rule.judge(*seen) or found[k]
    return tuple(found)


class Overrun(NamedTuple):
    """Where a drive to the rim ended."""

    sensor_m: float
    has_fallen: bool


def drive_to_rim(
    mirror: Mirror, cfg: Config, v_m_s: float, angle_rad: float, name: str, errors: EdgeErrors, rng: np.random.Generator
) -> Overrun:
    """Drive over the rim until a rule sees an edge; the set points are zero one frame and the link's delays later.

    Args:
        cfg: robot, world, sim, danger.
    """
    place_rng, rig_rng = rng.spawn(2)
    panel = _pick(place_rng, [p for p in mirror.panels.values() if _right_of(p) not in mirror.panels])
    ahead, left = cfg.robot.edge_sensors_m[0]
    heading_rad = angle_rad * int(place_rng.choice((-1, 1)))
    before_m = ahead * cos(angle_rad) + left * sin(angle_rad) + _APPROACH_M
    meets_m = panel.y_m + place_rng.uniform(-_BESIDE_M, _BESIDE_M)
    start = DeckPose(
        panel.x_m + panel.half_x_m - before_m, meets_m - _APPROACH_M * float(np.tan(heading_rad)), heading_rad
    )
    rig = Rig(mirror, cfg, start, errors, rig_rng)
    set_points = rig.at_speed(v_m_s, 0.0, cfg)
    rule, hz = build_rule(name, mirror, cfg, OFF_S), cfg.sim.robot.frame_hz
    frames_left = round(_BLIND_M / v_m_s * hz)
    late = round((cfg.world.sensors_delay_s + cfg.world.commands_delay_s) * hz)
    is_seen = has_fallen = False
    while frames_left > 0:
        if is_seen:
            late -= 1
        seen = rig.frame(*(set_points if not is_seen or late >= 0 else (0.0, 0.0)))
        frames_left -= 1
        if not is_seen and rule.judge(*seen):
            is_seen, frames_left = True, round(_RUN_DOWN_S * hz)
        has_fallen = has_fallen or mirror.rim.signed_distance_m(rig.plant.x_m, rig.plant.y_m) < 0.0
    beyond = [-mirror.rim.signed_distance_m(x, y) for x, y in rig.places]
    return Overrun(max(beyond), has_fallen)


def _pick(rng: np.random.Generator, panels: Sequence[Panel]) -> Panel:
    return panels[int(rng.integers(len(panels)))]


def _inner(mirror: Mirror) -> list[Panel]:
    """Panels with neighbours all round their right seam: the rim is far from every way over it."""
    around = ((0, 1), (1, 0), (1, 1), (-1, 0), (-1, 1))
    return [
        panel
        for panel in mirror.panels.values()
        if all(PanelId(panel.id.row + r, panel.id.col + c) in mirror.panels for r, c in around)
    ]


def _right_of(panel: Panel) -> PanelId:
    return PanelId(panel.id.row, panel.id.col + 1)
