"""Emergencies of the observatory: latched, one entry per id, each with its clear condition."""

from dataclasses import dataclass

import msgspec

from ccatp.core import EmergencyKind, Verdict

# An observatory has a handful at a time; a peer that floods the latch must not fill the memory.
MAX_ACTIVE = 256
MAX_CLEARED = 1024
# Main acts on a verdict in the frame after it at the latest; what it says of a frame later than that knows of it.
INFORMED_AFTER_FRAMES = 2
# The mission's states (``ccatp.survey.state``) in which the robot stands at base or is held.
AT_BASE_OR_HELD = frozenset({"idle", "held", "done"})


@dataclass(frozen=True, slots=True)
class Emergency:
    """One emergency as the observatory reported it."""

    kind: EmergencyKind
    id: str
    note: str


def is_at_base_or_held(state: str) -> bool:
    """Whether a mission state, as main publishes it, means that the robot is at base or held."""
    return state in AT_BASE_OR_HELD


class EmergencyLatch:
    """Code 2 holds while any emergency is active.

    Each id is raised once, repeated without effect, and cleared once. A ``clear`` reports that the cause of that id is
    gone; it is refused while a level input says that the cause persists (``set_level``), while the robot is neither at
    base nor held, and for an id that was never raised. ``raised`` counts the emergencies latched so far.
    """

    def __init__(self) -> None:
        self._active: dict[str, Emergency] = {}
        self._cleared: dict[str, None] = {}
        self._levels: set[EmergencyKind] = set()
        self.raised = 0

    @property
    def is_latched(self) -> bool:
        """Whether any emergency is active."""
        return bool(self._active)

    @property
    def is_shaking(self) -> bool:
        """Whether an earthquake is active: nothing may move until it is cleared, whatever else there is."""
        return any(emergency.kind is EmergencyKind.EARTHQUAKE for emergency in self._active.values())

    @property
    def newest(self) -> Emergency | None:
        """The emergency raised last among the active ones."""
        return next(reversed(self._active.values())) if self._active else None

    def with_emergencies(self, verdict: Verdict) -> Verdict:
        """A verdict, with what it does not say of emergencies where something else gave its code."""
        if not self._active:
            return verdict
        return msgspec.structs.replace(verdict, raised=self.raised, is_shaking=self.is_shaking)

    def holds(self, emergency_id: str) -> bool:
        """Whether the emergency with that id is active."""
        return emergency_id in self._active

    def set_level(self, kind: EmergencyKind, active: bool) -> None:
        """State of a lasting input (a fire panel's contact, a seismometer's alarm): no clear of that kind while on."""
        (self._levels.add if active else self._levels.discard)(kind)

    def raise_emergency(self, kind: str, emergency_id: str, note: str = "") -> str | None:
        """Latch an emergency; returns why it was refused, or None.

        The same id again, also after its clear, has no effect.
        """
        if emergency_id in self._cleared:
            return None
        # The same id is the same emergency, whatever is said of it; but one that shakes the robot holds it.
        known = self._active.get(emergency_id)
        if known is not None and (kind != EmergencyKind.EARTHQUAKE or known.kind is EmergencyKind.EARTHQUAKE):
            return None
        if kind not in EmergencyKind.__members__.values():
            return f"unknown kind {kind!r}"
        # Whoever fills the latch with one kind does not keep the others out.
        has_room = known is not None or len(self._active) < MAX_ACTIVE
        if not has_room and any(emergency.kind == kind for emergency in self._active.values()):
            return f"{MAX_ACTIVE} emergencies are active already (the operation is aborted)"
        self._active[emergency_id] = Emergency(EmergencyKind(kind), emergency_id, note)
        self.raised += 1
        return None

    def clear(self, emergency_id: str, at_base_or_held: bool) -> str | None:
        """End one emergency; returns why it was refused, or None. Clearing a cleared id has no effect."""
        if emergency_id in self._cleared:
            return None
        emergency = self._active.get(emergency_id)
        if emergency is None:
            return "no emergency with that id"
        if emergency.kind in self._levels:
            return f"the cause persists: {emergency.kind}"
        if not at_base_or_held:
            return "the robot is neither at base nor held"
        del self._active[emergency_id]
        self._cleared[emergency_id] = None
        if len(self._cleared) > MAX_CLEARED:
            del self._cleared[next(iter(self._cleared))]
        return None
