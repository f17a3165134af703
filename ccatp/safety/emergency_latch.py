"""Emergencies of the observatory: the latch with one entry per id, and the replies to the observatory's requests."""

from collections.abc import Sequence
from dataclasses import dataclass

import msgspec

from ccatp.conditions import MonitorFinding
from ccatp.conditions.danger import EARTHQUAKE, EMERGENCY
from ccatp.core import Cause, EmergencyKind, EventCode, Verdict
from ccatp.links.channels import (
    BadRequest,
    EmergencyRequest,
    PingRequest,
    format_error,
    format_ok,
    parse_observatory,
    uuid_of,
)

# An observatory reports a few at a time. The bounds keep a peer from filling the memory.
MAX_ACTIVE = 256
MAX_CLEARED = 1024
# Main acts on a verdict one frame later at the latest, so its estimate of a later frame takes the verdict into account.
INFORMED_AFTER_FRAMES = 2
# The mission's states (``ccatp.survey.events``) in which the robot stands at base or is held.
AT_BASE_OR_HELD = frozenset({"idle", "held", "done"})


@dataclass(frozen=True, slots=True)
class Emergency:
    """One emergency as the observatory reported it."""

    kind: EmergencyKind
    id: str
    note: str


def cause_of(kind: EmergencyKind) -> Cause:
    """The condition of a kind of emergency; in an earthquake the robot must not move."""
    return EARTHQUAKE.cause() if kind is EmergencyKind.EARTHQUAKE else EMERGENCY.cause(kind=kind.value)


class EmergencyLatch:
    """Code 2 holds while any emergency is active.

    Each id is raised once and cleared once; repeats have no effect. A clear is refused while the robot is neither at
    base nor held, and for an id that was never raised. No input reports whether the cause is gone: who clears answers
    for it. ``raised`` counts the emergencies latched so far.
    """

    def __init__(self) -> None:
        self._active: dict[str, Emergency] = {}
        self._cleared: dict[str, None] = {}
        self.raised = 0

    @property
    def is_latched(self) -> bool:
        """Whether any emergency is active."""
        return bool(self._active)

    @property
    def is_shaking(self) -> bool:
        """Whether an earthquake is active: no motion is permitted until it is cleared."""
        return any(emergency.kind is EmergencyKind.EARTHQUAKE for emergency in self._active.values())

    @property
    def newest(self) -> Emergency | None:
        """The emergency raised last among the active ones."""
        return next(reversed(self._active.values())) if self._active else None

    @property
    def causes(self) -> list[Cause]:
        """The cause of each active kind."""
        return [cause_of(kind) for kind in dict.fromkeys(one.kind for one in self._active.values())]

    def verdict(self, seq: int, t_s: float) -> Verdict | None:
        """Verdict of the newest emergency, or ``None``. Motion is permitted, because the robot shall drive home."""
        newest = self.newest
        if newest is None:
            return None
        # A robot that moves in an earthquake slides. From the other emergencies it drives home.
        kind = EmergencyKind.EARTHQUAKE if self.is_shaking else newest.kind
        row, cause, signal = EARTHQUAKE if self.is_shaking else EMERGENCY, cause_of(kind), f"emergency:{kind}"
        return Verdict(seq, t_s, row.code, cause, signal, 1.0, 0.0, *row.motion.permits())

    def with_emergencies(self, verdict: Verdict) -> Verdict:
        """A verdict with the state of the latch added, because its code may come from another rule."""
        if not self._active:
            return verdict
        return msgspec.structs.replace(verdict, raised=self.raised, is_shaking=self.is_shaking)

    def holds(self, emergency_id: str) -> bool:
        """Whether the emergency with this id is active."""
        return emergency_id in self._active

    def raise_emergency(self, kind: str, emergency_id: str, note: str = "") -> str | None:
        """Latch an emergency; returns why it was refused, or None. A repeated or cleared id has no effect."""
        if emergency_id in self._cleared:
            return None
        # A known id keeps its kind, except that it may become an earthquake, which holds the robot.
        known = self._active.get(emergency_id)
        if known is not None and (kind != EmergencyKind.EARTHQUAKE or known.kind is EmergencyKind.EARTHQUAKE):
            return None
        if kind not in EmergencyKind.__members__.values():
            return f"unknown kind {kind!r}"
        # When the latch is full, the first emergency of each kind is still accepted.
        has_room = known is not None or len(self._active) < MAX_ACTIVE
        if not has_room and any(emergency.kind == kind for emergency in self._active.values()):
            return f"{MAX_ACTIVE} emergencies are active already (the operation is aborted)"
        self._active[emergency_id] = Emergency(EmergencyKind(kind), emergency_id, note)
        self.raised += 1
        return None

    def clear(self, emergency_id: str, at_base_or_held: bool) -> str | None:
        """Clear one emergency; returns why it was refused, or None. A cleared id has no effect."""
        if emergency_id in self._cleared:
            return None
        emergency = self._active.get(emergency_id)
        if emergency is None:
            return "no emergency with that id"
        if not at_base_or_held:
            return "the robot is neither at base nor held"
        del self._active[emergency_id]
        self._cleared[emergency_id] = None
        if len(self._cleared) > MAX_CLEARED:
            del self._cleared[next(iter(self._cleared))]
        return None


class EmergencyRules:
    """Base of the danger rules of each kind of robot: the emergencies of the observatory.

    A subclass sets ``_frame_seq``, the newest frame, and ``_state`` and ``_state_seq``: the mission's state in main's
    newest estimate (empty: not known) and the frame of that estimate. ``found``: findings of the monitors in the newest
    frame.
    """

    found: Sequence[MonitorFinding] = ()
    _frame_seq: int
    _state: str
    _state_seq: int

    def __init__(self) -> None:
        self.latch = EmergencyLatch()
        self.reset()

    def reset(self) -> None:
        """Begin a new session with the robot (its clock and numbers start again). Emergencies stay latched."""
        self._raised_seq = -INFORMED_AFTER_FRAMES - 1  # newest frame when the newest emergency was raised

    @property
    def code(self) -> EventCode:
        """The event code, from emergencies alone."""
        return EventCode.ABORTED if self.latch.is_latched else EventCode.NORMAL

    @property
    def at_base_or_held(self) -> bool:
        """Whether main reports so, in an estimate that takes the newest emergency into account."""
        return self._state_seq > self._raised_seq + INFORMED_AFTER_FRAMES and self._state in AT_BASE_OR_HELD

    def emergency(self, kind: str, emergency_id: str, note: str = "") -> str | None:
        """Latch an emergency; returns why it was refused, or None. A repeated id has no effect."""
        before = self.latch.raised
        refusal = self.latch.raise_emergency(kind, emergency_id, note)
        if self.latch.raised != before:
            self._raised_seq = self._frame_seq
        return refusal

    def clear(self, emergency_id: str, at_base_or_held: bool) -> str | None:
        """Clear an emergency; returns why it was refused, or None."""
        return self.latch.clear(emergency_id, at_base_or_held)


def answer_observatory(
    frame: bytes, handler: EmergencyRules, *, at_base_or_held: bool, age_s: float | None, may_clear: bool = True
) -> bytes:
    """The reply to a request on the observatory channel. ``age_s``: of the last verdict, ``None`` before the first."""
    try:
        request = parse_observatory(frame)
    except BadRequest as error:
        return format_error(str(error))
    if isinstance(request, PingRequest):
        return format_ok(code=int(handler.code), age_s=age_s)
    key = uuid_of(request.id)
    if isinstance(request, EmergencyRequest):
        refusal = handler.emergency(request.kind.value, key, request.note)
        # The reply shows the latch, because the code of an edge may hide that of the abort. A cleared id is not latched
        # again; the reply says so, because the client may mean another emergency.
        is_held = handler.latch.holds(key)
        accepted = format_ok(id=request.id, latched=is_held, code=int(EventCode.ABORTED if is_held else handler.code))
    elif not may_clear:
        refusal, accepted = "this client may raise emergencies, not clear them", b""
    else:
        refusal = handler.clear(key, at_base_or_held)
        accepted = format_ok(id=request.id, code=int(handler.code))
    return accepted if refusal is None else format_error(refusal, id=request.id)
