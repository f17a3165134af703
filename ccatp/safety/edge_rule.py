"""Edge or gap? Decided by the distance travelled, with the map as prior; one episode per sensor off the panels.

The rules for a sensor that reads "off" (travel: of the sensor itself, with the part from the robot's rotation):

a. The map shows the rim ahead within ``map_margin_m`` plus ``map_sigmas`` sigma: an edge at once.
b. The map shows a seam: an edge when the sensor cannot be over the gap any more. The robot's translation may carry it
   ``(gap + tolerance) / cos(angle to the seam's normal) + extra``. Rotation counts only across the seam, because a
   corner sensor that turns in place sweeps along a seam for up to 0.1 m without leaving it.
c. The map shows neither, or there is no estimate: an edge after ``no_map_travel_m``.
d. While the robot stands, the episode does not change. Motion back to where the sensor was on adds no travel.
e. A wrong pose may have declared an edge. If a fix at rest shows the sensor over a seam with no rim near, a new episode
   starts there. If it shows the sensor at the rim, the sensor is not faulty although it stays off.
g. Without wheel samples, the travel is the sensor's largest speed times the elapsed time.
h. All four sensors off: the robot is lifted or has fallen.

An episode ends when the sensor has been on a panel for ``clear_samples`` samples and has moved on by
``no_map_travel_m``, so that a sensor that chatters does not start one episode after the other.

``CentreClearanceCheck`` covers what the edge sensors cannot detect: at an inner corner of the stepped rim the empty
quadrant is a wedge, and its tip can pass between the front sensors, 180 mm apart, until it is under the robot's centre.
The map shows the tip where the position is known.
"""

from collections.abc import Sequence
from math import cos, hypot, inf, sin

from ccatp.config.models import DangerConfig, RobotConfig
from ccatp.core import DeckPose, EdgeSample, WheelSample
from ccatp.links.topics import EstimateMessage
from ccatp.mirror.rim import Rim
from ccatp.rest import AT_REST_M_S, WHEEL_STANDS_RAD_S
from ccatp.safety.edge_episode import EdgeEpisode, EdgeLimits
from ccatp.safety.edge_map import EdgeMap
from ccatp.safety.wheel_odometry import Odometry, WheelTrack, pose_at
from ccatp.sensing.wheel_means import largest_rate_rad_s

SENSORS = 4
# At rest only a fix can reduce the estimate's sigma to less than half.
_BY_A_FIX = 0.5
# Heading error that a fix may leave: a fix corrects the position at once, but not the heading.
_HEADING_RAD = 0.1


class EdgeRule:
    """The episodes of the four sensors.

    ``is_lifted``: all four sensors have been off (rule h), and have not yet been on again for ``clear_samples``.
    ``opened`` and ``declared`` count episodes and edges per sensor since the start.
    """

    def __init__(self, edge_map: EdgeMap, robot: RobotConfig, cfg: DangerConfig) -> None:
        self._map = edge_map
        self._robot = robot
        self._stale_after_s = cfg.stale_after_s
        self._reach_s = 2.0 * max(cfg.stale_after_s, cfg.estimate_stale_after_s)
        self._offsets = robot.edge_sensors_m
        self._limits = EdgeLimits(edge_map.gap_m, cfg)
        self._half_base_m = 0.5 * robot.wheel_base_m
        self._clear_samples = cfg.clear_samples
        self._lifted_samples = cfg.lifted_samples
        self._worst_m_s = tuple(_fastest(robot, offset) for offset in robot.edge_sensors_m)
        self.opened = [0, 0, 0, 0]
        self.declared = [0, 0, 0, 0]
        self.reset()

    def reset(self) -> None:
        """Drop episodes, odometry and times, because the robot's clock has restarted."""
        robot = self._robot
        self.track = WheelTrack(
            robot.wheel_radius_m, robot.wheel_base_m, self._stale_after_s, self._reach_s, largest_rate_rad_s(robot)
        )
        self.episodes: list[EdgeEpisode | None] = [None] * SENSORS
        self._odometry: Odometry | None = None
        self._last_t_s: float | None = None
        self._all_off = self._all_on = 0
        self._largest_sigma_m = 0.0
        self.is_lifted = False

    @property
    def is_idle(self) -> bool:
        """Whether no episode is open and the robot is not lifted."""
        return self._odometry is None

    def step(self, samples: Sequence[EdgeSample], estimate: EstimateMessage | None) -> None:
        """Evaluate a frame's samples.

        The frame's encoder samples must be in ``track`` already. ``estimate`` is fresh and finite, or None.
        """
        if not samples:
            return
        if self._odometry is None and _are_all_on(samples):
            self._last_t_s = samples[-1][0]
            return
        self.track.update(samples[-1][0])
        if self._odometry is None:
            self._odometry = Odometry(self.track, samples[0][0] if self._last_t_s is None else self._last_t_s)
        self._tie_to_map(self._odometry, estimate)
        for sample in samples:
            if self._last_t_s is None or sample[0] > self._last_t_s:
                self._sample(sample, self._odometry, estimate)
                self._last_t_s = sample[0]
        # Rule (a) again, once per frame, for a sensor that is off and moves: a seam may lead to the rim.
        for i, episode in enumerate(self.episodes):
            if episode is not None and episode.edge is None and episode.look_ahead():
                self.declared[i] += 1
        if estimate is not None and self._has_fix(self._odometry, estimate.sigma_m):
            self._review_after_fix(self._odometry, estimate)
        if not any(self.episodes) and not self.is_lifted:
            self._odometry = None

    def _sample(self, sample: EdgeSample, odometry: Odometry, estimate: EstimateMessage | None) -> None:
        t_s = sample[0]
        dt_s = 0.0 if self._last_t_s is None else t_s - self._last_t_s
        odometry.advance_to(t_s)
        silent_s = self.track.silence_s(t_s)
        c, s = cos(odometry.heading_rad), sin(odometry.heading_rad)
        off = 0
        for i, known in enumerate(self.episodes):
            # Every value other than 1 counts as off.
            is_on = sample[i + 1] == 1
            if is_on and known is None:
                continue
            off += not is_on
            episode = known or self._open(i, odometry, dt_s, estimate)
            ox, oy = self._offsets[i]
            place = odometry.x_m + c * ox - s * oy, odometry.y_m + s * ox + c * oy
            if is_on:
                if episode.see_on(place):
                    self.episodes[i] = None
            elif episode.see_off(odometry, place, silent_s * self._worst_m_s[i]):
                self.declared[i] += 1
        self._count_all(off)

    def _tie_to_map(self, odometry: Odometry, estimate: EstimateMessage | None) -> None:
        for i, episode in enumerate(self.episodes):
            if episode is not None and episode.needs_map and estimate is not None:
                self._place(episode, self._offsets[i], odometry, estimate)

    def _has_fix(self, odometry: Odometry, sigma_m: float) -> bool:
        is_still = abs(odometry.v_m_s) + abs(odometry.omega_rad_s) * self._half_base_m < AT_REST_M_S
        has_fix = is_still and sigma_m < _BY_A_FIX * self._largest_sigma_m
        self._largest_sigma_m = max(self._largest_sigma_m, sigma_m) if is_still and not has_fix else sigma_m
        return has_fix

    def _review_after_fix(self, odometry: Odometry, estimate: EstimateMessage) -> None:
        """Rule (e), after a fix at rest."""
        limits = self._limits
        for i, episode in enumerate(self.episodes):
            if episode is None or episode.edge is None or episode.is_on:
                continue
            place = self._map.place(_pose_of(estimate), self._offsets[i])
            aside_m = _HEADING_RAD * hypot(*self._offsets[i])
            slack_m = limits.sigmas * estimate.sigma_m + aside_m
            seam = self._map.seam_at(place, limits.tolerance_m + slack_m)
            is_rim = self._map.is_rim_ahead(place, (1.0, 0.0), 0.0, limits.margin_m + slack_m)
            if is_rim:
                episode.confirm()
            elif seam is not None:
                opened = self._open(i, odometry, 0.0, estimate)
                self._place(opened, self._offsets[i], odometry, estimate, aside_m / limits.sigmas)

    def _place(
        self,
        episode: EdgeEpisode,
        offset_m: tuple[float, float],
        odometry: Odometry,
        estimate: EstimateMessage,
        more_sigma_m: float = 0.0,
    ) -> None:
        pose = pose_at(self.track, odometry.t_s, estimate.t_s, _pose_of(estimate))
        episode.place_on_map(self._map.place(pose, offset_m), pose.heading_rad, estimate.sigma_m + more_sigma_m)

    def _open(self, i: int, odometry: Odometry, dt_s: float, estimate: EstimateMessage | None) -> EdgeEpisode:
        ox, oy = self._offsets[i]
        step_m = (abs(odometry.v_m_s) + abs(odometry.omega_rad_s) * hypot(ox, oy)) * dt_s
        episode = EdgeEpisode(self._limits, self._map, odometry, (ox, oy), step_m=step_m, half_base_m=self._half_base_m)
        if estimate is not None:
            self._place(episode, (ox, oy), odometry, estimate)
        self.opened[i] += 1
        self.episodes[i] = episode
        return episode

    def _count_all(self, off: int) -> None:
        self._all_off = self._all_off + 1 if off == SENSORS else 0
        self._all_on = self._all_on + 1 if off == 0 else 0
        if self._all_off >= self._lifted_samples:
            self.is_lifted = True
        elif self.is_lifted and self._all_on >= self._clear_samples:
            self.is_lifted = False  # put back on the panels
            self.episodes = [None] * SENSORS


def _pose_of(estimate: EstimateMessage) -> DeckPose:
    return DeckPose(estimate.x_m, estimate.y_m, estimate.heading_rad)


def _are_all_on(samples: Sequence[EdgeSample]) -> bool:
    for _, front_left, front_right, rear_left, rear_right in samples:
        if not (front_left == 1 and front_right == 1 and rear_left == 1 and rear_right == 1):
            return False
    return True


def _fastest(robot: RobotConfig, offset_m: tuple[float, float]) -> float:
    """Largest speed of a sensor, m/s. It is linear in the wheel rates, so its maximum is at a corner of their range."""
    edge_m_s = robot.wheel_radius_m * robot.max_wheel_rad_s
    omega = 2.0 * edge_m_s / robot.wheel_base_m
    return max(edge_m_s, omega * hypot(*offset_m))


# Longest time between two look-ups of a large clearance: a fix may move the estimate.
LOOK_PERIOD_S = 0.1


class CentreClearanceCheck:
    """Declares an edge when the centre moves towards the rim and is closer to it than half the sensors' lead.

    At a straight rim the sensors go off before that. It ends when the clearance exceeds the limit by ``map_margin_m``.
    ``direction``: sign of the barred motion, or 0. ``clearance_m``: at the last look-up; ``limit_m``: its least value.
    """

    def __init__(self, rim: Rim, robot: RobotConfig, cfg: DangerConfig) -> None:
        self._rim = rim
        self._lead_m = min(min(abs(x), abs(y)) for x, y in robot.edge_sensors_m)
        self._sigmas = cfg.map_sigmas
        self._margin_m = cfg.map_margin_m
        self._fastest_m_s = robot.wheel_radius_m * robot.max_wheel_rad_s
        self.direction = 0
        self.clearance_m = inf
        self.limit_m = 0.0
        self._look_at_s = -inf

    def step(self, t_s: float, estimate: EstimateMessage, wheels: Sequence[WheelSample]) -> None:
        """Look up the clearance if the robot can have come near the limit since the last look-up."""
        if t_s < self._look_at_s:
            return
        x, y = estimate.x_m, estimate.y_m
        self.clearance_m = clearance = self._rim.signed_distance_m(x, y)
        self.limit_m = limit = min(0.5 * self._lead_m + self._sigmas * estimate.sigma_m, self._lead_m)
        if self.direction == 0:
            self._look_at_s = t_s + min(max(clearance - limit, 0.0) / self._fastest_m_s, LOOK_PERIOD_S)
            if clearance < limit:
                self._judge(estimate, wheels)
        elif clearance > limit + self._margin_m:
            self.direction = 0

    def _judge(self, estimate: EstimateMessage, wheels: Sequence[WheelSample]) -> None:
        _, right, left = wheels[-1] if wheels else (0.0, None, None)
        if right is None or left is None:
            return
        total = right + left
        if abs(total) < WHEEL_STANDS_RAD_S:  # not even one wheel shows motion
            return
        direction = 1 if total > 0.0 else -1
        ahead_m = direction * self._margin_m
        x = estimate.x_m + ahead_m * cos(estimate.heading_rad)
        y = estimate.y_m + ahead_m * sin(estimate.heading_rad)
        if self._rim.signed_distance_m(x, y) < self.clearance_m:
            self.direction = direction
