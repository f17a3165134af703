"""A mission among beacons in the main-loop process: measurements, mission, wheel rates, store, telemetry."""

import asyncio
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from math import cos, sin

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
from ccatp.beacons.navigation import BeaconMeasurements, Ellipse, MeasurementReader, Navigator
from ccatp.beacons.steering import HALT
from ccatp.beacons.store import BeaconStore
from ccatp.config.beacon_models import RadioConfig
from ccatp.core import Verdict
from ccatp.daemon.mission_runner import (
    STILL,
    DriveCommand,
    RunnerConfig,
    RunnerContext,
    RunnerFactory,
    TimedFrame,
)
from ccatp.daemon.process import BeaconArgs
from ccatp.daemon.telemetry import DisplayStatePublisher, PoseSnapshot, TelemetryPublisher
from ccatp.errors import ExitStatus
from ccatp.links.beacon_messages import NOTHING, decode_beacon_frame
from ccatp.links.bus import Publisher
from ccatp.links.robot_codec import BadLine
from ccatp.links.robot_messages import Hello
from ccatp.links.topics import (
    BeaconArrival,
    BeaconMapMessage,
    BeaconTrack,
    EstimateMessage,
    Message,
    MissionStatus,
    RobotShape,
    Scene,
    is_estimate_due,
)
from ccatp.survey.state import SurveyOutcome

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
        self._display = DisplayStatePublisher(publisher, navigator_pose)
        self._track: list[TrackRow] = []
        self._echoes: deque[tuple[float, float]] = deque(maxlen=ECHO_MEMORY)
        self._trail: deque[tuple[float, float]] = deque(maxlen=TRAIL)
        self._distances: list[float] = []
        self._map_due_s = 0.0

    def publish_frame(
        self, seq: int, t_s: float, raw: bytes, distances_m: tuple[float, ...], *, is_first: bool
    ) -> None:
        """Keep the estimate after frame ``seq`` and its line; publish the estimate and the map where they are due.

        Args:
            seq, t_s: the frame.
            is_first: of a session; its estimate is always due, because the danger loop may wait for it.
        """
        self.seq, self.t_s = seq, t_s
        navigator = self._mission.navigator
        self._display.update(navigator, raw)
        belief = navigator.belief
        x_m, y_m, heading_rad = belief.pose
        if is_first or is_estimate_due(seq):
            state = str(self._mission.state)
            estimate = EstimateMessage(
                seq=seq, t_s=t_s, x_m=x_m, y_m=y_m, heading_rad=heading_rad, sigma_m=belief.sigma_m, state=state
            )
            self._publisher.send("estimate", estimate)
            self._trail.append((x_m, y_m))
        self._see(belief.pose, distances_m)
        self._track.append(track_row(seq + self._frames_before, t_s, navigator))
        if t_s >= self._map_due_s:
            self._map_due_s = t_s + self._cfg.mission.map_period_s
            self.publish_map()
        self.add_line(raw)

    def _see(self, pose: tuple[float, float, float], distances_m: tuple[float, ...]) -> None:
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
        shapes = [
            RobotShape(f"beacon {name}", *_kind(name, cfg), *e[:2], e[2:], label=name) for name, e in beacons.items()
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

    def publish_status(self, message: MissionStatus) -> None:
        """Publish the mission's status, and a picture of all that is newest for whoever looks on."""
        super().publish_status(message)
        self._display.publish_if_subscribed(self.seq, self.t_s)

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
        """The pending rows of the track."""
        rows, self._track = self._track, []
        return ("beacon_track", BeaconTrack(seq=self.seq, t_s=self.t_s, rows=rows)) if rows else None


def _kind(name: str, cfg: RadioConfig) -> tuple[str]:
    return ("target" if cfg.follow.is_active and name == cfg.follow.target else "beacon",)


def navigator_pose(navigator: Navigator) -> PoseSnapshot:
    """The pose among beacons; how readings agree is commands with the map, as a sum over many of them."""
    belief = navigator.belief
    x_m, y_m, *covariance = belief.ellipse
    xx, xy, yy = covariance
    sigma_rad = float(max(belief.covariance[2, 2], 0.0)) ** 0.5
    return PoseSnapshot(x_m, y_m, belief.pose[2], (xx, xy, yy), sigma_rad, 0.0, 0)


EXIT_STATUS = {
    SurveyOutcome.COMPLETE: ExitStatus.COMPLETE,
    SurveyOutcome.AT_BASE: ExitStatus.ABORTED,
    SurveyOutcome.STOPPED: ExitStatus.HELD,
    SurveyOutcome.NONE: ExitStatus.INTERRUPTED,
}


class BeaconRunner:
    """A mission among beacons as the main-loop process hosts it.

    Args:
        cfg: the configuration; nothing of ``sim`` is used.
    """

    is_busy = False  # it waits for nobody

    def __init__(self, cfg: RadioConfig, context: RunnerContext, mission: BeaconMission, store: BeaconStore) -> None:
        self._cfg, self._context, self._mission, self._store = cfg, context, mission, store
        self._reader = MeasurementReader(cfg)
        self._telemetry = BeaconTelemetry(context.publisher, context.log, cfg, mission)
        self._measurements: BeaconMeasurements | None = None
        self._speed_m_s = 0.0
        self._state: BeaconState = IDLE
        self._was_faulted = False
        self._published_arrivals = 0
        # An operator's commands are the mission's; so is what holds it.
        self.pause, self.resume, self.abort, self.stop = mission.pause, mission.resume, mission.abort, mission.stop
        self.interrupt = mission.interrupt

    @property
    def telemetry(self) -> BeaconTelemetry:
        """Tells the others."""
        return self._telemetry

    @property
    def cause(self) -> str:
        """Why it is held."""
        return self._mission.cause

    @property
    def is_paused(self) -> bool:
        """Held until somebody resumes."""
        return self._mission.is_paused

    @property
    def is_at_rest(self) -> bool:
        """The robot is at rest; its wheels obey within a frame, so what they were commands last is what counts."""
        return abs(self._speed_m_s) <= self._cfg.mission.settle_speed_m_s

    def status(self) -> MissionStatus:
        """Progress of the mission."""
        mission = self._mission
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

    async def connect(self) -> None:
        """There is nobody but the robot."""

    async def run(self) -> None:
        """There is nothing to do beside the frames."""
        await asyncio.Event().wait()

    async def close(self) -> None:
        """There is nothing open."""

    def check_robot(self, hello: Hello) -> None:
        """Refuse a robot whose own geometry contradicts the configuration."""
        check_beacon_robot(self._cfg, hello)

    def begin_session(self, hello: Hello) -> None:
        """A session begins."""

    def begin_drives(self) -> None:
        """There are no fans."""

    def on_tracking_gap(self) -> None:
        """The robot booted, or moved unseen: where it is nobody knows, and its map hangs on that."""
        self._reader.forget()
        self._mission.fault("no frames while the robot moved: put it at its start and start a new mission")

    def save_checkpoint(self) -> None:
        """Nobody takes over: the map would have to be kept, too."""

    def publish_state(self) -> None:
        """Tell a state that is new, and end where that is the end."""
        mission, before, was_faulted = self._mission, self._state, self._was_faulted
        if mission.state is before and mission.is_faulted is was_faulted:
            return
        self._state, self._was_faulted = mission.state, mission.is_faulted
        self._telemetry.log.debug("state_changed", seq=self._context.clock.seq, before=before, after=mission.state)
        if HELD in (mission.state, before) or mission.state is RETURNING:
            text = f"{mission.state}: {mission.cause}" if mission.cause else f"{mission.state}"
            self._telemetry.notify_operator("warning", text)
            self._store.record_event(self._context.clock.t_s, "warning", text)
        if mission.state is DONE:
            self._telemetry.publish_map()
            self._context.finish(EXIT_STATUS[mission.outcome])
        elif mission.is_faulted and self._context.session.is_lockstep:
            # Nobody can be waited for while simulated time runs at many times the wall clock.
            self._telemetry.publish_map()
            self._context.finish(ExitStatus.HELD)

    def log_statistics(self) -> None:
        """How consistent it was."""
        score = self._mission.navigator.score
        self._telemetry.log.info(
            "reading_statistics", nis_sum=score.nis_sum, nis_size=score.nis_size, refused=score.refused
        )

    # -- the frame ------------------------------------------------------------------------------------------------

    def estimate(self, frame: TimedFrame) -> None:
        """Read the senses of the frame; damaged extra keys are as good as none."""
        try:
            extras = decode_beacon_frame(frame.raw)
        except BadLine as error:
            extras = NOTHING
            self._telemetry.log.warning("bad_extra_keys", seq=frame.sensors.seq, error=str(error))
        self._measurements = self._reader.read(frame.sensors, extras)

    def plan(self, frame: TimedFrame, verdict: Verdict | None, _lag_s: float) -> DriveCommand:
        """What the mission wants, as far as the verdict permits it."""
        mission = self._mission
        if self._measurements is None:
            raise RuntimeError("plan comes after estimate")
        drive = mission.step(self._measurements, self._context.session.frame_period_s, verdict)
        if mission.state is DONE:
            drive = HALT
        self._speed_m_s = drive.speed_m_s
        return DriveCommand(*wheel_rates(drive, self._cfg))

    def hold(self, _frame: TimedFrame) -> DriveCommand:
        """The robot stands, and nothing is decided in this frame."""
        self._speed_m_s = 0.0
        return STILL

    def publish(self, frame: TimedFrame) -> None:
        """The estimate, arrivals, a state that is new."""
        sensors, mission = frame.sensors, self._mission
        distances = () if self._measurements is None else self._measurements.distances_m
        self._telemetry.publish_frame(sensors.seq, sensors.t, frame.raw, distances, is_first=frame.is_first)
        for number in range(self._published_arrivals, len(mission.arrivals)):
            arrival = mission.arrivals[number]
            self._telemetry.publish_arrival(arrival)
            self._store.record_arrival(sensors.t, number, arrival)
        self._published_arrivals = len(mission.arrivals)
        self.publish_state()


def beacon_runner_config(cfg: RadioConfig) -> RunnerConfig:
    """What the process needs of the configuration."""
    return RunnerConfig(
        cfg.robot, cfg.processes.realtime_priority, cfg.mission.verdict_timeout_s, 10.0 * cfg.run.step_s,
        1.0 / cfg.run.step_s,
    )  # fmt: skip


@contextmanager
def open_beacons(args: BeaconArgs) -> Iterator[RunnerFactory]:
    """The parts and the database of a mission among beacons; what makes the mission of them."""
    cfg = args.config
    mission = BeaconMission(cfg)
    laps = 0 if cfg.follow.is_active else cfg.mission.laps
    meta = {"system": cfg.system, "seed": str(cfg.run.seed)}
    store = BeaconStore(args.run_dir / "mission.sqlite", meta, cfg.workspace.waypoints_m, laps)
    try:
        yield lambda context: BeaconRunner(cfg, context, mission, store)
    finally:
        store.close()
