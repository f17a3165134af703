"""Pauses whose cause only the main loop finds: frames that are late, old or missing. It measures how long they last."""

from msgspec.structs import replace

from ccatp.conditions import Condition, Owner, find_condition, text_of
from ccatp.core import Severity
from ccatp.daemon.loops.mission_runner import LoopLimits, MissionRunner
from ccatp.safety.escalation import Since, find_limit_s
from ccatp.survey.engagement import Engagement
from ccatp.survey.events import HELD, Fault, Interrupted


class PauseWatch:
    """Pauses a mission, and escalates a pause that lasts."""

    def __init__(self, runner: MissionRunner, limits: LoopLimits, cfg: object) -> None:
        self._runner = runner
        self._cfg = cfg
        self._limits = limits
        self._paused = Since()
        self._has_gap = False

    def interrupt(self, row: Condition, **values: float) -> bool:
        """Hold the mission until frames are fresh; returns whether this changed its state or its cause."""
        mission, cause = self._runner.mission, row.cause(**values)
        before = mission.state
        mission.handle(Interrupted(cause))
        return mission.state is not before

    def escalate(self, now_s: float, *, counts: bool) -> None:
        """After the limit of its row a pause is what the row says; a hold needs a fix, and becomes a fault as well.

        ``counts``: the time counts; not in lockstep, whose time stands still meanwhile.
        """
        mission = self._runner.mission
        state = mission.state
        row = _own_pause_of(state)
        waits = row is not None and row.escalates_to is not None and not state.is_held_by_hand
        lasts_s = self._paused.lasts(now_s, waits and counts)
        self._has_gap = self._has_gap and lasts_s >= 0.0
        if row is None or lasts_s < 0.0:
            return
        limit_s = find_limit_s(row, self._cfg)
        is_fault = row.raised_severity is Severity.FAULT
        if lasts_s >= limit_s and not (is_fault or self._has_gap):
            self._has_gap = True
            self._runner.on_tracking_gap()
        fault_s = limit_s if is_fault else self._limits.hold_s
        if lasts_s >= fault_s:
            cause = replace(state.cause, lasted_s=fault_s)
            mission.handle(Fault(cause))
            self._runner.telemetry.notify_operator("error", text_of(cause))


def _own_pause_of(state: Engagement) -> Condition | None:
    """The row of a hold whose cause only the main loop finds."""
    row = find_condition(state.cause.condition) if state.mode is HELD else None
    return row if row is not None and row.owner is Owner.MAIN else None
