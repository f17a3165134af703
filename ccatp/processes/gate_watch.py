"""Glue. Tells when the last gate denies a drive, and why: at most one line per reason and second."""

from collections.abc import Callable

from ccatp.control.gate import Denial, DriveGate

REPEAT_S = 1.0

Say = Callable[[str, str], None]


class GateWatch:
    """Looks at the gate after each frame.

    Args:
        gate: main's gate.
        say: takes a level and a line, for the log and the bus.
    """

    def __init__(self, gate: DriveGate, say: Say) -> None:
        """Nothing denied yet."""
        self._gate, self._say = gate, say
        self._said_s: dict[Denial, float] = {}

    def look(self, t_s: float) -> None:
        """Tell of a drive denied in the frame of robot time ``t_s``."""
        denial = self._gate.denial
        if denial is None:
            return
        said_s = self._said_s.get(denial)
        # A clock that went back must not silence it.
        if said_s is not None and 0.0 <= t_s - said_s < REPEAT_S:
            return
        self._said_s[denial] = t_s
        self._say("warning", f"drive denied: {denial} ({self._gate.denied[denial]} so far)")

    @property
    def counts(self) -> dict[str, int]:
        """How often each reason stood in the way, those that never did left out."""
        return {denial.name.lower(): count for denial, count in self._gate.denied.items() if count}
