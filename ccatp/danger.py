"""The danger loop's rules and their arbitration: from one sensors frame to one verdict (thesis 3.4).

A motion is permitted if all rules permit it. The code is the most urgent one: an edge (1) precedes an abort (2), which
precedes normal operation (0). The cause is that of the most restrictive rule.

* All four edge sensors off: code 1, no motion permitted (``ccatp.safety.edge_rule``, rule h).
* An edge declared: code 1, no motion towards a sensor that hangs over the edge, no turn except back.
* The robot's centre about to cross the rim of the map: likewise (``ccatp.safety.edge_rule``).
* Edge samples, encoder samples or the estimate missing or too old: no motion permitted, the code stays. This ends by
  itself as soon as they are fresh again; after missing encoder samples only with a fix.
* An emergency: code 2, latched, motion permitted because the robot shall drive home
  (``ccatp.safety.emergency_latch``). In an earthquake no motion is permitted until it is cleared.

The monitors of ``ccatp.safety.health_monitor`` check every frame. Each finding of a frame counts: any one that holds
the wheels denies all motion, and that of the highest severity gives the verdict its severity and its cause. A declared
edge keeps its code, and its cause as long as nothing holds the wheels.
"""

from collections.abc import Sequence
from math import isfinite

import msgspec

from ccatp.clocks import SteadyTime
from ccatp.conditions import MonitorFinding
from ccatp.conditions import danger as conditions
from ccatp.config.models import Config, DangerConfig, HealthConfig, RobotConfig
from ccatp.core import NO_MOTION, Corner, DeckPose, EdgeSample, EventCode, Permits, Verdict, WheelSample
from ccatp.links.robot_messages import Sensors
from ccatp.links.topics import EstimateMessage
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.safety.edge_episode import FoundEdge
from ccatp.safety.edge_map import EdgeMap
from ccatp.safety.edge_rule import CentreClearanceCheck, EdgeRule
from ccatp.safety.escalation import SeverityEscalation, most_severe, with_findings
from ccatp.safety.health_monitor import HealthMonitor
from ccatp.safety.rules import SafetyRules
from ccatp.sensing.sample_times import possible_gravity, possible_samples

CORNERS = tuple(Corner)
CLOCK_JUMP_S = 0.1
EVERYWHERE = (True, True, True, True)


class DangerMonitor(SafetyRules):
    """Gives one verdict per sensors frame. Without ``health`` only edges, ages and emergencies are checked."""

    def __init__(
        self, mirror: Mirror, robot: RobotConfig, cfg: DangerConfig, health: HealthConfig | None = None
    ) -> None:
        self._rim = mirror.rim
        self._robot = robot
        self._cfg = cfg
        self._clock_jump_s = CLOCK_JUMP_S if health is None else health.clock_jump_s
        self._map = EdgeMap(mirror)
        self._edges = EdgeRule(self._map, robot, cfg)
        self._health: HealthMonitor | None = None
        if health is not None:
            self._health = HealthMonitor(health, cfg, robot, mirror, self._is_explained)
        super().__init__()

    def reset(self) -> None:
        """Begin a new session with the robot: its clock and numbers restart. Emergencies stay latched."""
        super().reset()
        self._edges.reset()
        self._centre_clearance = CentreClearanceCheck(self._rim, self._robot, self._cfg)
        self._time = SteadyTime(self._clock_jump_s)
        self._edge_t_s: float | None = None
        self._frame_seq = self._state_seq = -1
        self._state = ""
        self._known: EstimateMessage | None = None
        if self._health is not None:
            self._health.reset()
            self._escalation = SeverityEscalation(self._health.cfg)
        self.verdict = self.stale(-1, 0.0)

    def limit_wheels(self, max_wheel_rad_s: float) -> None:
        """Take the robot's own limit for the wheels' rates, after a reset."""
        if self._health is not None:
            self._health.limit_wheels(min(max_wheel_rad_s, self._robot.max_wheel_rad_s))

    @property
    def code(self) -> EventCode:
        """The event code now."""
        if self._edges.is_lifted or self._centre_clearance.direction or self._declared() is not None:
            return EventCode.NEAR_EDGE
        return super().code

    @property
    def counts(self) -> dict[str, dict[Corner, int]]:
        """Number of episodes and of declared edges, by sensor."""
        counted = {"episodes": self._edges.opened, "edges": self._edges.declared}
        return {name: dict(zip(CORNERS, numbers, strict=True)) for name, numbers in counted.items()}

    # -- frames ---------------------------------------------------------------------------------------------------

    def judge(self, sensors: Sensors, _raw: bytes, estimate: EstimateMessage | None) -> Verdict:
        """See ``SafetyRules``."""
        return self.step(sensors, estimate)

    def step(self, sensors: Sensors, estimate: EstimateMessage | None) -> Verdict:
        """The verdict on a frame, with main's newest estimate. A frame that is not new is not judged: no motion."""
        seq = sensors.seq
        if seq <= self._frame_seq:
            return self.stale(seq, sensors.t)
        edges, clearance, time, health = self._edges, self._centre_clearance, self._time, self._health
        t_s = time.at(seq, sensors.t)
        sensors = self._with_possible_times(sensors, t_s)
        wheels: Sequence[WheelSample] = sensors.enc
        samples: Sequence[EdgeSample] = sensors.edge
        if time.offset_s or time.jump is not None:
            wheels, samples = time.of_samples(wheels, t_s), time.of_samples(samples, t_s)
            if estimate is not None:
                estimate = msgspec.structs.replace(estimate, t_s=time.of(estimate.seq, estimate.t_s))
        edges.track.push(wheels)
        lost = self._estimate_missing(t_s, estimate)
        self._known = known = estimate if lost is None else None
        self._frame_seq = seq
        self._state = ""
        if known is not None:
            self._state = known.state
            self._state_seq = known.seq
            clearance.step(t_s, known, wheels)
        edges.step(samples, known)
        if samples:
            self._edge_t_s = samples[-1][0]
        missing = self._samples_missing(t_s)
        if lost is not None:
            missing = [*missing, lost]
        found: Sequence[MonitorFinding] = ()
        if health is not None:
            if known is None and estimate is not None and isfinite(estimate.t_s):
                health.take_commands(estimate.t_s, estimate)
            found = self._run_monitors(health, sensors, t_s, wheels, samples)
        self.found = ()
        if not found and not missing and edges.is_idle and not clearance.direction and not self.latch.is_latched:
            self.verdict = verdict = Verdict.normal(seq, sensors.t)
            if health is not None and self._escalation.is_counting:
                self._escalation.escalate(t_s, [])
        else:
            verdict = self._arbitrate(seq, sensors.t, missing)
            if health is not None:
                self._suspect_sensors(health.cfg.stuck_off_m)
                findings = [*found, *missing, *self._edge_findings(health.cfg.stuck_off_m)]
                self.found = self._escalation.escalate(t_s, findings)
                verdict = with_findings(verdict, self.found)
            self.verdict = verdict = self.latch.with_emergencies(verdict)
        return verdict

    def _with_possible_times(self, frame: Sensors, t_s: float) -> Sensors:
        """The frame without samples of impossible times. What is left out is missing, and it is reported."""
        imu, enc = possible_samples(frame.t, frame.imu), possible_samples(frame.t, frame.enc)
        edge, gravity = possible_samples(frame.t, frame.edge), possible_gravity(frame.t, frame.gravity)
        if imu is frame.imu and enc is frame.enc and edge is frame.edge and gravity is frame.gravity:
            return frame
        if self._health is not None:
            self._health.misdated(t_s, frame)
        return msgspec.structs.replace(frame, imu=imu, enc=enc, edge=edge, gravity=gravity)

    # -- monitors -------------------------------------------------------------------------------------------------

    def _run_monitors(
        self,
        health: HealthMonitor,
        sensors: Sensors,
        t_s: float,
        wheels: Sequence[WheelSample],
        samples: Sequence[EdgeSample],
    ) -> Sequence[MonitorFinding]:
        known, jump, last = self._known, self._time.jump, self.verdict
        if jump is not None and jump.seq == sensors.seq:
            health.jumped(t_s, jump.by_s)
        if known is not None:
            health.learn(known.t_s, known, self._edges.opened, self._edges.episodes)
        is_permitted = last.forward and last.reverse and last.turn
        health.step(t_s, sensors, wheels, samples, is_permitted=is_permitted, is_any_off=not self._edges.is_idle)
        return health.findings

    def _place(self, known: EstimateMessage, sensor: int) -> tuple[float, float]:
        pose = DeckPose(known.x_m, known.y_m, known.heading_rad)
        return self._map.place(pose, self._robot.edge_sensors_m[sensor])

    def _is_explained(self, sensor: int) -> bool:
        """Whether the map has an edge of a panel near a sensor, at the newest estimate; true without an estimate."""
        known, cfg = self._known, self._cfg
        if known is None:
            return True
        slack_m = cfg.gap_tolerance_m + cfg.seam_extra_m + cfg.map_sigmas * known.sigma_m
        return self._map.has_edge_near(self._place(known, sensor), slack_m)

    def _edge_findings(self, limit_m: float) -> list[MonitorFinding]:
        """Findings beside a declared edge. ``limit_m``: see ``_suspect_sensors``."""
        found = []
        if self._edges.is_lifted:
            found.append(conditions.LIFTED.found("edge", 4.0, 3.0))
        for i, episode in enumerate(self._edges.episodes):
            if episode is not None and episode.is_suspect:
                found.append(conditions.EDGE_SENSOR_STAYS_OFF.found(CORNERS[i].value, episode.retreat_m, limit_m))
        return found

    def _suspect_sensors(self, limit_m: float) -> None:
        """Suspect each sensor that stays off ``limit_m`` from the place of its edge, until its episode ends."""
        for i, episode in enumerate(self._edges.episodes):
            if episode is None or episode.edge is None or episode.retreat_m < limit_m:
                continue
            known = self._known
            others = (e is None or e is episode or e.is_on for e in self._edges.episodes)
            is_over_rim = known is not None and self._map.is_beyond_rim(self._place(known, i))
            if all(others) and not is_over_rim:
                episode.is_suspect = True

    # -- what is missing ------------------------------------------------------------------------------------------

    def stale(self, seq: int, t_s: float) -> Verdict:
        """The verdict when no frame arrived for ``stale_after_s`` after frame ``seq``: no motion is permitted."""
        limit_s = self._cfg.stale_after_s
        return self._denied(seq, t_s, conditions.NO_FRAME.found("sensors", limit_s, limit_s))

    def garbled(self, seq: int, t_s: float, at_s: float) -> Verdict | None:
        """Count a line after frame ``seq`` that is not a frame. Too many give a verdict that permits no motion."""
        found = None if self._health is None else self._health.garbled(at_s)
        return None if found is None else self._denied(seq, t_s, found)

    def _denied(self, seq: int, t_s: float, finding: MonitorFinding) -> Verdict:
        return self.latch.with_emergencies(finding.verdict(seq, t_s, self.code))

    def _samples_missing(self, t_s: float) -> Sequence[MonitorFinding]:
        """Findings about each silent sensor. A pause for one must not hide the hold for another."""
        limit_s, edge_t_s = self._cfg.stale_after_s, self._edge_t_s
        silent_s = self._edges.track.silence_s(t_s)
        if edge_t_s is not None and abs(t_s - edge_t_s) <= limit_s and silent_s <= 0.0:
            return ()
        found = []
        if edge_t_s is None:
            found.append(conditions.NO_EDGE_SAMPLES.found("edge", limit_s, limit_s))
        elif not (age_s := abs(t_s - edge_t_s)) <= limit_s:
            found.append(conditions.EDGE_STALE.found("edge", age_s, limit_s))
        if not silent_s <= 0.0:  # without wheel samples the robot's motion is not known
            found.append(conditions.ENCODERS_STALE.found("enc", silent_s, limit_s))
        return found

    def _estimate_missing(self, t_s: float, estimate: EstimateMessage | None) -> MonitorFinding | None:
        limit_s = self._cfg.estimate_stale_after_s
        if estimate is None:
            return conditions.NO_ESTIMATE.found("estimate", limit_s, limit_s)
        age_s = abs(t_s - estimate.t_s)
        if isfinite(age_s) and age_s > limit_s:
            return conditions.ESTIMATE_STALE.found("estimate", age_s, limit_s)
        if isfinite(age_s + estimate.x_m + estimate.y_m + estimate.heading_rad + estimate.sigma_m):
            return None
        # The values are sent as JSON, which has no number for an age that is not finite.
        return conditions.ESTIMATE_NOT_FINITE.found("estimate", limit_s, limit_s)

    # -- arbitration ----------------------------------------------------------------------------------------------

    def _declared(self) -> FoundEdge | None:
        return next((e.edge for e in self._edges.episodes if e is not None and e.edge is not None), None)

    def _arbitrate(self, seq: int, t_s: float, findings: Sequence[MonitorFinding]) -> Verdict:
        missing = most_severe(findings)
        if self._edges.is_lifted:
            row = conditions.ALL_OFF
            permits = row.motion.permits()
            return Verdict(seq, t_s, row.code, row.cause(), "edge", 4.0, 3.0, *permits, off=EVERYWHERE)
        declared = self._declared()
        if declared is not None or self._centre_clearance.direction:
            return self._edge_verdict(seq, t_s, declared, missing)
        if missing is not None:
            return self._denied(seq, t_s, missing)
        emergency = self.latch.verdict(seq, t_s)
        return emergency or Verdict.normal(seq, t_s)

    def _edge_verdict(
        self, seq: int, t_s: float, declared: FoundEdge | None, missing: MonitorFinding | None
    ) -> Verdict:
        clearance, barred = self._centre_clearance, self._centre_clearance.direction
        if declared is not None:
            a, b, c, d = (e is not None and e.edge is not None for e in self._edges.episodes)
            off, turn = (a, b, c, d), not barred and all(e is None or e.permits_turn for e in self._edges.episodes)
            row, signal = declared.cause, CORNERS[off.index(True)].value
            value, limit = declared.value_m, declared.limit_m
        else:
            off, turn = (barred > 0, barred > 0, barred < 0, barred < 0), False
            row, signal = conditions.CENTRE_NEAR_RIM, "estimate"
            value, limit = clearance.clearance_m, clearance.limit_m
        forward, reverse = barred <= 0 and not (off[0] or off[1]), barred >= 0 and not (off[2] or off[3])
        cause, permits = row.cause(), row.motion.permits(Permits(forward, reverse, turn))
        if missing is not None:
            cause, permits = msgspec.structs.replace(cause, besides=missing.cause), NO_MOTION
        return Verdict(seq, t_s, row.code, cause, signal, value, limit, *permits, off=off)


def survey_rules(cfg: Config) -> SafetyRules:
    """The rules of a configuration."""
    return DangerMonitor(build_mirror(cfg.mirror), cfg.robot, cfg.danger, cfg.health)
