"""A mission among beacons in the main-loop process: measurements, mission, wheel rates, store, telemetry."""

from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from math import cos, sin

import msgspec
import structlog

from ccatp.beacons.mission import (
    DONE,
    HELD,
    IDLE,
    RETURNING,
    BeaconMission,
    BeaconState,
    TrackRow,
    WaypointArrival,
    check_beacon_robot,
    track_row,
    wheel_rates,
)
from ccatp.beacons.navigation import BeaconMeasurements, Ellipse, MeasurementReader
from ccatp.beacons.steering import HALT
from ccatp.beacons.store import BeaconStore
from ccatp.config.beacon_models import RadioConfig
from ccatp.core import Verdict
from ccatp.daemon.mission_runner import (
    EXIT_STATUS,
    STILL,
    DriveCommand,
    MissionRunner,
    RunnerConfig,
    RunnerContext,
    RunnerFactory,
    TimedFrame,
)
from ccatp.daemon.process import ProcessArgs
from ccatp.daemon.telemetry import TelemetryPublisher
from ccatp.errors import ExitStatus
from ccatp.links.beacon_messages import NOTHING, decode_beacon_frame
from ccatp.links.bus import Publisher
from ccatp.links.robot_codec import BadLine
from ccatp.links.robot_messages import Hello
from ccatp.links.topics import (
    BeaconArrival,
    BeaconMapMessage,
    BeaconTrack,
    DisplayState,
    EstimateMessage,
    Message,
    MissionStatus,
    RobotShape,
    Scene,
    is_estimate_due,
)

ECHO_MEMORY = 200  # points that the distance sensors saw lately, for displays
TRAIL = 400  # places of the robot, one in five frames


class BeaconTelemetry(TelemetryPublisher):
    """Publishes for a mission among beacons."""

    def __init__(
        self,
        publisher: Publisher,
        log: structlog.typing.FilteringBoundLogger,
        cfg: RadioConfig,
        mission: BeaconMission,
    ) -> None:
        super().__init__(publisher, log)
        self._cfg, self._mission = cfg, mission
        self._track: list[TrackRow] = []
        self._echoes: deque[tuple[float, float]] = deque(maxlen=ECHO_MEMORY)
        self._trail: deque[tuple[float, float]] = deque(maxlen=TRAIL)
        self._distances: list[float] = []
        self._map_due_s = 0.0

    def publish_frame(
        self, seq: int, t_s: float, raw: bytes, distances_m: tuple[float, ...], *, is_first: bool
    ) -> None:
        """Keep the estimate after frame ``seq`` and its line; publish the estimate and the map where they are due.

        The estimate of the first frame of a session is always due, because the danger loop may wait for it.
        """
        self.seq, self.t_s, self._newest_line = seq, t_s, msgspec.Raw(raw)
        navigator = self._mission.navigator
        belief = navigator.belief
        x_m, y_m, heading_rad = belief.pose
        if is_first or is_estimate_due(seq):
            state = str(self._mission.state)
            estimate = EstimateMessage(
                seq=seq, t_s=t_s, x_m=x_m, y_m=y_m, heading_rad=heading_rad, sigma_m=belief.sigma_m, state=state
            )
            self._publisher.send("estimate", estimate)
            self._trail.append((x_m, y_m))
        self._collect_echoes(belief.pose, distances_m)
        self._track.append(track_row(seq + self._frames_before, t_s, navigator))
        if t_s >= self._map_due_s:
            self._map_due_s = t_s + self._cfg.mission.map_period_s
            self.publish_map()
        self._add_line(self._newest_line)

    def _collect_echoes(self, pose: tuple[float, float, float], distances_m: tuple[float, ...]) -> None:
        self._distances = list(distances_m)
        avoidance = self._cfg.avoidance
        if not avoidance.is_active:
            return
        for angle, distance_m in zip(avoidance.sensors_rad, distances_m, strict=False):
            if distance_m < avoidance.influence_m:
                course = pose[2] + angle
                self._echoes.append((pose[0] + distance_m * cos(course), pose[1] + distance_m * sin(course)))

    def publish_map(self) -> None:
        """Publish the map, and the same as a scene for displays."""
        cfg, mission, seq, t_s = self._cfg, self._mission, self.seq, self.t_s
        navigator = mission.navigator
        belief, beacons = navigator.belief, dict(navigator.beacons)
        target = beacons.get(cfg.follow.target) if cfg.follow.is_active else None
        waypoints = [] if cfg.follow.is_active else list(cfg.workspace.waypoints_m)
        score = navigator.score
        message = BeaconMapMessage(
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

    def _shapes(self, beacons: dict[str, Ellipse], waypoints: list[tuple[float, float]]) -> list[RobotShape]:
        cfg, belief = self._cfg, self._mission.navigator.belief
        x_m, y_m, heading_rad = belief.pose
        target = cfg.follow.target if cfg.follow.is_active else None
        shapes = [
            RobotShape(f"beacon {name}", "target" if name == target else "beacon", *e[:2], e[2:], label=name)
            for name, e in beacons.items()
        ]
        shapes += [
            RobotShape(f"waypoint {at}", "waypoint", *place, radius_m=cfg.control.arrival_radius_m, label=str(at + 1))
            for at, place in enumerate(waypoints)
        ]
        shapes += [RobotShape(f"echo {at}", "obstacle", *place) for at, place in enumerate(self._echoes)]
        if self._trail:
            shapes.append(RobotShape("trail", "trail", *self._trail[-1], outline_m=list(self._trail)))
        shapes.append(
            RobotShape("robot", "robot", x_m, y_m, belief.ellipse[2:], heading_rad, radius_m=cfg.vehicle.radius_m)
        )
        return shapes

    def publish_arrival(self, arrival: WaypointArrival) -> None:
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
        """See ``TelemetryPublisher``."""
        rows, self._track = self._track, []
        return ("beacon_track", BeaconTrack(seq=self.seq, t_s=self.t_s, rows=rows)) if rows else None

    def display_state(self) -> DisplayState | None:
        """See ``TelemetryPublisher``; the consistency of readings is published with the map, as a sum over many."""
        if self.seq < 0:
            return None
        belief = self._mission.navigator.belief
        x_m, y_m, xx, xy, yy = belief.ellipse
        return DisplayState(
            seq=self.seq,
            t_s=self.t_s,
            x_m=x_m,
            y_m=y_m,
            heading_rad=belief.pose[2],
            covariance_m2=(xx, xy, yy),
            heading_sigma_rad=float(max(belief.covariance[2, 2], 0.0)) ** 0.5,
            nis=0.0,
            size=0,
            line=self._newest_line,
        )


class BeaconRunner(MissionRunner):
    """A mission among beacons in the main-loop process; nothing of ``cfg.sim`` is used.

    No main loop takes over from it: the map would have to be kept, too.
    """

    mission: BeaconMission
    telemetry: BeaconTelemetry

    def __init__(self, cfg: RadioConfig, context: RunnerContext, mission: BeaconMission, store: BeaconStore) -> None:
        super().__init__(mission, BeaconTelemetry(context.publisher, context.log, cfg, mission))
        self._cfg, self._context, self._store = cfg, context, store
        self._reader = MeasurementReader(cfg)
        self._measurements: BeaconMeasurements | None = None
        self._speed_m_s = 0.0
        self._state: BeaconState = IDLE
        self._was_faulted = False
        self._published_arrivals = 0

    @property
    def is_at_rest(self) -> bool:
        """The robot is at rest; its wheels obey within a frame, so their last commands count."""
        return abs(self._speed_m_s) <= self._cfg.mission.settle_speed_m_s

    def status(self) -> MissionStatus:
        """See ``MissionRunner``."""
        mission = self.mission
        at = mission.next_waypoint
        return MissionStatus(
            seq=self._context.clock.seq,
            t_s=self._context.clock.t_s,
            state=str(mission.state),
            cause=mission.cause,
            done=mission.done,
            total=mission.total,
            point=f"waypoint {at + 1}" if at >= 0 else "",
            error_mm=1e3 * mission.navigator.belief.sigma_m,
            outcome=str(mission.outcome),
        )

    # -- beside the frames ----------------------------------------------------------------------------------------

    def check_robot(self, hello: Hello) -> None:
        """See ``MissionRunner``."""
        check_beacon_robot(self._cfg, hello)

    def on_tracking_gap(self) -> None:
        """A fault: the robot's place is not known, and its map depends on that."""
        self._reader.forget()
        self.mission.fault("no frames while the robot moved: put it at its start and start a new mission")

    def publish_state(self) -> None:
        """See ``MissionRunner``."""
        mission, before, was_faulted = self.mission, self._state, self._was_faulted
        if mission.state is before and mission.is_faulted is was_faulted:
            return
        self._state, self._was_faulted = mission.state, mission.is_faulted
        self.telemetry.log.debug("state_changed", seq=self._context.clock.seq, before=before, after=mission.state)
        if HELD in (mission.state, before) or mission.state is RETURNING:
            text = f"{mission.state}: {mission.cause}" if mission.cause else f"{mission.state}"
            self.telemetry.notify_operator("warning", text)
            self._store.record_event(self._context.clock.t_s, "warning", text)
        if mission.state is DONE:
            self.telemetry.publish_map()
            self._context.finish(EXIT_STATUS[mission.outcome])
        elif mission.is_faulted and self._context.session.is_lockstep:
            # No operator can react while simulated time runs at many times the wall clock.
            self.telemetry.publish_map()
            self._context.finish(ExitStatus.HELD)

    def log_statistics(self) -> None:
        """Log the consistency of the readings."""
        score = self.mission.navigator.score
        self.telemetry.log.info(
            "reading_statistics", nis_sum=score.nis_sum, nis_size=score.nis_size, refused=score.refused
        )

    # -- the frame ------------------------------------------------------------------------------------------------

    def estimate(self, frame: TimedFrame) -> None:
        """Read the measurements of the frame; damaged extra keys are left out."""
        try:
            extras = decode_beacon_frame(frame.raw)
        except BadLine as error:
            extras = NOTHING
            self.telemetry.log.warning("bad_extra_keys", seq=frame.sensors.seq, error=str(error))
        self._measurements = self._reader.read(frame.sensors, extras)

    def plan(self, frame: TimedFrame, verdict: Verdict | None, _lag_s: float) -> DriveCommand:
        """The mission's velocity, as far as the verdict permits it."""
        mission = self.mission
        if self._measurements is None:
            raise RuntimeError("plan comes after estimate")
        drive = mission.step(self._measurements, self._context.session.frame_period_s, verdict)
        if mission.state is DONE:
            drive = HALT
        self._speed_m_s = drive.speed_m_s
        return DriveCommand(*wheel_rates(drive, self._cfg))

    def hold(self, _frame: TimedFrame) -> DriveCommand:
        """See ``MissionRunner``."""
        self._speed_m_s = 0.0
        return STILL

    def publish(self, frame: TimedFrame) -> None:
        """See ``MissionRunner``."""
        sensors, mission = frame.sensors, self.mission
        distances = () if self._measurements is None else self._measurements.distances_m
        self.telemetry.publish_frame(sensors.seq, sensors.t, frame.raw, distances, is_first=frame.is_first)
        for number in range(self._published_arrivals, len(mission.arrivals)):
            arrival = mission.arrivals[number]
            self.telemetry.publish_arrival(arrival)
            self._store.record_arrival(sensors.t, number, arrival)
        self._published_arrivals = len(mission.arrivals)
        self.publish_state()


def beacon_runner_config(cfg: RadioConfig) -> RunnerConfig:
    """Configuration of the process."""
    return RunnerConfig(
        cfg.robot, cfg.processes.realtime_priority, cfg.mission.verdict_timeout_s, 10.0 * cfg.run.step_s,
        1.0 / cfg.run.step_s,
    )  # fmt: skip


@contextmanager
def open_beacons(cfg: RadioConfig, args: ProcessArgs) -> Iterator[RunnerFactory]:
    """Open the database of a mission among beacons; yields a factory of the mission."""
    mission = BeaconMission(cfg)
    laps = 0 if cfg.follow.is_active else cfg.mission.laps
    meta = {"system": cfg.system, "seed": str(cfg.run.seed)}
    store = BeaconStore(args.run_dir / "mission.sqlite", meta, cfg.workspace.waypoints_m, laps)
    try:
        yield lambda context: BeaconRunner(cfg, context, mission, store)
    finally:
        store.close()
