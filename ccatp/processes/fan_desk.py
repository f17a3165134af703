"""Glue. The fans that press the robot on: sent once a session, and again when they shall give all they can."""

from ccatp.control.fan_gate import FanGate
from ccatp.mission import Mission
from ccatp.processes.seat import Seat
from ccatp.processes.telling import Teller

FULL_FANS = (1.0, 1.0)


class FanDesk:
    """Sends fan duties through the fans' gate.

    Args:
        duty: of the configuration, left and right.
        seat: sends them.
        mission: held where they are refused.
        teller: tells that.
        has_floor: the mirror overhangs, and the robot's own floor counts.
    """

    def __init__(
        self, duty: tuple[float, float], seat: Seat, mission: Mission, teller: Teller, *, has_floor: bool
    ) -> None:
        """Nothing sent."""
        self._duty, self._seat, self._mission, self._teller = duty, seat, mission, teller
        self._has_floor, self._has_pressed_on = has_floor, False
        self._gate = FanGate(0.0)

    @property
    def refused(self) -> int:
        """How often duties were refused in this session."""
        return self._gate.refused

    def begin(self, floor: float) -> None:
        """A session begins with a robot that has this floor."""
        self._gate = FanGate(floor if self._has_floor else 0.0)

    def press_on(self) -> None:
        """All that they can from now on; said once."""
        if not self._has_pressed_on:
            self._has_pressed_on = True
            self.send()

    def send(self) -> None:
        """Send what is in force."""
        duty = FULL_FANS if self._has_pressed_on else self._duty
        refusal = self._gate.refusal(*duty)
        if refusal is None:
            self._seat.send_fans(duty)
        else:
            self._teller.say("error", refusal)
            self._mission.fault(refusal)
