"""Reports to the operator why the robot stands."""

from math import inf

from ccatp.conditions import find_condition, text_of
from ccatp.config.models import LinkConfig
from ccatp.daemon.loops.mission_runner import MissionRunner
from ccatp.daemon.operator.alarms import AlarmList
from ccatp.links.bus import HeartbeatPublisher
from ccatp.survey.events import waits_for

# A robot that stands for longer is reported, with reason and advice, and again after each minute.
STANDS_REPORT_S, STANDS_REPEAT_S = 30.0, 60.0


class StandstillReport:
    """Decides when to report a standing robot: after ``STANDS_REPORT_S``, and after each ``STANDS_REPEAT_S``."""

    def __init__(self) -> None:
        self._since_s: float | None = None
        self._due_s = inf

    def lasts_s(self, now_s: float, *, stands: bool) -> float | None:
        """Duration of the standstill if a report is due, else ``None``."""
        if not stands:
            self._since_s = None
            return None
        if self._since_s is None:
            self._since_s, self._due_s = now_s, now_s + STANDS_REPORT_S
        if now_s < self._due_s:
            return None
        self._due_s = now_s + STANDS_REPEAT_S
        return now_s - self._since_s


class StandstillWatch:
    """Reports a robot that stands, with the reason and advice."""

    def __init__(
        self, runner: MissionRunner, heartbeat: HeartbeatPublisher, alarms: AlarmList, robot: LinkConfig
    ) -> None:
        self._runner = runner
        self._heartbeat = heartbeat
        self._alarms = alarms
        self._robot = f"the robot at {robot.host}:{robot.port}"
        self._report = StandstillReport()

    def update(self, now_s: float, *, is_withheld: bool) -> None:
        """Report if it is due; ``is_withheld``: in lockstep a frame waits for its answer, so no other comes."""
        stands = self._heartbeat.phase != "done" and self._runner.is_at_rest
        lasts_s = self._report.lasts_s(now_s, stands=stands)
        if lasts_s is not None:
            text = f"the robot has been stationary for {lasts_s:.0f} s: {self._reason(is_withheld)}"
            self._runner.telemetry.notify_operator("warning", text)

    def _reason(self, is_withheld: bool) -> str:
        phase, age_s, robot = self._heartbeat.phase, self._heartbeat.frame_age_s, self._robot
        if phase == "starting":
            return "waiting for the laser system; is its server running?"
        if phase == "ready":
            return f"waiting for the danger loop and {robot}; is it on, the network up?"
        if phase == "rejoining":
            return f"the link to {robot} is lost; is it on, the network up?"
        if not is_withheld and (age_s is None or age_s > STANDS_REPORT_S):
            return f"{robot} sends no frames; is it on, the network up?"
        if self._runner.is_busy:
            why = self._runner.status().cause or "is it ready, the line of sight free?"
            return f"waiting for a measurement of the laser system; {why}"
        # A mission that has not begun has no cause of its own while it waits for a finding of danger to end.
        state, alarms = self._runner.mission.state, self._alarms.alarms
        row, why = find_condition(state.cause.condition), text_of(state.cause)
        advice = row.advice if row is not None else ""
        if not why and alarms and not alarms[0].ended:
            why, advice = alarms[0].cause, alarms[0].advice
        if not why:
            return f"{state.mode}, and nothing is wrong: {waits_for(state.mode)}"
        otherwise = "'ccatp resume' continues" if state.is_paused else "continues by itself"
        return f"{state.mode}: {why}; {advice or otherwise}"
