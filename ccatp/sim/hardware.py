"""Simulated hardware of the on-board program: geared DC motors that turn the wheels of the plant, counters, voltages.

A geared DC motor at a voltage V approaches its steady speed with its mechanical time constant:

    w_end = (V - V_friction - V_load) / ke,   T = J R / (kt ke)

kt, ke: torque per ampere and voltage per rad/s at the wheel, R: resistance, J: inertia of half of the robot's mass at
the wheel, V_friction: voltage of the Coulomb friction, V_load: voltage of the load, half of gravity's component along
the robot. The plant's first-order wheels represent this motor exactly while the voltage is constant, so the plant makes
one step for each step of the control loop. A braked motor has 0 V.
"""

from math import floor, pi
from typing import NamedTuple

import numpy as np

from ccatp.config.models import Config
from ccatp.core import GRAVITY_M_S2, DeckPose
from ccatp.mirror.mirror import Mirror
from ccatp.onboard.hardware import Readings
from ccatp.sim.plant import downhill
from ccatp.sim.sensors import EdgeTuple, GravityTuple, SensorSuite
from ccatp.sim.world import World

_MASS_KG = 1.0
_EPSILON_S = 1e-9


class Motor(NamedTuple):
    """A geared DC motor; its values are those at the wheel."""

    volt: float  # voltage of the two following values
    no_load_rad_s: float
    stall_nm: float
    friction_nm: float

    @property
    def volt_per_rad_s(self) -> float:
        """Slope ke of the steady state: (voltage - friction voltage) / speed without load."""
        return (self.volt - self.friction_nm * self.volt_per_nm) / self.no_load_rad_s

    @property
    def volt_per_nm(self) -> float:
        """R / kt."""
        return self.volt / self.stall_nm

    def steady_rad_s(self, voltage_v: float, load_nm: float) -> float:
        """Speed at a constant voltage against a load (positive: against turning forwards)."""
        net_v = voltage_v - load_nm * self.volt_per_nm
        friction_v = self.friction_nm * self.volt_per_nm
        if abs(net_v) <= friction_v:
            return 0.0
        return (net_v - friction_v if net_v > 0.0 else net_v + friction_v) / self.volt_per_rad_s

    def time_constant_s(self, inertia_kg_m2: float) -> float:
        """T for an inertia at the wheel."""
        return inertia_kg_m2 * self.volt_per_nm / self.volt_per_rad_s


# Data of the maker for a gear of 75.81 : 1 at 12 V: 450 rev/min without load, 1.0 kgf cm at stall, 0.08 A without load
# and 0.75 A at stall (their ratio gives the friction). They are converted to 297.92 : 1. The speed of a braked wheel on
# a slope increases with load torque / stall torque, so a lower gear ratio would not hold the robot.
_GEAR = 297.92 / 75.81
MOTOR_12V = Motor(volt=12.0, no_load_rad_s=47.1 / _GEAR, stall_nm=0.0981 * _GEAR, friction_nm=0.0105 * _GEAR)


class DriveTrain(NamedTuple):
    """What turns the wheels: frequency of the control loop, encoder and motor. If ``is_lifted``, they turn freely."""

    loop_hz: float
    counts_per_rev: float
    motor: Motor = MOTOR_12V
    is_lifted: bool = False


class SimulatedHardware:
    """The devices of a simulated robot; ``read`` advances the world to its time.

    ``rng`` is the parent of the generators. A test may set ``faults``, which are reported unchanged.

    Attributes:
        world: the truth.
        voltages_v: present voltages of the (right, left) motor.
    """

    def __init__(
        self,
        cfg: Config,
        mirror: Mirror,
        rng: np.random.Generator,
        train: DriveTrain,
        start: DeckPose | None = None,
    ) -> None:
        inertia_kg_m2 = 0.5 * _MASS_KG * cfg.robot.wheel_radius_m**2
        lag_s = train.motor.time_constant_s(inertia_kg_m2)
        sim_robot = cfg.sim.robot.model_copy(update={"frame_hz": train.loop_hz, "wheel_lag_s": lag_s})
        cfg = cfg.model_copy(update={"sim": cfg.sim.model_copy(update={"robot": sim_robot})})
        world_rng, sensors_rng = rng.spawn(2)
        self._mirror = mirror
        self._motor = train.motor
        self._loop_hz = train.loop_hz
        self._per_rad = train.counts_per_rev / (2.0 * pi)
        self.world = self._make_world(cfg, world_rng, start)
        self._sensors = SensorSuite(cfg, mirror, sensors_rng, lag_s=self.world.wheels.lag_s)
        self._sensors.edges.place(self.world.plant)
        self.world.sensors = self._sensors.edges
        floor_duty = sim_robot.fan_floor if mirror.overhang else 0.0
        self._duty = (floor_duty, floor_duty)
        self.wheel_radius_m = cfg.robot.wheel_radius_m
        self._step = -1
        self._is_lifted = train.is_lifted
        if train.is_lifted:
            self.world.grip = (0.0, 0.0)
        self.voltages_v = (0.0, 0.0)
        self.faults: dict[str, str] = {}
        self.timer_calls = 0

    def _make_world(self, cfg: Config, rng: np.random.Generator, start: DeckPose | None) -> World:
        """The truth, with one step per step of the control loop."""
        window = max(1, round(cfg.etalon.measuring_time_s * self._loop_hz))
        return World(cfg, self._mirror, rng, window, start=start)

    def start(self) -> None:
        pass

    def close(self) -> None:
        self.brake()

    def read(self, now_s: float) -> Readings:
        imu: list[tuple[float, float, float, float]] = []
        edges: list[EdgeTuple] = []
        counts: list[tuple[float, int | None, int | None]] = []
        gravity: GravityTuple | None = None
        while (self._step + 1) / self._loop_hz <= now_s + _EPSILON_S:
            self._step += 1
            if self._step:
                self._move()
            # The encoders are read as counts, below.
            new_edges, new_imu, _, new_gravity = self._sensors.read(self._step, self.world.plant, has_encoders=False)
            edges += new_edges
            imu += [(*row, self._sensors.read_lateral(self.world.plant, 0.0)) for row in new_imu]
            gravity = new_gravity or gravity
            plant = self.world.plant
            right, left = floor(plant.right_angle_rad * self._per_rad), floor(plant.left_angle_rad * self._per_rad)
            counts.append((self._step / self._loop_hz, right, left))
        return Readings(imu, counts, [_voltages(row) for row in edges], gravity, 1.0, dict(self.faults))

    def _move(self) -> None:
        t_s, dt_s = (self._step - 1) / self._loop_hz, 1.0 / self._loop_hz
        ahead, _, _ = downhill(self.world.plant, self._mirror.gravity_deck)
        ahead = 0.0 if self._is_lifted else ahead
        load_nm = -0.5 * _MASS_KG * GRAVITY_M_S2 * ahead * self.wheel_radius_m
        right, left = (self._motor.steady_rad_s(voltage_v, load_nm) for voltage_v in self.voltages_v)
        self.world.step(t_s, dt_s, right, left, 0.5 * (self._duty[0] + self._duty[1]))

    def drive(self, right_v: float, left_v: float) -> None:
        self.voltages_v = (right_v, left_v)
        self.timer_calls += 1

    def brake(self) -> None:
        self.drive(0.0, 0.0)

    def fans(self) -> tuple[float, float]:
        return self._duty

    def command_fans(self, left: float, right: float) -> None:
        self._duty = (left, right)


_VOLTS = 0.5, 2.4  # without and with a panel


def _voltages(row: EdgeTuple) -> tuple[float, float, float, float, float]:
    t_s, a, b, c, d = row
    return t_s, _VOLTS[a], _VOLTS[b], _VOLTS[c], _VOLTS[d]
