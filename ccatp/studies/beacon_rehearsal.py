"""Pure. A whole mission among beacons in one process: the daemon's own mission and danger rules against the sim."""

from dataclasses import dataclass, field
from typing import Any

from ccatp.beacon_assembly import TrackRow, assemble_beacons, track_row
from ccatp.beacon_danger import BeaconDanger
from ccatp.beacon_mission.senses import SenseReader
from ccatp.beacon_mission.states import DONE
from ccatp.beacon_mission.wheel_rates import wheel_rates
from ccatp.beacon_summary import BeaconSummary, Reached, beacon_facts
from ccatp.config.radio_models import RadioConfig
from ccatp.control.waypoint_steering import HALT, Drive
from ccatp.samples import Verdict
from ccatp.sim.beacon_truth import BeaconTruthLog
from ccatp.sim.beacon_world import build_beacon_robot, motes_of
from ccatp.wire.beacon_frame import decode_beacon_frame
from ccatp.wire.beacon_rows import (
    TRACK_COLUMNS,
    TRUTH_COLUMNS,
    PoseTrack,
    PoseTruth,
    pose_track,
    pose_truth,
    table,
)
from ccatp.wire.robot import Sensors, decode_from_robot
from ccatp.wire.topics import Estimate, is_estimate_due


@dataclass(slots=True)
class BeaconRehearsal:
    """What a rehearsal leaves, one entry a frame where nothing else is said.

    Attributes:
        summary: as ``summary.json``.
        states: of the mission.
        verdicts: of the danger rules.
        times_s: of the frames.
        speeds_m_s: forward, as they were sent.
        track, truth: rows of ``beacon_track`` and ``beacon_truth``.
        outcome, cause: how the mission ended.
    """

    summary: dict[str, Any] = field(default_factory=dict)
    states: list[str] = field(default_factory=list)
    verdicts: list[Verdict] = field(default_factory=list)
    times_s: list[float] = field(default_factory=list)
    speeds_m_s: list[float] = field(default_factory=list)
    track: list[TrackRow] = field(default_factory=list)
    truth: list[Any] = field(default_factory=list)
    outcome: str = ""
    cause: str = ""

    @property
    def poses(self) -> tuple[PoseTrack, PoseTruth]:
        """Estimates and truth as arrays."""
        return pose_track(table(self.track, TRACK_COLUMNS)), pose_truth(table(self.truth, TRUTH_COLUMNS))


class BeaconStage:
    """Robot, danger rules and mission, frame by frame.

    Args:
        cfg: the configuration.

    Attributes:
        robot: the simulated one.
        mission, danger: as in the daemon.
        found: what it leaves.
    """

    def __init__(self, cfg: RadioConfig) -> None:
        """Both keys are in the robot's hands."""
        self._cfg = cfg
        self.robot = build_beacon_robot(cfg)
        self.mission, self.danger = assemble_beacons(cfg), BeaconDanger(cfg)
        self.found = BeaconRehearsal()
        self._reader, self._log = SenseReader(cfg), BeaconTruthLog(self.robot, motes_of(cfg))
        self._book = BeaconSummary(beacon_facts(cfg, is_sim=True))
        self._estimate: Estimate | None = None
        self._signal = ""
        self.robot.join_controller()
        self.robot.join_monitor()

    @property
    def is_over(self) -> bool:
        """The mission has ended, or would wait for an operator: that ends it in lockstep."""
        return self.mission.state is DONE or self.mission.is_faulted

    def frame(self) -> None:
        """The newest frame: judged, decided, and driven on from unless that was the end."""
        line = self.robot.delivered_line.rstrip()
        sensors = decode_from_robot(line)
        if not isinstance(sensors, Sensors):
            raise TypeError(f"a robot's frame is no frame: {line[:80]!r}")
        extras = decode_beacon_frame(line)
        verdict = self.danger.step(sensors, extras, self._estimate)
        before = len(self.mission.arrivals)
        drive = self.mission.step(self._reader.read(sensors, extras), self.robot.frame_s, verdict)
        drive = HALT if self.mission.state is DONE else drive
        self._note(sensors, verdict, drive)
        for arrival in self.mission.arrivals[before:]:
            self._book.add_reached(Reached(sensors.seq, arrival.belief.ellipse))
        if not self.is_over:
            self._drive(sensors.seq, verdict, drive)

    def _drive(self, seq: int, verdict: Verdict, drive: Drive) -> None:
        right, left, steer = wheel_rates(drive, self._cfg)
        self.robot.permit(seq + 1, verdict.forward, verdict.reverse, verdict.turn)
        self.robot.drive(seq + 1, right, left, None, steer)
        self.robot.advance()
        self._log.add()

    def _note(self, sensors: Sensors, verdict: Verdict, drive: Drive) -> None:
        found, mission = self.found, self.mission
        if verdict.signal and verdict.signal != self._signal:
            self._book.add_danger(verdict.signal)
        self._signal = verdict.signal
        if is_estimate_due(sensors.seq):
            belief = mission.navigator.belief
            x_m, y_m, heading_rad = belief.pose
            self._estimate = Estimate(
                seq=sensors.seq, t_s=sensors.t, x_m=x_m, y_m=y_m, heading_rad=heading_rad, sigma_m=belief.sigma_m,
                state=str(mission.state),
            )  # fmt: skip
        found.track.append(track_row(sensors.seq, sensors.t, mission.navigator))
        found.states.append(str(mission.state))
        found.verdicts.append(verdict)
        found.times_s.append(sensors.t)
        found.speeds_m_s.append(drive.speed_m_s)

    def result(self) -> BeaconRehearsal:
        """What there is to say at the end."""
        found, mission, book = self.found, self.mission, self._book
        batch = self._log.batch()
        found.truth = [] if batch is None else list(batch[1].rows)
        found.outcome, found.cause = str(mission.outcome), mission.cause
        score = mission.navigator.score
        book.add_track(found.track)
        book.add_truth(found.truth)
        book.set_places(self._log.preface()[1].places)
        book.set_map(mission.navigator.beacons, (score.nis_sum, score.nis_size, score.refused), mission.navigator.notes)
        book.set_mission(found.times_s[-1], found.outcome, found.cause)
        found.summary = book.build(0.0)
        return found


def rehearse_beacons(cfg: RadioConfig) -> BeaconRehearsal:
    """A mission from its first frame to its end, in virtual time; a function of configuration and seed."""
    stage = BeaconStage(cfg)
    while not stage.is_over:
        stage.frame()
    return stage.result()
