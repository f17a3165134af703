"""The truth of one run: the true pose of the robot, the true panel misalignments, and whether the robot has fallen."""

from collections import deque
from collections.abc import Iterable
from math import hypot, inf

import numpy as np

from ccatp.config.models import Config
from ccatp.core import DeckPose, PanelId, PanelPose, Vector3
from ccatp.kinematics import wrap_pi
from ccatp.mirror.mirror import Mirror
from ccatp.mirror.misalignment import PanelMisalignment, misaligned_puck_world
from ccatp.mirror.rim import NearOutline
from ccatp.sim.plant import Creep, Disturbance, Plant, Vibration, WheelSlip, draw_wheels
from ccatp.sim.sensors import EdgeSensors

# seq, t, x, y, psi, X, Y, Z (surface point, deck), least edge sensor clearance, fallen, mask of sensors beyond the rim
TruthRow = tuple[int, float, float, float, float, float, float, float, float, int, int]

NEAR_RIM_M = 0.25
FAR_CLEARANCE_M = 1.0
"""Largest reported clearance, also while the robot's origin is more than ``NEAR_RIM_M`` from the rim."""


class World:
    """Robot on mirror.

    ``rng`` is the parent of the generators; the draws of one kind do not depend on the others. ``pushes`` are further
    disturbances, besides those of the configuration. The robot starts at ``start``, by default at base with a drawn
    error. ``grip`` and ``sensors`` may be set before a step.
    """

    def __init__(
        self, cfg: Config, mirror: Mirror, rng: np.random.Generator, window_frames: int,
        pushes: Iterable[Disturbance] = (), start: DeckPose | None = None,
    ) -> None:  # fmt: skip
        start_rng, truth_rng = rng.spawn(2)
        wheels_rng, slip_rng, creep_rng, vibration_rng = rng.spawn(4)
        self.mirror = mirror
        self.misalignments = draw_misalignments(mirror.panels, cfg, truth_rng)
        self.start_panel_pose = draw_start(mirror.base_panel_pose, cfg, start_rng)
        self.start_pose = mirror.deck_pose(self.start_panel_pose) if start is None else start
        robot, sim, world = cfg.robot, cfg.sim.robot, cfg.world
        self.wheels = wheels = draw_wheels(robot, sim.wheel_lag_s, world, wheels_rng)
        self._slip = WheelSlip(world, slip_rng)
        self._vibration = Vibration(world, 1.0 / sim.frame_hz, vibration_rng)
        self.plant = Plant(
            mirror.surface,
            self.start_pose,
            wheel_radius_m=wheels.radius_m,
            wheel_base_m=wheels.base_m,
            wheel_lag_s=wheels.lag_s,
            disturbances=[Creep(mirror, world, creep_rng).displace, self._vibration.displace, *pushes],
        )
        self._puck_height_m = robot.puck_height_m
        self._thrust_floor, self._fall_thrust_s = sim.fan_floor, sim.fall_thrust_s
        self._weak_s = 0.0
        self.is_fallen, self.fall = False, ""  # why it fell: ``rim``, ``thrust`` or ``grip``
        self.grip = (1.0, 1.0)  # (right, left) body travel / wheel travel, besides the slip
        self._places: deque[tuple[float, float]] = deque(maxlen=window_frames + 1)
        self._places.append((self.plant.x_m, self.plant.y_m))
        self._overhang, self._rim = mirror.overhang, NearOutline(mirror.rim)
        # Lower bound of the origin's distance to the rim; each step subtracts the distance driven.
        self._rim_bound_m = -inf
        self.sensors: EdgeSensors | None = None  # for their clearance in the truth rows
        self._has_looked = False
        self._clearance_m, self._off_mask = FAR_CLEARANCE_M, 0

    def step(self, t_s: float, dt_s: float, right_rad_s: float, left_rad_s: float, thrust: float) -> None:
        """Advance by one frame from ``t_s``, with the mean thrust of the fans, 0 to 1.

        The robot falls when its centre of mass (its origin) passes the rim, or on an overhanging mirror when the mean
        thrust was below the floor for ``fall_thrust_s``.
        """
        plant = self.plant
        if self.is_fallen:
            plant.is_moving = False
            return
        is_ordered = right_rad_s != 0.0 or left_rad_s != 0.0
        if is_ordered or plant.right_rad_s or plant.left_rad_s:
            self._slip.step(t_s, dt_s, is_ordered)
        right_grip, left_grip = self.grip
        plant.right_scale = right_grip * (self.wheels.right_scale * (1.0 - self._slip.right))
        plant.left_scale = left_grip * (self.wheels.left_scale * (1.0 - self._slip.left))
        self._vibration.is_thrusting = thrust > 0.0
        plant.step(t_s, dt_s, right_rad_s, left_rad_s)
        self._places.append((plant.x_m, plant.y_m))
        if self._overhang:
            self._weak_s = self._weak_s + dt_s if thrust < self._thrust_floor else 0.0
            # Half a frame of tolerance, because the sum of steps has rounding errors.
            if self._weak_s >= self._fall_thrust_s - 0.5 * dt_s:
                self._fall("thrust")
        if plant.is_moving:
            self._has_looked = False
            self._rim_bound_m -= abs(plant.forward_m) + abs(plant.left_m)
            if self._rim_bound_m < 0.0:
                self._measure_rim()
                if self._rim_bound_m < 0.0:
                    self._fall("rim")

    def displace(self, dx_m: float, dy_m: float, dheading_rad: float) -> None:
        """Move the robot by an offset, deck frame. Beyond the rim it falls."""
        plant = self.plant
        plant.place(plant.x_m + dx_m, plant.y_m + dy_m, plant.heading_rad + dheading_rad)
        self._has_looked = False
        self._measure_rim()
        if self._rim_bound_m < 0.0:
            self._fall("rim")

    def lose_grip(self) -> None:
        """Let the robot fall, because it has left the surface."""
        self._fall("grip")

    def _fall(self, why: str) -> None:
        self.is_fallen, self.fall = True, self.fall or why
        self.plant.stop_dead()
        if self.sensors is not None:
            self.sensors.lift()

    def truth_row(self, seq: int, t_s: float) -> TruthRow:
        """The truth at frame ``seq``."""
        if not self._has_looked:
            self._look()
        p = self.plant
        x, y, heading_rad = p.x_m, p.y_m, wrap_pi(p.heading_rad)
        return seq, t_s, x, y, heading_rad, x, y, p.z_m, self._clearance_m, int(self.is_fallen), self._off_mask

    def _look(self) -> None:
        """Compute clearance and mask of the edge sensors; far from the rim they are constants."""
        self._has_looked = True
        self._clearance_m, self._off_mask = FAR_CLEARANCE_M, 0
        if self._rim_bound_m < NEAR_RIM_M:
            self._measure_rim()
        if self._rim_bound_m < NEAR_RIM_M and self.sensors is not None:
            # A panel as mounted may end before the ideal rim; the edge sensors detect the end of the panel.
            distance_m, outer_edge_m = self._rim.signed_distance_m, self.sensors.outer_edge_m
            clearances_m = [min(distance_m(x, y), outer_edge_m(x, y)) for x, y in self.sensors.places]
            self._clearance_m = min(FAR_CLEARANCE_M, *clearances_m)
            if self._clearance_m < 0.0:
                self._off_mask = sum((clearance_m < 0.0) << k for k, clearance_m in enumerate(clearances_m))

    def _measure_rim(self) -> None:
        self._rim_bound_m = self._rim.signed_distance_m(self.plant.x_m, self.plant.y_m)

    def puck_world(self) -> Vector3:
        """Centre of the puck on the misaligned panel, world frame, m."""
        pose = self.plant.pose
        panel = self.mirror.nearest_panel(pose.x_m, pose.y_m)
        return misaligned_puck_world(self.mirror, panel, self.misalignments[panel], pose, self._puck_height_m)

    def moved_m(self) -> float:
        """Largest distance of the robot from its present position within the last window, m."""
        x, y = self._places[-1]
        fx, fy = self.mirror.surface.gradient(x, y)
        farthest = 0.0
        for px, py in self._places:
            dx, dy = px - x, py - y
            farthest = max(farthest, hypot(dx, dy, fx * dx + fy * dy))
        return farthest


def draw_start(base: PanelPose, cfg: Config, rng: np.random.Generator) -> PanelPose:
    """The true start pose: base plus normal errors in x, y and heading, panel frame."""
    dx, dy, turn = (float(n) for n in rng.standard_normal(3))
    sigma_m, sigma_rad = cfg.world.start_position_sigma_m, cfg.world.start_heading_sigma_rad
    return PanelPose(base.panel, base.x_m + sigma_m * dx, base.y_m + sigma_m * dy, base.heading_rad + sigma_rad * turn)


def draw_misalignments(
    panels: Iterable[PanelId], cfg: Config, rng: np.random.Generator
) -> dict[PanelId, PanelMisalignment]:
    """Normal piston, tip and tilt of each panel, in the order of ``panels``."""
    truth = cfg.sim.truth
    found: dict[PanelId, PanelMisalignment] = {}
    for panel in panels:
        piston, tip, tilt = (float(n) for n in rng.standard_normal(3))
        found[panel] = PanelMisalignment(
            truth.piston_sigma_m * piston, truth.tilt_sigma_rad * tip, truth.tilt_sigma_rad * tilt
        )
    return found
