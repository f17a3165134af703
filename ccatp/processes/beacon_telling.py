"""Glue. What the main loop tells of a mission among beacons: estimates, the map, arrivals."""

from collections import deque
from math import cos, sin

import structlog

from ccatp.beacon_assembly import TrackRow, track_row
from ccatp.beacon_mission.mission import Arrival, BeaconMission
from ccatp.beacon_mission.navigator import Ellipse, Navigator
from ccatp.bus import Publisher
from ccatp.config.radio_models import RadioConfig
from ccatp.processes.painting import Look, Painter
from ccatp.processes.telling import Teller
from ccatp.wire.topics import (
    BeaconArrival,
    BeaconMap,
    BeaconTrack,
    Estimate,
    Message,
    MissionStatus,
    Scene,
    Shape,
    is_estimate_due,
)

ECHO_MEMORY = 200  # points that the distance sensors saw lately, for displays
TRAIL = 400  # places of the robot, one in five frames


class BeaconTeller(Teller):
    """Publishes for a mission among beacons.

    Args:
        publisher: main's publisher.
        log: the process's logger.
        cfg: the configuration.
        mission: what is told.
    """

    def __init__(
        self,
        publisher: Publisher,
        log: structlog.typing.FilteringBoundLogger,
        cfg: RadioConfig,
        mission: BeaconMission,
    ) -> None:
        """Start with empty batches."""
        super().__init__(publisher, log)
        self._cfg, self._mission = cfg, mission
        self._painter = Painter(publisher, look_at_navigator)
        self._track: list[TrackRow] = []
        self._echoes: deque[tuple[float, float]] = deque(maxlen=ECHO_MEMORY)
        self._trail: deque[tuple[float, float]] = deque(maxlen=TRAIL)
        self._distances: list[float] = []
        self._map_due_s = 0.0

    def frame(self, seq: int, t_s: float, raw: bytes, distances_m: tuple[float, ...], *, is_first: bool) -> None:
        """Keep the estimate after frame ``seq`` and its line; publish the estimate and the map where they are due.

        Args:
            seq, t_s: the frame.
            raw: its line.
            distances_m: of the distance sensors.
            is_first: of a session; its estimate is always due, because the danger loop may wait for it.
        """
        self.seq, self.t_s = seq, t_s
        navigator = self._mission.navigator
        self._painter.sees(navigator, raw)
        belief = navigator.belief
        x_m, y_m, heading_rad = belief.pose
        if is_first or is_estimate_due(seq):
            state = str(self._mission.state)
            estimate = Estimate(
                seq=seq, t_s=t_s, x_m=x_m, y_m=y_m, heading_rad=heading_rad, sigma_m=belief.sigma_m, state=state
            )
            self._publisher.send("estimate", estimate)
            self._trail.append((x_m, y_m))
        self._see(belief.pose, distances_m)
        self._track.append(track_row(seq + self._frames_before, t_s, navigator))
        if t_s >= self._map_due_s:
            self._map_due_s = t_s + self._cfg.mission.map_period_s
            self.tell_map()
        self.keep(raw)

    def _see(self, pose: tuple[float, float, float], distances_m: tuple[float, ...]) -> None:
        self._distances = list(distances_m)
        avoidance = self._cfg.avoidance
        if not avoidance.is_active:
            return
        for angle, distance_m in zip(avoidance.sensors_rad, distances_m, strict=False):
            if distance_m < avoidance.influence_m:
                course = pose[2] + angle
                self._echoes.append((pose[0] + distance_m * cos(course), pose[1] + distance_m * sin(course)))

    def tell_map(self) -> None:
        """Publish the map, and the same as a scene for displays."""
        cfg, mission, seq, t_s = self._cfg, self._mission, self.seq, self.t_s
        navigator = mission.navigator
        belief, beacons = navigator.belief, dict(navigator.beacons)
        target = beacons.get(cfg.follow.target) if cfg.follow.is_active else None
        waypoints = [] if cfg.follow.is_active else list(cfg.workspace.waypoints_m)
        score = navigator.score
        message = BeaconMap(
            seq=seq,
            t_s=t_s,
            system=cfg.system,
            pose=belief.pose,
            pose_ellipse=belief.ellipse,
            beacons=beacons,
            target=target,
            obstacles=list(self._echoes),
            waypoints=waypoints,
            next_waypoint=mission.next_waypoint,
            distances=self._distances,
            nis_sum=score.nis_sum,
            nis_size=score.nis_size,
            refused=score.refused,
            notes=dict(navigator.notes),
        )
        self._publisher.send("beacon_map", message)
        self._publisher.send("scene", Scene(seq=seq, t_s=t_s, shapes=self._shapes(beacons, waypoints)))

    def _shapes(self, beacons: dict[str, Ellipse], waypoints: list[tuple[float, float]]) -> list[Shape]:
        cfg, belief = self._cfg, self._mission.navigator.belief
        x_m, y_m, heading_rad = belief.pose
        shapes = [Shape(f"beacon {name}", *_kind(name, cfg), *e[:2], e[2:], label=name) for name, e in beacons.items()]
        shapes += [
            Shape(f"waypoint {at}", "waypoint", *place, radius_m=cfg.control.arrival_radius_m, label=str(at + 1))
            for at, place in enumerate(waypoints)
        ]
        shapes += [Shape(f"echo {at}", "obstacle", *place) for at, place in enumerate(self._echoes)]
        if self._trail:
            shapes.append(Shape("trail", "trail", *self._trail[-1], outline_m=list(self._trail)))
        shapes.append(Shape("robot", "robot", x_m, y_m, belief.ellipse[2:], heading_rad, radius_m=cfg.vehicle.radius_m))
        return shapes

    def status(self, message: MissionStatus) -> None:
        """Publish the mission's status, and a picture of all that is newest for whoever looks on."""
        super().status(message)
        self._painter.tell_if_wanted(self.seq, self.t_s)

    def arrival(self, arrival: Arrival) -> None:
        """A waypoint is reached in the present frame."""
        message = BeaconArrival(
            seq=self.seq + self._frames_before,
            t_s=self.t_s,
            waypoint=arrival.waypoint,
            lap=arrival.lap,
            place=arrival.place_m,
            estimate=arrival.belief.ellipse,
        )
        self._publisher.send("beacon_arrival", message)

    def take_estimates(self) -> tuple[str, Message] | None:
        """The pending rows of the track."""
        rows, self._track = self._track, []
        return ("beacon_track", BeaconTrack(seq=self.seq, t_s=self.t_s, rows=rows)) if rows else None


def _kind(name: str, cfg: RadioConfig) -> tuple[str]:
    return ("target" if cfg.follow.is_active and name == cfg.follow.target else "beacon",)


def look_at_navigator(navigator: Navigator) -> Look:
    """The pose among beacons; how readings agree is told with the map, as a sum over many of them."""
    belief = navigator.belief
    x_m, y_m, *covariance = belief.ellipse
    xx, xy, yy = covariance
    sigma_rad = float(max(belief.covariance[2, 2], 0.0)) ** 0.5
    return Look(x_m, y_m, belief.pose[2], (xx, xy, yy), sigma_rad, 0.0, 0)
