"""Run directories as the daemon writes them, made in process: of surveys, and of missions among beacons."""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import msgspec
import pytest

from ccatp.beacons.config.load import load_radio_config
from ccatp.beacons.config.models import RadioConfig
from ccatp.beacons.links.topics import BeaconArrival, BeaconMapMessage, BeaconPlaces, BeaconTrack, BeaconTruth
from ccatp.conditions import text_of
from ccatp.config.load import dump_config, load_config
from ccatp.config.models import Config
from ccatp.core import Cause, DeckPose, Measured, PanelId, PointId
from ccatp.daemon.loops.mission_runner import TimedFrame
from ccatp.links.robot_codec import encode
from ccatp.links.robot_messages import Sensors
from ccatp.links.topics import (
    TOPICS,
    ArrivalMessage,
    FixMessage,
    Message,
    Misalignment,
    MissionStatus,
    Rest,
    SensorLines,
    TrackMessage,
    TruthMessage,
    schema_of,
)
from ccatp.mirror.misalignment import PanelMisalignment
from ccatp.records.recorder import Recorder
from ccatp.records.store import MissionStore, StoredPoint
from ccatp.survey.behaviours import MissionCommand
from ccatp.survey.events import Abort, Mode
from ccatp.survey.route_follower import StateEstimate
from tests.support.runs import made_once
from tests.support.sim_survey import MeasuredSurvey

HERE = DeckPose(0.0, 0.0, 0.0)


def recorder_in(run_dir: Path, metadata: Mapping[str, str] | None = None, *, is_simulation: bool = True) -> Recorder:
    """A recorder of all topics."""
    topics = [(topic.name, schema_of(topic.name)) for topic in TOPICS if topic.recorded]
    return Recorder(run_dir / "telemetry.mcap", topics, is_simulation=is_simulation, metadata=metadata)


def make_run(
    run_dir: Path,
    cfg: Config,
    planned: Iterable[PointId],
    measured: Iterable[Measured],
    truth: Mapping[PanelId, PanelMisalignment] | None,
) -> Path:
    """A run directory: configuration, database, and a recording where the truth is known."""
    run_dir.mkdir(exist_ok=True)
    (run_dir / "config.toml").write_text(dump_config(cfg))
    points = [StoredPoint(point, 0.0, 0.0) for point in planned]
    with MissionStore.create(
        run_dir / "mission.sqlite", mirror=cfg.mirror.name, seed=cfg.run.seed, config_toml="", points=points
    ) as store:
        for done in [store.record_fix(one.point, one.fix, HERE) for one in measured]:
            done.result()
    if truth is not None:
        record_truth(run_dir, truth)
    return run_dir


def record_truth(run_dir: Path, truth: Mapping[PanelId, PanelMisalignment], *, is_simulation: bool = True) -> None:
    """One more recording in a run directory that holds how the panels lie, and a batch of truth after it."""
    recorder = recorder_in(run_dir, is_simulation=is_simulation)
    panels = [(*panel, m.piston_m, m.tip_rad, m.tilt_rad) for panel, m in truth.items()]
    recorder.write("misalignment", 0.0, msgspec.json.encode(Misalignment(seq=0, t_s=0.0, panels=panels)))
    recorder.write("truth", 1.0, b'{"seq":0,"t_s":0.0,"rows":[]}')
    recorder.close()


BATCH = 100


class RecordingRun(MeasuredSurvey):
    """A mission in process that leaves a run directory behind.

    ``is_simulation``: what the recording says of itself; without a simulation no truth is recorded. ``only``: points
    measured before it is told to abort; None for a whole mission.
    """

    def __init__(self, cfg: Config, run_dir: Path, *, is_simulation: bool = True, only: int | None = None) -> None:
        super().__init__(cfg, run_dir)
        run_dir.mkdir(parents=True, exist_ok=True)
        self.run_dir, self.is_simulation, self.only = run_dir, is_simulation, only
        (run_dir / "config.toml").write_text(dump_config(cfg), encoding="utf-8")
        self.recorder = recorder_in(
            run_dir, {"ccatp": "0.0.test", "config": dump_config(cfg)}, is_simulation=is_simulation
        )
        self.log = (run_dir / "log.jsonl").open("a", encoding="utf-8")
        self.track: list[tuple[Any, ...]] = []
        self.truth: list[tuple[Any, ...]] = []
        self.lines: list[msgspec.Raw] = []
        self.seq, self.t_s, self.seen = 0, 0.0, Mode.IDLE

    def leave(self) -> Path:
        """Drive it, and close everything as the daemon does at its end."""
        self.say("supervisor", "run_started", mirror=self.cfg.mirror.name)
        if self.is_simulation:
            lies = self.robot.world.misalignments
            panels = [(*panel, m.piston_m, m.tip_rad, m.tilt_rad) for panel, m in lies.items()]
            self.write("misalignment", Misalignment(seq=0, t_s=0.0, panels=panels))
        result = self.run()
        self.flush()
        self.status(outcome=result.outcome, exit_status=0 if result.outcome == "complete" else 3)
        self.recorder.close()
        self.say("supervisor", "run_finished", status=0)
        self.log.close()
        (self.run_dir / "summary.json").write_text(json.dumps(result.summary), encoding="utf-8")
        return self.run_dir

    def say(self, process: str, event: str, level: str = "info", **fields: object) -> None:
        line = {"logger": process, **fields, "event": event, "level": level, "timestamp": "2026-01-01T12:00:00.5Z"}
        self.log.write(json.dumps(line) + "\n")

    def write(self, topic: str, message: msgspec.Struct) -> None:
        self.recorder.write(topic, getattr(message, "t_s", 0.0), msgspec.json.encode(message))

    def status(self, outcome: str = "", exit_status: int = -1) -> None:
        state = self.mission.state
        message = MissionStatus(
            seq=self.seq, t_s=self.t_s, state=str(state.mode), cause=text_of(state.cause), done=len(state.points.done),
            total=self.parts.total_points, elapsed_s=self.t_s, outcome=outcome, exit_status=exit_status,
        )  # fmt: skip
        self.write("mission", message)

    def flush(self) -> None:
        if self.lines:
            self.write("sensors", SensorLines(seq=self.seq, t_s=self.t_s, lines=self.lines))
            self.lines = []
        if self.track:
            self.write("track", TrackMessage(seq=self.seq, t_s=self.t_s, rows=self.track))
        if self.truth and self.is_simulation:
            self.write("truth", TruthMessage(seq=self.seq, t_s=self.t_s, rows=self.truth))
        self.track, self.truth = [], []
        self.status()

    def _note_truth(self) -> None:
        super()._note_truth()
        self.truth.append(self.robot.world.truth_row(self.robot.seq, self.robot.t_s))

    def _serve(self, frame: Sensors, dt_s: float) -> None:
        self.seq, self.t_s = frame.seq, frame.t
        self.lines.append(msgspec.Raw(encode(frame).strip()))
        super()._serve(frame, dt_s)

    def execute(self, command: MissionCommand, motion: StateEstimate) -> None:
        super().execute(command, motion)
        if command.at_rest:
            self.write("rest", Rest(seq=self.seq, t_s=self.t_s))
        if command.arrived is not None:
            error_mm = 1e3 * self.mission.survey.follower.distance_m(self.mission.state.stop, self.localizer.pose)
            point = (*command.arrived,)
            self.write("arrival", ArrivalMessage(seq=self.seq, t_s=self.t_s, point=point, error_mm=error_mm))

    def _publish(self, frame: TimedFrame) -> None:
        super()._publish(frame)
        seq, pose, state = self.seq, self.localizer.pose, self.mission.state.mode
        row = (seq, self.t_s, *pose.panel, pose.x_m, pose.y_m, pose.heading_rad, self.localizer.position_sigma_m)
        self.track.append(row)
        if state is not self.seen:
            self.say("main", "state_changed", "debug", seq=seq, before=str(self.seen), after=str(state))
            self.seen = state
        if len(self.track) >= BATCH:
            self.flush()
        if self.only is not None and len(self.mission.state.points.done) >= self.only:
            self.only = None
            self.mission.handle(Abort(Cause("the observatory wants the robot home")))

    def _note_fix(self, topic: str, message: FixMessage) -> None:
        super()._note_fix(topic, message)
        self.write(topic, msgspec.structs.replace(message, seq=self.seq))


def record(run_dir: Path, *, is_simulation: bool = True, only: int | None = None, **changes: object) -> Path:
    """The run directory of a mission in process: one panel of fyst-m1 in a hard world, unless told otherwise."""
    settings = {"run.panels": 1, "run.world": "hard", "mission.calibration_length_m": 0.0}
    settings |= {key.replace("__", "."): value for key, value in changes.items()}
    return RecordingRun(load_config(overrides=settings), run_dir, is_simulation=is_simulation, only=only).leave()


def record_surveyed(factory: pytest.TempPathFactory) -> Path:
    """``record`` as it is, complete: made by the first worker that wants it. Not to be written to."""
    return made_once(factory, "surveyed", lambda folder: record(folder / "tonight")) / "tonight"


# -- missions among beacons --------------------------------------------------------------------------------------------

FRAMES, PERIOD_S = 61, 0.1
SIGMA_M, OFF_M = 0.02, 0.03  # of the estimate; the truth lies so far to the right of it
ELLIPSE = (SIGMA_M**2, 0.0, SIGMA_M**2)
PLACES = {"beacon1": (0.0, 0.0), "beacon2": (3.0, 3.0)}
BEACON_TOPICS = (
    "beacon_track", "beacon_truth", "beacon_map", "beacon_arrival", "beacon_places", "mission"
)  # fmt: skip


def beacon_config(system: str = "zigbee") -> RadioConfig:
    return load_radio_config(None, {"system": system, "mission.laps": 1, "run.seed": 5})


def place(frame: int) -> tuple[float, float]:
    """Where the robot believes to be."""
    return 0.8 + 0.02 * frame, 0.8


def beacon_map(frame: int, cfg: RadioConfig) -> BeaconMapMessage:
    """The map after a frame: beacon1 is 0.1 m off, beacon2 is right; each map adds 2 readings of NIS 3."""
    beacons = {"beacon1": (0.1, 0.0, 0.01, 0.0, 0.0025), "beacon2": (3.0, 3.0, 0.01, 0.002, 0.01)}
    target = None
    if cfg.follow.is_active:
        target = (place(frame)[0] + 1.0, 0.8, 0.01, 0.0, 0.01)
        beacons["target"] = target
    reported = frame // 5
    return BeaconMapMessage(
        seq=frame, t_s=PERIOD_S * frame, system=cfg.system, pose=(*place(frame), 0.0),
        pose_ellipse=(*place(frame), *ELLIPSE), beacons=beacons, target=target, obstacles=[(1.0, 2.0)],
        waypoints=[] if cfg.follow.is_active else list(cfg.workspace.waypoints_m), next_waypoint=1,
        distances=[1.5, 0.9], nis_sum=3.0 * reported, nis_size=2 * reported, refused=1, notes={},
    )  # fmt: skip


def track_row(frame: int) -> tuple[float, ...]:
    variance = SIGMA_M**2
    return (
        frame, PERIOD_S * frame, *place(frame), 0.0, variance, 0.0, variance, 0.0, 0.0, 1e-4, place(frame)[0], 0.9
    )  # fmt: skip


def truth_row(frame: int, *, has_target: bool = False) -> tuple[float | None, ...]:
    x, y = place(frame)
    target = (x + 1.0, y) if has_target else (None, None)
    return frame, PERIOD_S * frame, x, y - OFF_M, 0.0, *target, None


def status(outcome: str = "complete") -> MissionStatus:
    return MissionStatus(seq=60, t_s=6.0, state="done", done=1, total=4, elapsed_s=6.0, outcome=outcome, exit_status=0)


def record_beacons(run_dir: Path, cfg: RadioConfig | None = None, *, is_sim: bool = True, ends: bool = True) -> Path:
    """A run directory; without an end as after ``kill -9``."""
    cfg = cfg or beacon_config()
    run_dir.mkdir(exist_ok=True)
    (run_dir / "config.toml").write_text(dump_config(cfg))
    recorder = Recorder(
        run_dir / "telemetry.mcap",
        [(name, schema_of(name)) for name in BEACON_TOPICS],
        is_simulation=is_sim,
        metadata={"system": cfg.system, "ccatp": "9.9"},
    )

    def write(topic: str, message: Message) -> None:
        recorder.write(topic, message.t_s, msgspec.json.encode(message))

    rows: Any = [track_row(frame) for frame in range(FRAMES)]
    if is_sim:
        write("beacon_places", BeaconPlaces(seq=0, t_s=0.0, places=PLACES))
        true: Any = [truth_row(frame, has_target=cfg.follow.is_active) for frame in range(FRAMES)]
        write("beacon_truth", BeaconTruth(seq=60, t_s=6.0, rows=true))
    write("beacon_track", BeaconTrack(seq=30, t_s=3.0, rows=rows[:31]))
    write("beacon_track", BeaconTrack(seq=60, t_s=6.0, rows=rows[30:]))  # a frame that is told twice
    for frame in range(0, FRAMES, 5):
        write("beacon_map", beacon_map(frame, cfg))
    if not cfg.follow.is_active:
        arrived = BeaconArrival(
            seq=10, t_s=1.0, waypoint=0, lap=0, place=cfg.workspace.waypoints_m[0], estimate=(*place(10), *ELLIPSE)
        )
        write("beacon_arrival", arrived)
    write("mission", status() if ends else msgspec.structs.replace(status(), state="visiting", outcome=""))
    recorder.close()
    (run_dir / "log.jsonl").write_text(
        '{"process":"supervisor","event":"run","level":"info","wall":"2026-11-22T05:00:00Z"}\n'
        '{"process":"main","event":"held: <b>near</b>","level":"warning","wall":"2026-11-22T05:00:01Z","t_s":0.7}\n'
        + ('{"process":"supervisor","event":"end","level":"info","wall":"2026-11-22T05:00:09Z"}\n' if ends else "")
    )
    if ends:
        (run_dir / "summary.json").write_text(
            json.dumps({"outcome": "complete", "cause": "", "danger": {"obstacle": 1}, "target": None})
        )
    return run_dir
