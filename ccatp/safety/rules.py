"""What the danger loop needs of the rules of each kind of robot."""

from abc import abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from ccatp.core import Verdict
from ccatp.links.robot_messages import Sensors
from ccatp.links.topics import EstimateMessage
from ccatp.safety.emergency_latch import EmergencyRules


class SafetyRules(EmergencyRules):
    """Base of the danger rules of each kind of robot."""

    @property
    @abstractmethod
    def counts(self) -> Mapping[str, Any]:
        """Numbers for the log at the end."""

    @abstractmethod
    def limit_wheels(self, max_wheel_rad_s: float, /) -> None:
        """Take the robot's own limit for the wheels' rates, after a reset."""

    @abstractmethod
    def stale(self, seq: int, t_s: float) -> Verdict:
        """The verdict without a fresh frame: no motion."""

    @abstractmethod
    def garbled(self, seq: int, t_s: float, at_s: float, /) -> Verdict | None:
        """The verdict on a line that cannot be read; ``None``: the last one stays."""


class FrameRules(NamedTuple):
    """The danger rules of a robot, and how they judge a frame: its line and main's newest estimate."""

    rules: SafetyRules
    judge: Callable[[Sensors, bytes, EstimateMessage | None], Verdict]
