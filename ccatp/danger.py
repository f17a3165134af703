"""The danger loop's rules and their arbitration: from one sensors frame to one verdict (thesis 3.4).

Permits are the conjunction of all rules. The code is that of the most urgent: an edge (1) outranks an abort (2), which
outranks normal operation (0). The cause is that of the rule that takes the most away.

* all four edge sensors off: code 1, nothing permitted (``ccatp.safety.edge_rule``, rule h);
* an edge declared: code 1, no motion towards a sensor that hangs over, no turn but back;
* the robot's centre about to drive over the rim on the map: likewise (``ccatp.safety.edge_rule``);
* edge samples, encoder samples or the estimate missing or older than allowed: nothing permitted, no code of its own;
  ends by itself as soon as they are fresh again;
* an emergency: code 2, latched, motion permitted, because the robot shall drive home
  (``ccatp.safety.emergency_latch``); in an earthquake nothing is permitted until it is cleared.

The monitors of ``ccatp.safety.monitor`` check every frame. Each finding has a severity; the gravest wins and gives the
verdict its cause, and any finding that holds the wheels withholds the permit. An edge that is to be left keeps its code
and its cause as long as nothing holds the wheels.
"""

from collections.abc import Sequence
from math import isfinite

import msgspec

from ccatp.conditions import (
    ALL_OFF,
    CENTRE_NEAR_RIM,
    EDGE_SENSOR_STAYS_OFF,
    EDGE_STALE,
    EMERGENCY,
    ENCODERS_STALE,
    ESTIMATE_NOT_FINITE,
    ESTIMATE_STALE,
    LIFTED,
    NO_EDGE_SAMPLES,
    NO_ESTIMATE,
    NO_FRAME,
    MonitorFinding,
)
from ccatp.config.models import DangerConfig, HealthConfig, RobotConfig
from ccatp.core import Corner, EdgeSample, EmergencyKind, EventCode, Severity, Verdict, WheelSample
from ccatp.links.robot_messages import Sensors
from ccatp.links.topics import EstimateMessage
from ccatp.mirror.mirror import Mirror
from ccatp.safety.edge_detector import EdgeDetector, EdgeMap, EdgePhase
from ccatp.safety.edge_rule import CentreClearanceCheck, EdgeRule
from ccatp.safety.emergency_latch import INFORMED_AFTER_FRAMES, EmergencyLatch, is_at_base_or_held
from ccatp.safety.escalation import SeverityEscalation, denies, gravest
from ccatp.safety.monitor import HealthMonitor
from ccatp.safety.robot_clock import SteadyTime
from ccatp.safety.sensor_monitors import FramingErrorRate

CORNERS = tuple(Corner)
CLOCK_JUMP_S = 0.1
EVERYWHERE = (True, True, True, True)
_NORMAL = EventCode.NORMAL  # a member looked up on its class in every frame costs more than the verdict made of it


class DangerMonitor:
    """Judges sensors frames. Call ``step`` once per frame, ``stale`` when no frame came in time.

    Without ``health`` there are no monitors: only the rules of edges, ages and emergencies.
    """

    def __init__(
        self, mirror: Mirror, robot: RobotConfig, cfg: DangerConfig, health: HealthConfig | None = None
    ) -> None:
        self._cfg, self._sensors_m, self._health = cfg, robot.edge_sensors_m, health
        self._map = EdgeMap(mirror)
        self._edges = EdgeRule(self._map, robot, cfg)
        self._board: HealthMonitor | None = None
        if health is not None:
            self._board = HealthMonitor(health, cfg, robot, mirror, self._is_explained)
            self._ladder = SeverityEscalation(health)
            self._garbled = FramingErrorRate(health.garbled_lines, health.garbled_window_s)
        self._time = SteadyTime(CLOCK_JUMP_S if health is None else health.clock_jump_s)
        self._origin = CentreClearanceCheck(mirror.rim, robot, cfg)
        self._stale_after_s, self._estimate_stale_after_s = cfg.stale_after_s, cfg.estimate_stale_after_s
        self.latch = EmergencyLatch()
        self.reset()

    def reset(self) -> None:
        """Begin a new session with the robot (its clock and numbers start again). Emergencies stay latched."""
        self._edges.reset()
        self._origin.reset()
        self._edge_t_s: float | None = None
        self._state = ""
        self._known: EstimateMessage | None = None
        self._raised_seq = -INFORMED_AFTER_FRAMES - 1  # the frame in which the newest emergency was raised
        self._time.reset()
        self._is_climbing = False
        if self._board is not None:
            self._board.reset()
            self._ladder.reset()
        self.verdict = self.stale(-1, 0.0)

    # -- emergencies ----------------------------------------------------------------------------------------------

    def emergency(self, kind: str, emergency_id: str, note: str = "") -> str | None:
        """Latch an emergency; returns why it was refused, or None. The same id again is harmless."""
        before = self.latch.raised
        refusal = self.latch.raise_emergency(kind, emergency_id, note)
        if self.latch.raised != before:
            self._raised_seq = self.verdict.seq
        return refusal

    def clear(self, emergency_id: str, at_base_or_held: bool) -> str | None:
        """End an emergency; returns why it was refused, or None."""
        return self.latch.clear(emergency_id, at_base_or_held)

    def holds(self, emergency_id: str) -> bool:
        """Whether the emergency with that id is active."""
        return self.latch.holds(emergency_id)

    def set_level(self, kind: EmergencyKind, active: bool) -> None:
        """Whether a lasting cause is present; see ``EmergencyLatch.set_level``."""
        self.latch.set_level(kind, active)

    @property
    def at_base_or_held(self) -> bool:
        """Whether main's newest estimate says so, if it is fresh and knows of the newest emergency."""
        known = self._known
        if known is None or known.seq <= self._raised_seq + INFORMED_AFTER_FRAMES:
            return False
        return is_at_base_or_held(self._state)

    @property
    def code(self) -> EventCode:
        """The event code now."""
        if self._edges.is_lifted or self._origin.direction or self._declared() is not None:
            return EventCode.NEAR_EDGE
        return EventCode.ABORTED if self.latch.is_latched else EventCode.NORMAL

    @property
    def counts(self) -> dict[str, object]:
        """For the log, at the end of a run."""
        return {"episodes": self.episodes_opened, "edges": self.edges_declared}

    @property
    def episodes_opened(self) -> dict[Corner, int]:
        """How often each sensor left the panels."""
        return dict(zip(CORNERS, self._edges.opened, strict=True))

    @property
    def edges_declared(self) -> dict[Corner, int]:
        """How often each sensor declared an edge."""
        return dict(zip(CORNERS, self._edges.declared, strict=True))

    # -- frames ---------------------------------------------------------------------------------------------------

    def step(self, sensors: Sensors, estimate: EstimateMessage | None) -> Verdict:
        """The verdict on a frame, with main's newest estimate; a frame that is not new gets the last verdict again."""
        seq = sensors.seq
        wheels: Sequence[WheelSample] = sensors.enc
        samples = sensors.edge
        if seq <= self.verdict.seq:
            return self.verdict
        edges, origin, time = self._edges, self._origin, self._time
        t_s = time.at(seq, sensors.t)
        if time.offset_s or time.jump is not None:
            wheels, samples = time.of_samples(wheels, t_s), time.of_samples(samples, t_s)
            if estimate is not None:
                estimate = msgspec.structs.replace(estimate, t_s=time.of(estimate.seq, estimate.t_s))
        edges.track.push(wheels)
        self._known = known = estimate if estimate is not None and self._is_fresh(estimate, t_s) else None
        if known is not None:
            self._state = known.state
            origin.step(t_s, known, wheels)
        else:
            self._state = ""
        edges.step(samples, known)
        if samples:
            self._edge_t_s = samples[-1][0]
        missing = self._missing(t_s, estimate, known is not None)
        if known is None and estimate is not None and self._board is not None and isfinite(estimate.t_s):
            self._board.take_commands(estimate.t_s, estimate)
        found = self._look(sensors, t_s, wheels, samples) if self._board is not None else ()
        if not found and missing is None and edges.is_idle and not origin.direction and not self.latch.is_latched:
            self.verdict = verdict = Verdict(seq, sensors.t, _NORMAL, "", "", 0.0, 0.0, True, True, True)
            if self._is_climbing:
                self._climb(t_s, [])
        else:
            verdict = self._arbitrate(seq, sensors.t, missing)
            if self._board is not None:
                verdict = self._weigh(verdict, self._climb(t_s, [*found, *self._own_findings(missing)]))
            self.verdict = verdict = self.latch.with_emergencies(verdict)
        return verdict

    # -- monitors -------------------------------------------------------------------------------------------------

    def _look(
        self, sensors: Sensors, t_s: float, wheels: Sequence[WheelSample], samples: list[EdgeSample]
    ) -> Sequence[MonitorFinding]:
        board, known, jump = self._board, self._known, self._time.jump
        if board is None:
            return ()
        if jump is not None and jump.seq == sensors.seq:
            board.jumped(t_s, jump.by_s)
        if known is not None:
            board.learn(known.t_s, known, self._edges.opened, self._edges.episodes)
        last = self.verdict
        is_permitted = last.forward and last.reverse and last.turn
        board.step(t_s, sensors, wheels, samples, is_permitted=is_permitted, is_any_off=not self._edges.is_idle)
        return board.findings

    def _is_explained(self, sensor: int) -> bool:
        """Whether the map has an edge of a panel near a sensor, as far as the estimate tells."""
        known = self._known
        if known is None:
            return True
        pose = known.x_m, known.y_m, known.heading_rad
        cfg = self._cfg
        slack_m = cfg.gap_tolerance_m + cfg.seam_extra_m + cfg.map_sigmas * known.sigma_m
        return self._map.has_edge_near(self._map.place(pose, self._sensors_m[sensor]), slack_m)

    def _own_findings(self, missing: MonitorFinding | None) -> list[MonitorFinding]:
        found = [] if missing is None else [missing]
        if self._health is None:
            return found
        if self._edges.is_lifted:
            found.append(LIFTED.found("edge", 4.0, 3.0))
        for i, episode in enumerate(self._edges.episodes):
            if episode is not None and self._stays_off(i, episode):
                limit_m = self._health.stuck_off_m
                found.append(EDGE_SENSOR_STAYS_OFF.found(CORNERS[i].value, episode.retreat_m, limit_m))
        return found

    def _stays_off(self, sensor: int, episode: EdgeDetector) -> bool:
        """Once that is so, it stays so until the sensor has been on for long enough to end the episode."""
        if episode.phase is not EdgePhase.DECLARED or self._health is None:
            return False
        if not episode.is_doubted and episode.retreat_m >= self._health.stuck_off_m:
            others = (e is None or e is episode or e.is_on for e in self._edges.episodes)
            episode.is_doubted = all(others) and not self._is_over_rim(sensor)
        return episode.is_doubted

    def _is_over_rim(self, sensor: int) -> bool:
        known = self._known
        if known is None:
            return False
        pose = known.x_m, known.y_m, known.heading_rad
        return self._map.is_beyond_rim(self._map.place(pose, self._sensors_m[sensor]))

    def _climb(self, t_s: float, found: list[MonitorFinding]) -> list[MonitorFinding]:
        self._is_climbing = bool(found)
        return self._ladder.climb(t_s, found)

    def _weigh(self, verdict: Verdict, found: list[MonitorFinding]) -> Verdict:
        top = gravest(found)
        if top is None:
            return verdict
        holds = denies(found)
        forward, reverse, turn = (False, False, False) if holds else (verdict.forward, verdict.reverse, verdict.turn)
        shown = verdict.cause, verdict.signal, verdict.value, verdict.limit
        is_kept = verdict.code is EventCode.NEAR_EDGE or (
            verdict.code is EventCode.ABORTED and top.severity < Severity.RETURN
        )
        if not verdict.cause or not is_kept or (holds and top.severity > Severity.PAUSE):
            shown = top.cause, top.signal, float(top.value), float(top.limit)
        return Verdict(
            *(verdict.seq, verdict.t_s, verdict.code, *shown, forward, reverse, turn, verdict.off),
            severity=top.severity,
            full_fans=any(finding.condition.full_fans for finding in found),
        )

    def stale(self, seq: int, t_s: float) -> Verdict:
        """The verdict when no sensors frame came for ``stale_after_s`` after frame ``seq``: nothing permitted."""
        limit_s = self._stale_after_s
        return self.latch.with_emergencies(self._denied(seq, t_s, NO_FRAME.found("sensors", limit_s, limit_s)))

    def garbled(self, seq: int, t_s: float, at_s: float) -> Verdict | None:
        """A line after frame ``seq`` was no frame. The verdict where there were too many: nothing permitted."""
        if self._board is None or not self._garbled.add(at_s):
            return None
        return self.latch.with_emergencies(self._denied(seq, t_s, self._board.garbled()))

    def _denied(self, seq: int, t_s: float, finding: MonitorFinding) -> Verdict:
        shown = finding.cause, finding.signal, finding.value, finding.limit
        return _verdict(seq, t_s, self.code, shown, severity=finding.severity)

    def _is_fresh(self, estimate: EstimateMessage, t_s: float) -> bool:
        # Written so that a time that is not a number is not fresh.
        return abs(t_s - estimate.t_s) <= self._estimate_stale_after_s and isfinite(
            estimate.x_m + estimate.y_m + estimate.heading_rad + estimate.sigma_m
        )

    def _missing(self, t_s: float, estimate: EstimateMessage | None, is_known: bool) -> MonitorFinding | None:
        limit_s = self._stale_after_s
        if self._edge_t_s is None:
            return NO_EDGE_SAMPLES.found("edge", limit_s, limit_s)
        age_s = abs(t_s - self._edge_t_s)
        if not age_s <= limit_s:
            return EDGE_STALE.found("edge", age_s, limit_s)
        silent_s = self._edges.track.silence_s(t_s)
        if silent_s > 0.0:
            # Without its wheels it is not known where the robot went meanwhile.
            return ENCODERS_STALE.found("enc", silent_s, limit_s)
        return None if is_known else self._estimate_missing(t_s, estimate)

    def _estimate_missing(self, t_s: float, estimate: EstimateMessage | None) -> MonitorFinding:
        # The values go out as JSON: an age that is not finite is no number there.
        limit_s = self._estimate_stale_after_s
        if estimate is None:
            return NO_ESTIMATE.found("estimate", limit_s, limit_s)
        age_s = abs(t_s - estimate.t_s)
        if isfinite(age_s) and age_s > limit_s:
            return ESTIMATE_STALE.found("estimate", age_s, limit_s)
        return ESTIMATE_NOT_FINITE.found("estimate", limit_s, limit_s)

    # -- arbitration ----------------------------------------------------------------------------------------------

    def _declared(self) -> EdgeDetector | None:
        return next((e for e in self._edges.episodes if e is not None and e.phase is EdgePhase.DECLARED), None)

    def _arbitrate(self, seq: int, t_s: float, missing: MonitorFinding | None) -> Verdict:
        if self._edges.is_lifted:
            return _verdict(seq, t_s, EventCode.NEAR_EDGE, (ALL_OFF.message, "edge", 4.0, 3.0), off=EVERYWHERE)
        declared = self._declared()
        if declared is not None or self._origin.direction:
            return self._edge_verdict(seq, t_s, declared, missing)
        if missing is not None:
            return self._denied(seq, t_s, missing)
        newest = self.latch.newest
        if newest is None:
            return Verdict(seq, t_s, EventCode.NORMAL, "", "", 0.0, 0.0, True, True, True)
        # Whoever drives while the ground shakes slips; the others are fled from.
        kind, may_move = (EmergencyKind.EARTHQUAKE, False) if self.latch.is_shaking else (newest.kind, True)
        cause, signal = EMERGENCY.message.format(kind=kind), f"emergency:{kind}"
        return Verdict(seq, t_s, EventCode.ABORTED, cause, signal, 1.0, 0.0, may_move, may_move, may_move)

    def _edge_verdict(
        self, seq: int, t_s: float, declared: EdgeDetector | None, missing: MonitorFinding | None
    ) -> Verdict:
        origin, barred = self._origin, self._origin.direction
        if declared is not None:
            a, b, c, d = (e is not None and e.phase is EdgePhase.DECLARED for e in self._edges.episodes)
            off, turn = (a, b, c, d), not barred and all(e is None or e.permits_turn for e in self._edges.episodes)
            cause, signal = str(declared.cause), CORNERS[off.index(True)].value
            value, limit = declared.value_m, declared.limit_m
        else:
            off, turn = (barred > 0, barred > 0, barred < 0, barred < 0), False
            cause, signal, value, limit = CENTRE_NEAR_RIM.message, "estimate", origin.clearance_m, origin.limit_m
        forward, reverse = barred <= 0 and not (off[0] or off[1]), barred >= 0 and not (off[2] or off[3])
        permits = (forward, reverse, turn)
        if missing is not None:
            cause, permits = f"{cause}; {missing.cause}", (False, False, False)
        return _verdict(seq, t_s, EventCode.NEAR_EDGE, (cause, signal, value, limit), permits, off)


def _verdict(
    seq: int,
    t_s: float,
    code: EventCode,
    shown: tuple[str, str, float, float],
    permits: tuple[bool, bool, bool] = (False, False, False),
    off: tuple[bool, bool, bool, bool] = (False, False, False, False),
    severity: Severity = Severity.NONE,
) -> Verdict:
    return Verdict(seq, t_s, code, *shown, *permits, off, severity)
