"""Pure. Faults of wheels, fans and body: what the robot really does, whatever it is told."""

from collections.abc import Iterable

from ccatp.mirror.mirror import Mirror
from ccatp.sim.disturbances import LEVEL_SLOPE, Downhill
from ccatp.sim.faults.models import Blocked, Drift, Fault, Kidnap, Runaway, Slip, Weak
from ccatp.sim.faults.record import Record
from ccatp.sim.plant import BodyStep, Plant
from ccatp.sim.rules import Fans
from ccatp.sim.world import World


class _Step:
    """What one step of the world shall be like: right and left of each."""

    __slots__ = ("grip", "health", "rates_rad_s")

    def __init__(self, set_points_rad_s: tuple[float, float]) -> None:
        self.rates_rad_s, self.grip, self.health = [*set_points_rad_s], [1.0, 1.0], [1.0, 1.0]


class BodyFaults:
    """All faults of the body.

    Args:
        faults: those of wheels, fans and body.
        mirror: knows where downhill is.

    Attributes:
        records: what they did.
        drifts: the disturbances of the plant among them.
    """

    def __init__(self, faults: Iterable[Fault], mirror: Mirror) -> None:
        self.records = [Record(fault) for fault in faults]
        self.drifts = [
            _Gliding(record, record.fault, mirror) for record in self.records if isinstance(record.fault, Drift)
        ]
        self._has_weak_fan = any(isinstance(record.fault, Weak) for record in self.records)

    def act(self, world: World, fans: Fans, t_s: float, set_points_rad_s: tuple[float, float]) -> tuple[float, float]:
        """Before a step of the world; what its wheels turn by, right and left.

        Args:
            world: the world; a kidnap moves its body, a slip takes its grip.
            fans: their health is set.
            t_s: time at the start of the step.
            set_points_rad_s: what the robot wants of the right and of the left wheel.
        """
        step = _Step(set_points_rad_s)
        for record in self.records:
            fault = record.fault
            if isinstance(fault, Kidnap):
                _kidnap(record, fault, world, t_s)
            elif fault.is_active(t_s):
                _befall(record, step, world.plant, fans, t_s)
        if self._has_weak_fan:
            right, left = step.health
            fans.health = left, right  # the fans' own order
        world.grip = step.grip[0], step.grip[1]
        return step.rates_rad_s[0], step.rates_rad_s[1]


def _kidnap(record: Record, fault: Kidnap, world: World, t_s: float) -> None:
    """Once."""
    if fault.has_begun(t_s) and not record.injected.samples:
        world.displace(fault.dx_m, fault.dy_m, fault.dheading_rad)
        record.add(t_s)


def _befall(record: Record, step: _Step, plant: Plant, fans: Fans, t_s: float) -> None:
    """Let one lasting fault act on the wheels or fans that it names, or on both."""
    fault, rates = record.fault, step.rates_rad_s
    sides = {"right": (0,), "left": (1,)}.get(fault.signal.partition("_")[0], (0, 1))
    match fault:
        case Blocked():
            is_turning = plant.block(right=0 in sides, left=1 in sides)
            record.add(t_s, is_changed=is_turning or any(rates[k] for k in sides))
            for k in sides:
                rates[k] = 0.0
        case Runaway():
            record.add(t_s, is_changed=any(rates[k] != fault.rate_rad_s for k in sides))
            for k in sides:
                rates[k] = fault.rate_rad_s
        case Slip():
            record.add(t_s, is_changed=not plant.are_wheels_still or any(rates))
            for k in sides:
                step.grip[k] *= fault.factor
        case Weak():
            record.add(t_s, is_changed=any(fans.duty[1 - k] for k in sides))
            for k in sides:
                step.health[k] *= fault.share


class _Gliding:
    """A disturbance of the plant: downhill while the wheels are held at zero."""

    def __init__(self, record: Record, fault: Drift, mirror: Mirror) -> None:
        self._record, self._fault, self._downhill = record, fault, Downhill(mirror)

    def displace(
        self, plant: Plant, t_s: float, dt_s: float, forward_m: float, left_m: float, turn_rad: float
    ) -> BodyStep:
        right_set, _, left_set, _ = plant.servo
        if right_set or left_set or not self._fault.is_active(t_s):
            return forward_m, left_m, turn_rad
        ahead, aside, slope = self._downhill.of(plant)
        is_level = slope < LEVEL_SLOPE
        self._record.add(t_s, is_changed=not is_level)
        if is_level:
            return forward_m, left_m, turn_rad
        glide_m = self._fault.speed_m_s * dt_s / slope
        return forward_m + glide_m * ahead, left_m + glide_m * aside, turn_rad
