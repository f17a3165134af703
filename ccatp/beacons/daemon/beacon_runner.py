"""A mission among beacons in the main-loop process: measurements, mission, wheel rates, store, telemetry."""

from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import StrEnum
from math import cos, sin

from ccatp.beacons.conditions import FRAMES_MISSED
from ccatp.beacons.config.models import RadioConfig
from ccatp.beacons.links.messages import NOTHING, Ellipse, decode_beacon_frame
from ccatp.beacons.links.topics import BeaconArrival, BeaconMapMessage, BeaconTrack
from ccatp.beacons.mission import BeaconMission, check_beacon_robot, track_row, wheel_rates
from ccatp.beacons.navigation import BeaconMeasurements, MeasurementReader
from ccatp.beacons.records.store import BeaconStore
from ccatp.beacons.steering import HALT
from ccatp.conditions import text_of
from ccatp.core import Verdict
from ccatp.daemon.loops.mission_runner import (
    EXIT_STATUS,
    STILL,
    DriveCommand,
    LoopLimits,
    MissionHost,
    MissionRunner,
    TimedFrame,
)
from ccatp.daemon.supervision.process import ProcessArgs
from ccatp.errors import ExitStatus
from ccatp.links.bus import Telemetry
from ccatp.links.robot_codec import BadLine
from ccatp.links.robot_messages import Hello
from ccatp.links.topics import DisplayState, EstimateMessage, MissionStatus, RobotShape, Scene
from ccatp.survey.events import DONE, HELD, IDLE, RETURNING, Fault

ECHO_MEMORY = 200  # number of recent echoes of the distance sensors, for displays
TRAIL = 400  # number of places of the robot, one in five frames
CLOCK_JUMP_FRAMES = 10.0
# The robot cannot relocalize: a pause becomes a fault without a hold before.
HOLD_S = 30.0


def loop_limits(cfg: RadioConfig) -> LoopLimits:
    """Limits of the main loop."""
    return LoopLimits(CLOCK_JUMP_FRAMES * cfg.run.step_s, HOLD_S)


class BeaconRunner(MissionRunner):
    """A mission among beacons in the main-loop process; nothing of ``cfg.sim`` is used.

    Another main loop cannot take over, because the map is not saved.
    """

    mission: BeaconMission

    def __init__(self, cfg: RadioConfig, host: MissionHost, mission: BeaconMission, store: BeaconStore) -> None:
        super().__init__(mission, Telemetry(host.publisher, host.log, "beacon_track", BeaconTrack))
        self._cfg = cfg
        self._host = host
        self._clock = host.clock
        self._store = store
        self._reader = MeasurementReader(cfg)
        self._measurements: BeaconMeasurements | None = None
        self._speed_m_s = 0.0
        self._state: StrEnum = IDLE
        self._was_faulted = False
        self._published_arrivals = 0
        self._echoes: deque[tuple[float, float]] = deque(maxlen=ECHO_MEMORY)
        self._trail: deque[tuple[float, float]] = deque(maxlen=TRAIL)
        self._distances: list[float] = []
        self._map_due_s = 0.0

    @property
    def is_at_rest(self) -> bool:
        """The robot is at rest by its last command, which its wheels reach within a frame."""
        return abs(self._speed_m_s) <= self._cfg.mission.settle_speed_m_s

    def status(self) -> MissionStatus:
        mission, state = self.mission, self.mission.state
        at = mission.next_waypoint
        return MissionStatus(
            seq=self._clock.seq,
            t_s=self._clock.t_s,
            state=str(state.mode),
            cause=text_of(state.cause),
            condition=state.cause.condition,
            done=mission.done,
            total=mission.total,
            point=f"waypoint {at + 1}" if at >= 0 else "",
            error_mm=1e3 * mission.navigator.belief.sigma_m,
            outcome=str(state.outcome),
        )

    def display_state(self) -> DisplayState:
        """Without the consistency of readings, which is published with the map as a sum over many."""
        belief, telemetry = self.mission.navigator.belief, self.telemetry
        x_m, y_m, xx, xy, yy = belief.ellipse
        return DisplayState(
            seq=telemetry.seq,
            t_s=telemetry.t_s,
            x_m=x_m,
            y_m=y_m,
            heading_rad=belief.pose[2],
            covariance_m2=(xx, xy, yy),
            heading_sigma_rad=float(max(belief.covariance[2, 2], 0.0)) ** 0.5,
            nis=0.0,
            size=0,
            line=telemetry.newest_line,
        )

    # -- beside the frames ----------------------------------------------------------------------------------------

    def check_robot(self, hello: Hello) -> None:
        check_beacon_robot(self._cfg, hello)

    def on_tracking_gap(self) -> None:
        """A fault: the robot's place is not known, and the map depends on it."""
        self._reader.forget()
        self.mission.handle(Fault(FRAMES_MISSED.cause()))

    def publish_state(self) -> None:
        state, before, was_faulted = self.mission.state, self._state, self._was_faulted
        mode = state.mode
        if mode is before and state.is_faulted is was_faulted:
            return
        self._state, self._was_faulted = mode, state.is_faulted
        self.since_s = self._clock.t_s
        self.telemetry.log.debug("state_changed", seq=self._clock.seq, before=before, after=mode)
        if HELD in (mode, before) or mode is RETURNING:
            is_resumed = before is HELD and mode not in (HELD, RETURNING, DONE)
            what = ("resumed" if mode is IDLE else f"resumed: {mode}") if is_resumed else f"{mode}"
            text = f"{what}: {text_of(state.cause)}" if state.cause else what
            level = "warning" if mode in (HELD, RETURNING) else "info"
            self.telemetry.notify_operator(level, text)
            self._store.record_event(self._clock.t_s, level, text)
        if mode is DONE:
            self._publish_map(self.telemetry.seq, self.telemetry.t_s)
            self._host.finish(EXIT_STATUS[state.outcome])
        elif state.is_faulted and self._host.is_lockstep:
            # No operator can react while simulated time runs at many times the wall clock.
            self._publish_map(self.telemetry.seq, self.telemetry.t_s)
            self._host.finish(ExitStatus.HELD)

    def log_statistics(self) -> None:
        """Log the consistency of the readings."""
        self.telemetry.log.info("reading_statistics", **self.mission.navigator.score._asdict())

    # -- the frame ------------------------------------------------------------------------------------------------

    def estimate(self, frame: TimedFrame) -> None:
        """Read the measurements of the frame; damaged extra keys are left out."""
        try:
            extras = decode_beacon_frame(frame.raw)
        except BadLine as error:
            extras = NOTHING
            self.telemetry.log.warning("bad_extra_keys", seq=frame.sensors.seq, error=str(error))
        self._measurements = self._reader.read(frame.sensors, extras)

    def decide(self, frame: TimedFrame, verdict: Verdict | None, _lag_s: float) -> DriveCommand:
        """The drive for the mission's velocity, as far as the verdict permits it."""
        mission = self.mission
        if self._measurements is None:
            raise RuntimeError("plan comes after estimate")
        drive = mission.step(self._measurements, self._host.frame_period_s, verdict)
        if mission.state.mode is DONE:
            drive = HALT
        self._speed_m_s = drive.speed_m_s
        return DriveCommand(*wheel_rates(drive, self._cfg))

    def hold(self, _frame: TimedFrame) -> DriveCommand:
        self._speed_m_s = 0.0
        return STILL

    def publish(self, frame: TimedFrame) -> None:
        seq, t_s, mission, telemetry = frame.sensors.seq, frame.sensors.t, self.mission, self.telemetry
        belief = mission.navigator.belief
        if frame.is_estimate_due:
            state = mission.state.mode.value
            telemetry.send("estimate", EstimateMessage(*belief.pose, belief.sigma_m, state, seq=seq, t_s=t_s))
            self._trail.append(belief.pose[:2])
        self._collect_echoes(belief.pose)
        if frame.t_s >= self._map_due_s:  # by the time that never runs backward
            self._map_due_s = frame.t_s + self._cfg.mission.map_period_s
            self._publish_map(seq, t_s)
        number = seq + telemetry.frames_before
        telemetry.add_frame(seq, t_s, frame.raw, track_row(number, t_s, mission.navigator))
        for at in range(self._published_arrivals, len(mission.arrivals)):
            reached = mission.arrivals[at]
            arrival = BeaconArrival(
                seq=number,
                t_s=t_s,
                waypoint=reached.waypoint,
                lap=reached.lap,
                place=reached.place_m,
                estimate=reached.belief.ellipse,
            )
            telemetry.send("beacon_arrival", arrival)
            self._store.record_arrival(t_s, at, reached)
        self._published_arrivals = len(mission.arrivals)
        self.publish_state()

    def _collect_echoes(self, pose: tuple[float, float, float]) -> None:
        distances_m = [] if self._measurements is None else self._measurements.extras.distances
        self._distances = list(distances_m)
        avoidance = self._cfg.avoidance
        if not avoidance.is_active:
            return
        for angle, distance_m in zip(avoidance.sensors_rad, distances_m, strict=False):
            if distance_m < avoidance.influence_m:
                course = pose[2] + angle
                self._echoes.append((pose[0] + distance_m * cos(course), pose[1] + distance_m * sin(course)))

    def _publish_map(self, seq: int, t_s: float) -> None:
        """Publish the map, also as a scene for displays."""
        cfg, mission = self._cfg, self.mission
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
            used=score.used,
        )
        self.telemetry.send("beacon_map", message)
        self.telemetry.send("scene", Scene(seq=seq, t_s=t_s, shapes=self._shapes(beacons, waypoints)))

    def _shapes(self, beacons: dict[str, Ellipse], waypoints: list[tuple[float, float]]) -> list[RobotShape]:
        cfg, belief = self._cfg, self.mission.navigator.belief
        x_m, y_m, heading_rad = belief.pose
        target = cfg.follow.target if cfg.follow.is_active else None
        shapes = [
            RobotShape(f"beacon {name}", "target" if name == target else "landmark", *e[:2], e[2:], label=name)
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
            RobotShape(
                "robot", "robot", x_m, y_m, belief.ellipse[2:], heading_rad=heading_rad, radius_m=cfg.vehicle.radius_m
            )
        )
        return shapes


@contextmanager
def open_beacons(cfg: RadioConfig, args: ProcessArgs) -> Iterator[Callable[[MissionHost], BeaconRunner]]:
    """Open the database of a mission among beacons; yields a factory of the mission."""
    mission = BeaconMission(cfg)
    laps = 0 if cfg.follow.is_active else cfg.mission.laps
    meta = {"system": cfg.system, "seed": str(cfg.run.seed)}
    store = BeaconStore(args.run_dir / "mission.sqlite", meta, cfg.workspace.waypoints_m, laps)
    try:
        yield lambda host: BeaconRunner(cfg, host, mission, store)
    finally:
        store.close()
