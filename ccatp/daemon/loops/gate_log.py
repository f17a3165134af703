"""Reports the drives that the gate denies."""

from collections.abc import Callable

from ccatp.control.gate import Denial, DriveGate

DENIAL_REPEAT_S = 1.0


class GateLog:
    """Reports denials of the gate, the same one at most once in ``DENIAL_REPEAT_S``."""

    def __init__(self, gate: DriveGate, notify: Callable[[str, str], None]) -> None:
        self._gate = gate
        self._notify = notify
        self._logged_s: dict[Denial, float] = {}

    def update(self, t_s: float) -> None:
        """Report a drive denied in the frame of robot time ``t_s``."""
        denial = self._gate.denial
        if denial is None:
            return
        logged_s = self._logged_s.get(denial)
        # The first comparison is for a clock that went back, which must not suppress the report.
        if logged_s is not None and 0.0 <= t_s - logged_s < DENIAL_REPEAT_S:
            return
        self._logged_s[denial] = t_s
        self._notify("warning", f"drive denied: {denial} ({self._gate.denied[denial]} so far)")

    @property
    def counts(self) -> dict[str, int]:
        """Number of denials by the reason, without zeros."""
        return {denial.name.lower(): count for denial, count in self._gate.denied.items() if count}
