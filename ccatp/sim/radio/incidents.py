"""Pure. What befalls a robot among beacons by plan: radios fall silent, things stand in its way, the target comes."""

from collections.abc import Sequence

from ccatp.config.beacon_models import IncidentConfig, ObstacleIncidentConfig, RadioLossConfig, TargetApproachConfig
from ccatp.config.radio_models import SimObstacleConfig


class Incidents:
    """Each lasts from ``at_s`` for ``for_s``.

    Args:
        plan: the incidents.
    """

    def __init__(self, plan: Sequence[IncidentConfig]) -> None:
        self._losses = [one for one in plan if isinstance(one, RadioLossConfig)]
        self._things = [one for one in plan if isinstance(one, ObstacleIncidentConfig)]
        self._approaches = [one for one in plan if isinstance(one, TargetApproachConfig)]

    def is_heard(self, radio: str, time_s: float) -> bool:
        """Whether a radio sends."""
        return not any(_lasts(one, time_s) and (not one.beacons or radio in one.beacons) for one in self._losses)

    def obstacles(self, time_s: float) -> list[SimObstacleConfig]:
        """What was put into the room besides."""
        return [
            SimObstacleConfig(x_m=one.x_m, y_m=one.y_m, radius_m=one.radius_m)
            for one in self._things
            if _lasts(one, time_s)
        ]

    def approach_m_s(self, time_s: float) -> float | None:
        """How fast the target comes at the robot; None while it goes its own way."""
        return next((one.speed_m_s for one in self._approaches if _lasts(one, time_s)), None)


def _lasts(one: IncidentConfig, time_s: float) -> bool:
    return one.at_s <= time_s < one.at_s + one.for_s
