"""Pure. The last gate before the fans: on an overhanging mirror no command below the floor gets out."""

from math import isfinite


class FanGate:
    """Refuses duties that are none, or that would drop the robot.

    Args:
        floor: least duty of each fan where the mirror overhangs; 0 elsewhere.

    Attributes:
        refused: how many commands were refused.
    """

    def __init__(self, floor: float) -> None:
        """Nothing refused yet."""
        self._floor = floor
        self.refused = 0

    def refusal(self, left: float, right: float) -> str | None:
        """Why these duties must not be sent; None where they may. What the robot has stays in force then."""
        for name, duty in (("left", left), ("right", right)):
            if not isfinite(duty) or not 0.0 <= duty <= 1.0:
                why = f"duty {duty:g} of the {name} fan is not between 0 and 1"
            elif duty < self._floor:
                why = f"duty {duty:g} of the {name} fan is below the floor of {self._floor:g}"
            else:
                continue
            self.refused += 1
            return f"fan command refused: {why}; set robot.fan_duty"
        return None
