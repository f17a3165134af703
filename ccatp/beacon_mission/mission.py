"""Pure. A mission among beacons: from readings and the danger loop's verdict to set points. Time is an argument."""

from typing import NamedTuple

from ccatp.beacon_mission.holding import Holding
from ccatp.beacon_mission.navigator import Belief, Navigator
from ccatp.beacon_mission.permits import permitted
from ccatp.beacon_mission.senses import Senses
from ccatp.beacon_mission.states import FOLLOWING, HELD, IDLE, MAPPING, RETURNING, VISITING
from ccatp.config.radio_models import RadioConfig
from ccatp.control.beacon_pilot import BeaconPilot
from ccatp.control.waypoint_steering import HALT, Drive
from ccatp.samples import Verdict
from ccatp.surveying.states import Outcome


class Arrival(NamedTuple):
    """A waypoint is reached.

    Attributes:
        waypoint, lap: its number in the loop and the lap, both from 0.
        place_m: where it is.
        belief: where the robot believes to be.
    """

    waypoint: int
    lap: int
    place_m: tuple[float, float]
    belief: Belief


class BeaconMission(Holding):
    """Maps and visits waypoints, or follows a radio, and returns to its start when it is given up.

    Call ``step`` once per frame.

    Args:
        cfg: the configuration; nothing of ``sim`` is used.
        navigator: knows where the robot is.

    Attributes:
        navigator: the same.
        pilot: who drives.
        arrivals: waypoints reached, in order.
    """

    def __init__(self, cfg: RadioConfig, navigator: Navigator) -> None:
        """Idle at the start."""
        super().__init__()
        self._cfg, self.navigator = cfg, navigator
        self.pilot = BeaconPilot(cfg)
        self._homing: BeaconPilot | None = None
        self.arrivals: list[Arrival] = []
        self._begun_s: float | None = None
        self._followed_s = 0.0
        self._is_following = cfg.follow.is_active

    @property
    def total(self) -> int:
        """Waypoints to be reached, or seconds to follow."""
        mission = self._cfg.mission
        return round(mission.follow_s) if self._is_following else mission.laps * len(self._cfg.workspace.waypoints_m)

    @property
    def done(self) -> int:
        """Of these."""
        return min(int(self._followed_s), self.total) if self._is_following else len(self.arrivals)

    @property
    def next_waypoint(self) -> int:
        """Number of the waypoint driven to, -1 for none."""
        is_visiting = not self._is_following and len(self.arrivals) < self.total
        return len(self.arrivals) % len(self._cfg.workspace.waypoints_m) if is_visiting else -1

    def step(self, senses: Senses, interval_s: float, verdict: Verdict | None) -> Drive:
        """One frame: take its readings, react to the verdict, drive on as far as it permits.

        Args:
            senses: the frame.
            interval_s: until the next one.
            verdict: the danger loop's, in force; ``None`` where there is none fresh enough.
        """
        self.navigator.take(senses)
        t_s = senses.t_s
        if self._begun_s is None:
            self._begun_s = t_s
        if not self.react(verdict) or verdict is None:
            return HALT
        if t_s - self._begun_s > self._cfg.mission.time_limit_s and self.state is not IDLE and not self.abort_cause:
            self.fault(f"the mission takes longer than mission.time_limit_s = {self._cfg.mission.time_limit_s:g}")
            return HALT
        drive = self._wanted(senses, interval_s)
        return permitted(drive, verdict, self._cfg.avoidance.back_speed_m_s)

    def _wanted(self, senses: Senses, interval_s: float) -> Drive:
        if self.state is HELD:
            return HALT
        if self.navigator.is_mapping:
            if self.abort_cause:
                self.finish(Outcome.AT_BASE)  # it never left
            else:
                self.state = MAPPING
            return HALT
        if self.abort_cause:
            return self._return(senses, interval_s)
        pose, target = self.navigator.belief.pose, self.navigator.target(senses.t_s)
        drive = self.pilot.drive(senses.t_s, interval_s, pose, target, self._distances(senses))
        if self._is_following:
            self._follow(interval_s)
        else:
            self._visit()
        return HALT if self.outcome is not Outcome.NONE else drive

    def _follow(self, interval_s: float) -> None:
        self.state = FOLLOWING
        self._followed_s += interval_s
        if self._followed_s >= self._cfg.mission.follow_s:
            self.finish(Outcome.COMPLETE)

    def _visit(self) -> None:
        self.state = VISITING
        waypoints = self._cfg.workspace.waypoints_m
        while len(self.arrivals) < min(self.pilot.waypoints.reached, self.total):
            lap, waypoint = divmod(len(self.arrivals), len(waypoints))
            self.arrivals.append(Arrival(waypoint, lap, waypoints[waypoint], self.navigator.belief))
        if len(self.arrivals) >= self.total:
            self.finish(Outcome.COMPLETE)

    def _return(self, senses: Senses, interval_s: float) -> Drive:
        self.state = RETURNING
        if self._homing is None:
            self._homing = _homing_pilot(self._cfg)
        drive = self._homing.drive(senses.t_s, interval_s, self.navigator.belief.pose, None, self._distances(senses))
        if self._homing.waypoints.current_m is None:
            self.finish(Outcome.AT_BASE)
            return HALT
        return drive

    def _distances(self, senses: Senses) -> tuple[float, ...]:
        """Of sensors that told nothing in this frame, that they see nothing: what they saw before is remembered."""
        avoidance = self._cfg.avoidance
        return senses.distances_m or (avoidance.range_max_m,) * len(avoidance.sensors_rad)


def _homing_pilot(cfg: RadioConfig) -> BeaconPilot:
    """A pilot to where the robot started."""
    base = ((cfg.start.x_m, cfg.start.y_m),)
    workspace = cfg.workspace.model_copy(update={"waypoints_m": base, "loops": False})
    follow = cfg.follow.model_copy(update={"is_active": False})
    return BeaconPilot(cfg.model_copy(update={"workspace": workspace, "follow": follow}))
