"""Pure. A whole mission among beacons in one process: the daemon's own mission and danger rules against the sim."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from ccatp.beacon_assembly import assemble_beacons, beacon_facts, track_row
from ccatp.beacon_danger import BeaconDanger
from ccatp.beacon_mission.senses import SenseReader
from ccatp.beacon_mission.states import DONE
from ccatp.beacon_mission.wheel_rates import wheel_rates
from ccatp.beacon_summary import BeaconSummary, Reached
from ccatp.config.radio_models import RadioConfig
from ccatp.control.waypoint_steering import HALT
from ccatp.samples import Verdict
from ccatp.sim.beacon_truth import BeaconTruthLog
from ccatp.sim.beacon_world import build_beacon_robot, motes_of
from ccatp.wire.beacon_frame import decode_beacon_frame
from ccatp.wire.robot import Sensors, decode_from_robot
from ccatp.wire.topics import Estimate, is_estimate_due

MOST_FRAMES = 100_000


@dataclass(slots=True)
class BeaconRehearsal:
    """What a rehearsal leaves.

    Attributes:
        summary: as ``summary.json``.
        states: of the mission, one a frame.
        verdicts: one a frame.
        times_s: of the frames.
        speeds_m_s: set points, forward, one a frame.
        truth: rows of ``beacon_truth``.
        track: rows of ``beacon_track``.
        outcome, cause: how the mission ended.
    """

    summary: dict[str, Any]
    states: list[str] = field(default_factory=list)
    verdicts: list[Verdict] = field(default_factory=list)
    times_s: list[float] = field(default_factory=list)
    speeds_m_s: list[float] = field(default_factory=list)
    truth: list[Any] = field(default_factory=list)
    track: list[Any] = field(default_factory=list)
    outcome: str = ""
    cause: str = ""


def rehearse_beacons(cfg: RadioConfig, on_frame: Callable[[float, Any], None] | None = None) -> BeaconRehearsal:
    """A mission from its first frame to its end, in virtual time; a function of configuration and seed.

    A mission that is faulted ends, as it does in lockstep.

    Args:
        cfg: the configuration.
        on_frame: called with the time and the mission before each frame is decided, for stories.
    """
    robot = build_beacon_robot(cfg)
    mission, danger, reader = assemble_beacons(cfg), BeaconDanger(cfg), SenseReader(cfg)
    log, book, found = BeaconTruthLog(robot, motes_of(cfg)), BeaconSummary(beacon_facts(cfg, is_sim=True)), None
    found = BeaconRehearsal({})
    robot.join_controller()
    robot.join_monitor()
    estimate: Estimate | None = None
    told = ""
    for _ in range(MOST_FRAMES):
        line = robot.delivered_line.rstrip()
        sensors = decode_from_robot(line)
        if not isinstance(sensors, Sensors):
            raise TypeError(f"a robot's frame is no frame: {line[:80]!r}")
        extras = decode_beacon_frame(line)
        verdict = danger.step(sensors, extras, estimate)
        if verdict.signal and verdict.signal != told:
            book.add_danger(verdict.signal)
        told = verdict.signal
        if on_frame is not None:
            on_frame(sensors.t, mission)
        before = len(mission.arrivals)
        drive = mission.step(reader.read(sensors, extras), robot.frame_s, verdict)
        for arrival in mission.arrivals[before:]:
            book.add_reached(Reached(sensors.seq, arrival.belief.ellipse))
        if is_estimate_due(sensors.seq):
            x_m, y_m, heading_rad = mission.navigator.belief.pose
            sigma_m = mission.navigator.belief.sigma_m
            estimate = Estimate(
                seq=sensors.seq, t_s=sensors.t, x_m=x_m, y_m=y_m, heading_rad=heading_rad, sigma_m=sigma_m,
                state=str(mission.state),
            )  # fmt: skip
        found.track.append(track_row(sensors.seq, sensors.t, mission.navigator))
        found.states.append(str(mission.state))
        found.verdicts.append(verdict)
        found.times_s.append(sensors.t)
        found.speeds_m_s.append(drive.speed_m_s)
        if mission.state is DONE or mission.is_faulted:
            break
        right, left, steer = wheel_rates(drive if mission.state is not DONE else HALT, cfg)
        robot.permit(sensors.seq + 1, verdict.forward, verdict.reverse, verdict.turn)
        robot.drive(sensors.seq + 1, right, left, None, steer)
        robot.advance()
        log.add()
    batch = log.batch()
    found.truth = [] if batch is None else batch[1].rows
    book.add_track(found.track)
    book.add_truth(found.truth)
    book.set_places(log.preface()[1].places)
    book.set_map(mission.navigator.beacons, tuple(mission.navigator.score), mission.navigator.notes)
    book.set_mission(found.times_s[-1], str(mission.outcome), mission.cause)
    found.summary, found.outcome, found.cause = book.build(0.0), str(mission.outcome), mission.cause
    return found
