"""The robot as a rigid body on the mirror, with tyres, motors and fans: MuJoCo, an optional package.

Deck frame, SI. A body of ``sim.physics.mass_kg`` stands on two driven wheels and a smooth caster behind them. The
ground is the tangent plane of the mirror at the robot, renewed in each step; at the wheels the mirror differs from it
by 65 um. Contacts have Coulomb friction (elliptic cone); the tyres are round (point contact) or flat. Each wheel has
the geared DC motor of ``ccatp.sim.hardware``: torque kt (V - ke w)/R minus friction. The thrust of the fans is along
the robot's own normal. Gravity is that of the mirror's inclination. The motion depends on the start and the commands
alone, without random numbers.

Slip, creep, load and loss of grip result from the contacts, so the disturbances of the kinematic worlds are not used.
"""

from collections import deque
from math import atan2, pi
from typing import Any

import numpy as np

from ccatp.config.models import Config, PhysicsConfig
from ccatp.core import GRAVITY_M_S2, DeckPose
from ccatp.errors import CcatpError, ConfigError, one_line
from ccatp.mirror.mirror import Mirror
from ccatp.mirror.surface import Axes, tangent_axes
from ccatp.sim.hardware import Motor, SimulatedHardware
from ccatp.sim.plant import Plant
from ccatp.sim.world import World

# What MuJoCo says of a step. It would write it to a file of its own, put the body back to its start, and go on.
_COMPLAINTS: list[str] = []

_TYRE_PRIORITY = 2  # of contacts: the tyre's friction is used, not the mirror's

_MODEL = """
<mujoco model="survey robot">
  <option timestep="{timestep}" integrator="implicitfast" cone="elliptic" noslip_iterations="4" impratio="10"
          gravity="{gravity}"/>
  <default><geom solref="{contact_s} 1" solimp="0.95 0.99 0.0005" condim="4"/></default>
  <worldbody>
    <geom name="mirror" type="plane" size="0 0 1" pos="0 0 -1" euler="1 1 1" friction="{friction} 0.002 0.0001"/>
    <body name="robot">
      <freejoint/>
      <geom type="box" size="0.09 0.06 0.015" pos="-0.015 0 0.035" mass="{chassis_kg}" contype="0" conaffinity="0"/>
      <geom name="caster" type="sphere" size="0.012" pos="-0.075 0 0.012" mass="0.02" priority="1"
            friction="{caster} 0 0"/>
      <site name="centre"/>
      {wheels}
    </body>
  </worldbody>
  <actuator><motor joint="right"/><motor joint="left"/></actuator>
</mujoco>
"""
_WHEEL = """
      <body name="{name}" pos="0 {y} {radius}">
        <joint name="{name}" type="hinge" axis="0 1 0" damping="{damping}" frictionloss="{friction_nm}"
               armature="{armature}"/>
        {tyre}
      </body>"""
_ROUND = (
    '<geom type="ellipsoid" size="{radius} {radius} 0.004" euler="90 0 0" mass="0.04" '
    'friction="{friction} {pivot} 0.0001" priority="{priority}"/>'
)
_FLAT = (
    '<geom type="cylinder" size="{radius} {half}" euler="90 0 0" mass="0.04" '
    'friction="{friction} {pivot} 0.0001" priority="{priority}"/>'
)


class UnstablePhysicsError(CcatpError):
    """MuJoCo could not compute a step: the motion after it is not that of a body."""

    def __init__(self, t_s: float, complaint: str) -> None:
        super().__init__(
            f"the physics of the simulated robot failed at {t_s:.3f} s ({one_line(complaint)}); look at"
            " sim.physics.*: mass_kg, thrust_n, rotor_inertia_kg_m2, contact_s; or raise servo.loop_hz"
        )


class PhysicsPlant(Plant):
    """The body; ``step`` takes motor voltages instead of set points, and raises ``UnstablePhysicsError``.

    Attributes:
        thrust_n: of the fans, along the robot's normal, towards the surface.
        has_left: its origin is more than 0.03 m above the mirror.
    """

    def __init__(self, cfg: Config, mirror: Mirror, start: DeckPose, motor: Motor, step_s: float) -> None:
        """``step_s``: step of the control loop and of the physics."""
        robot = cfg.robot
        super().__init__(
            mirror.surface, start, wheel_radius_m=robot.wheel_radius_m, wheel_base_m=robot.wheel_base_m, wheel_lag_s=1.0
        )
        try:
            import mujoco  # noqa: PLC0415 - an optional package, of hundreds of megabytes
        except ImportError as error:
            raise ConfigError(
                'sim.robot.physics = "mujoco": the package mujoco is not installed; pip install ccatp[physics]'
            ) from error
        self._mujoco: Any = mujoco
        self._motor, self._step_s = motor, step_s
        self._mirror, self._surface = mirror, mirror.surface
        mujoco.set_mju_user_warning(_COMPLAINTS.append)
        _COMPLAINTS.clear()
        self._model = self._build(cfg.sim.physics, robot.wheel_radius_m, robot.wheel_base_m)
        self._data = mujoco.MjData(self._model)
        body = self._model.body("robot").id
        # Views of MuJoCo's memory: to make one takes as long as to read it.
        data = self._data
        self._torques, self._force, self._rotation = data.ctrl, data.xfrc_applied[body, :3], data.xmat[body]
        self._place, self._angles, self._rates = data.xpos[body], data.qpos[7:9], data.qvel
        self._ahead_and_left, self._velocity = self._rotation.reshape(3, 3)[:, :2].T, data.qvel[:3]
        self._ground_m, self._ground_turn = self._model.geom_pos[0], self._model.geom_quat[0]
        self._ground_axes = np.zeros(9)
        self.thrust_n = 0.0
        self.has_left = False
        self._averaged = max(1, round(cfg.sim.physics.accelerometer_s / step_s))
        self._speeds = deque([[0.0, 0.0]] * (self._averaged + 1), self._averaged + 1)
        self._rate_rad_s = 0.0
        self.place(start.x_m, start.y_m, start.heading_rad)
        self.are_wheels_still = False

    def _build(self, cfg: PhysicsConfig, radius_m: float, base_m: float) -> Any:
        motor = self._motor
        damping = motor.volt_per_rad_s / motor.volt_per_nm
        tyre = (_FLAT if cfg.tyre == "flat" else _ROUND).format(
            radius=radius_m, half=0.5 * cfg.tyre_width_m, friction=cfg.friction, pivot=cfg.pivot_m,
            priority=_TYRE_PRIORITY,
        )  # fmt: skip
        wheels = "".join(
            _WHEEL.format(
                name=name, y=y, radius=radius_m, tyre=tyre, damping=damping, friction_nm=motor.friction_nm,
                armature=cfg.rotor_inertia_kg_m2,
            )
            for name, y in (("right", -0.5 * base_m), ("left", 0.5 * base_m))
        )  # fmt: skip
        return self._mujoco.MjModel.from_xml_string(
            _MODEL.format(
                timestep=self._step_s,
                gravity=" ".join(f"{GRAVITY_M_S2 * one:.9g}" for one in self._mirror.gravity_deck),
                friction=cfg.friction, chassis_kg=cfg.mass_kg - 0.1, wheels=wheels, caster=cfg.caster_friction,
                contact_s=cfg.contact_s,
            )
        )  # fmt: skip

    # -- motion -------------------------------------------------------------------------------------------------------

    def step(self, t_s: float, dt_s: float, right_set_rad_s: float, left_set_rad_s: float) -> None:
        """Advance by ``dt_s`` with constant voltages of the (right, left) motor, V."""
        data, motor = self._data, self._motor
        self._torques[:] = right_set_rad_s / motor.volt_per_nm, left_set_rad_s / motor.volt_per_nm
        self._right_angle_0, self._left_angle_0 = self.right_angle_rad, self.left_angle_rad
        x, y, heading_rad = self.x_m, self.y_m, self.heading_rad
        _, _, nx, _, _, ny, _, _, nz = self._rotation.tolist()
        self._force[:] = -self.thrust_n * nx, -self.thrust_n * ny, -self.thrust_n * nz
        self._mujoco.mj_step(self._model, data)
        if _COMPLAINTS:
            raise UnstablePhysicsError(t_s, _COMPLAINTS[0])
        self._read_state()
        dx, dy = self.x_m - x, self.y_m - y
        self.forward_m, self.left_m, self.turn_rad = (
            dx * self.hx + dy * self.hy,
            dx * self.lx + dy * self.ly,
            (self.heading_rad - heading_rad),
        )
        # Rest is never exact, so the body always counts as moving; the edge sensors add up the small displacements.
        self.is_moving = True

    def _lay_ground(self, axes: Axes) -> None:
        """Move the ground to the tangent plane under the robot (impossible for a plane at the model's origin)."""
        self._ground_m[:] = self.x_m, self.y_m, self.z_m
        e1, e2, normal = axes
        self._ground_axes[:] = e1[0], e2[0], normal[0], e1[1], e2[1], normal[1], e1[2], e2[2], normal[2]
        self._mujoco.mju_mat2Quat(self._ground_turn, self._ground_axes)

    def _read_state(self) -> None:
        x, y, z = self._place.tolist()
        self.x_m, self.y_m = x, y
        self.z_m, self.fx, self.fy, *_ = self._surface.jet(x, y)
        self.has_left = z - self.z_m > 0.03
        axes = (e1x, _, e1z), (e2x, e2y, e2z), _ = tangent_axes(self.fx, self.fy)
        ax, _, _, ay, _, _, az, _, _ = self._rotation.tolist()
        heading = atan2(ax * e2x + ay * e2y + az * e2z, ax * e1x + az * e1z)
        turned = (heading - self.heading_rad + pi) % (2.0 * pi) - pi
        self.heading_rad += turned
        self._turn_axes()
        self._lay_ground(axes)
        self.right_angle_rad, self.left_angle_rad = self._angles.tolist()
        *_, self._rate_rad_s, self.right_rad_s, self.left_rad_s = self._rates.tolist()
        self._speeds.append((self._ahead_and_left @ self._velocity).tolist())

    def acceleration_at(self, decay: float) -> float:
        """Mean acceleration along robot x over ``sim.physics.accelerometer_s``, m/s^2."""
        return (self._speeds[-1][0] - self._speeds[0][0]) / (self._averaged * self._step_s)

    def lateral_acceleration_at(self, decay: float) -> float:
        """The same along robot y."""
        (_, before), (ahead, now) = self._speeds[0], self._speeds[-1]
        return (now - before) / (self._averaged * self._step_s) + self._rate_rad_s * ahead

    def turn_rate_at(self, decay: float) -> float:
        """Angular rate about robot z, rad/s."""
        return self._rate_rad_s

    def place(self, x_m: float, y_m: float, heading_rad: float) -> None:
        """Set the pose of the body on the surface, deck frame, at rest."""
        axes = np.array(self._mirror.robot_axes(DeckPose(x_m, y_m, heading_rad))).T
        data = self._data
        data.qpos[:3] = self._surface.point(x_m, y_m)
        self._mujoco.mju_mat2Quat(data.qpos[3:7], axes.ravel())
        data.qvel[:] = 0.0
        self._mujoco.mj_forward(self._model, data)
        self.heading_rad = heading_rad
        self._read_state()

    def set_friction(self, friction: float) -> None:
        """Set the friction coefficient of both tyres."""
        for geom in range(self._model.ngeom):
            if self._model.geom_priority[geom] == _TYRE_PRIORITY:
                self._model.geom_friction[geom, 0] = friction

    def stop_dead(self) -> None:
        """Stop body and wheels (the robot fell)."""
        self._data.qvel[:] = 0.0
        super().stop_dead()


class PhysicsHardware(SimulatedHardware):
    """The devices of a robot with real physics."""

    def _make_world(self, cfg: Config, rng: np.random.Generator, start: DeckPose | None) -> World:
        world = super()._make_world(cfg, rng, start)
        self.plant = PhysicsPlant(cfg, self._mirror, world.start_pose, self._motor, 1.0 / self._loop_hz)
        world.plant = self.plant
        self._full_thrust_n = cfg.sim.physics.thrust_n
        return world

    def _move(self) -> None:
        t_s, dt_s = (self._step - 1) / self._loop_hz, 1.0 / self._loop_hz
        duty = 0.5 * (self._duty[0] + self._duty[1])
        self.plant.thrust_n = duty * self._full_thrust_n
        self.world.step(t_s, dt_s, *self.voltages_v, duty)
        if self.plant.has_left:
            self.world.lose_grip()
