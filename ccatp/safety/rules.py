"""What the danger loop needs of the rules of each kind of robot."""

from collections.abc import Mapping
from typing import Any

from ccatp.conditions.danger import NO_FRAME
from ccatp.core import Verdict
from ccatp.links.robot_messages import Sensors
from ccatp.links.topics import EstimateMessage
from ccatp.safety.emergency_latch import EmergencyRules


class SafetyRules(EmergencyRules):
    """Base of the danger rules of each kind of robot.

    As it is, it denies motion without a fresh frame, and judges a frame by the emergencies alone.
    """

    def reset(self) -> None:
        """See ``EmergencyRules``."""
        super().reset()
        self._frame_seq = self._state_seq = -1
        self._state = ""

    @property
    def counts(self) -> Mapping[str, Any]:
        """Numbers for the log at the end."""
        return {}

    def limit_wheels(self, max_wheel_rad_s: float, /) -> None:
        """Take the robot's own limit for the wheels' rates, after a reset."""

    def judge(self, sensors: Sensors, _raw: bytes, estimate: EstimateMessage | None) -> Verdict:
        """The verdict on a frame, its line and main's newest estimate. One that is not new is not judged: no motion."""
        seq, t_s = sensors.seq, sensors.t
        if seq <= self._frame_seq:
            return self.stale(seq, t_s)
        self._frame_seq = seq
        if estimate is not None:
            self._state = estimate.state
            self._state_seq = estimate.seq
        return self.latch.with_emergencies(self.latch.verdict(seq, t_s) or Verdict.normal(seq, t_s))

    def stale(self, seq: int, t_s: float) -> Verdict:
        """The verdict without a fresh frame: no motion."""
        return self.latch.with_emergencies(NO_FRAME.found("sensors", 0.0, 0.0).verdict(seq, t_s, self.code))

    def garbled(self, seq: int, t_s: float, _at_s: float, /) -> Verdict | None:
        """The verdict on a line that cannot be read; ``None``: the last one stays."""
        return self.stale(seq, t_s)


def emergency_rules(_cfg: object) -> SafetyRules:
    """Rules that know emergencies alone, for a robot that nothing else endangers."""
    return SafetyRules()
