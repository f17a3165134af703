"""The study `mote-navigation`: motes map themselves, then a robot uses them to localize along its route.

Each job simulates a whole mission in one process, with the mission and danger rules of the daemon.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ccatp.beacons.config.models import RadioConfig
from ccatp.beacons.links.messages import (
    TRACK_COLUMNS,
    TRUTH_COLUMNS,
    PoseTrack,
    PoseTruth,
    decode_beacon_frame,
    pose_errors,
    pose_track,
    pose_truth,
    table,
)
from ccatp.beacons.mission import BeaconMission, TrackRow, track_row, wheel_rates
from ccatp.beacons.navigation import MeasurementReader
from ccatp.beacons.records.summary import BeaconSummary
from ccatp.beacons.safety.rules import BeaconSafetyRules
from ccatp.beacons.sim.robot import SimulatedBeaconRobot, build_beacon_robot
from ccatp.beacons.steering import HALT, SteeringCommand
from ccatp.conditions import text_of
from ccatp.core import FloatArray, Verdict
from ccatp.filters.metrics import nees, rms
from ccatp.links.robot_codec import decode_from_robot
from ccatp.links.robot_messages import Sensors
from ccatp.links.topics import EstimateMessage, is_estimate_due
from ccatp.missions import Part
from ccatp.report.plots import QUIET
from ccatp.studies.campaign import Cell, CellResult, Factors, Job, JobOutcome, Study
from ccatp.studies.results import LIMIT, chi_square_band, colour, plot
from ccatp.survey.events import DONE


@dataclass(slots=True)
class BeaconSilResult:
    """A mission: ``summary`` as in ``summary.json``; a row of ``beacon_track`` and ``beacon_truth`` for each frame."""

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


class BeaconSilWorld:
    """Simulated robot (by default that of the configuration), danger rules and mission, stepped frame by frame."""

    def __init__(self, cfg: RadioConfig, robot: SimulatedBeaconRobot | None = None) -> None:
        self._cfg = cfg
        self.robot: SimulatedBeaconRobot = build_beacon_robot(cfg) if robot is None else robot
        self.mission, self.danger = BeaconMission(cfg), BeaconSafetyRules(cfg)
        self.found = BeaconSilResult(truth=[self.robot.truth_row()])
        self._reader = MeasurementReader(cfg)
        self._summary = BeaconSummary(cfg, has_truth=True)
        self._estimate: EstimateMessage | None = None
        self._verdict: Verdict | None = None
        self._signal = ""
        self.robot.join("controller")
        self.robot.join("monitor")

    @property
    def is_over(self) -> bool:
        """Whether the mission has ended, or would wait for an operator, which a simulation does not have."""
        return self.mission.state.mode is DONE or self.mission.state.is_faulted

    def frame(self) -> None:
        """Process the newest frame, and advance the simulation unless the mission is over."""
        line = self.robot.delivered_line.rstrip()
        sensors = decode_from_robot(line)
        if not isinstance(sensors, Sensors):
            raise TypeError(f"not a sensors frame: {line[:80]!r}")
        extras = decode_beacon_frame(line)
        # The decision in a frame uses the verdict on the previous frame.
        in_force, verdict = self._verdict, self.danger.step(sensors, extras, self._estimate)
        self._verdict = verdict
        before = len(self.mission.arrivals)
        drive = self.mission.step(self._reader.read(sensors, extras), self.robot.frame_s, in_force)
        drive = HALT if self.mission.state.mode is DONE else drive
        self._note(sensors, verdict, drive)
        for arrival in self.mission.arrivals[before:]:
            self._summary.reached.append((sensors.seq, arrival.belief.ellipse))
        if not self.is_over:
            right, left, steer = wheel_rates(drive, self._cfg)
            self.robot.permit(sensors.seq + 1, *verdict.permits)
            self.robot.drive(sensors.seq + 1, right, left, None, steer)
            self.robot.advance()
            self.found.truth.append(self.robot.truth_row())

    def _note(self, sensors: Sensors, verdict: Verdict, drive: SteeringCommand) -> None:
        found, mission = self.found, self.mission
        if verdict.signal and verdict.signal != self._signal:
            self._summary.events[verdict.signal] += 1
        self._signal = verdict.signal
        if is_estimate_due(sensors.seq):
            belief = mission.navigator.belief
            x_m, y_m, heading_rad = belief.pose
            self._estimate = EstimateMessage(
                seq=sensors.seq, t_s=sensors.t, x_m=x_m, y_m=y_m, heading_rad=heading_rad, sigma_m=belief.sigma_m,
                state=str(mission.state.mode),
            )  # fmt: skip
        found.track.append(track_row(sensors.seq, sensors.t, mission.navigator))
        found.states.append(str(mission.state.mode))
        found.verdicts.append(verdict)
        found.times_s.append(sensors.t)
        found.speeds_m_s.append(drive.speed_m_s)

    def result(self) -> BeaconSilResult:
        """The result at the end."""
        found, mission, summary = self.found, self.mission, self._summary
        found.outcome, found.cause = str(mission.state.outcome), text_of(mission.state.cause)
        score = mission.navigator.score
        summary.track, summary.truth = list(found.track), list(found.truth)
        summary.places, summary.beacons = self.robot.truth_preface()[1].places, mission.navigator.beacons
        summary.score, summary.readings = (score.nis_sum, score.nis_size), (score.used, score.refused)
        summary.notes = mission.navigator.notes
        summary.mission_time_s, summary.outcome, summary.cause = found.times_s[-1], found.outcome, found.cause
        found.summary = summary.build(0.0)
        return found


def rehearse_beacons(cfg: RadioConfig) -> BeaconSilResult:
    """Simulate a mission in virtual time; the result depends only on configuration and seed."""
    world = BeaconSilWorld(cfg)
    while not world.is_over:
        world.frame()
    return world.result()


SECOND = 10  # frames between two comparisons of errors
_STATES = 3  # x, y, heading


def run_job(job: Job) -> JobOutcome:
    """Run one mission: its statistics, and its errors each second after the end of mapping."""
    found = rehearse_beacons(job.cfg)
    summary = found.summary
    values = {
        "outcome": summary["outcome"],
        "reached": summary["waypoints"]["reached"],
        "within": summary["waypoints"]["within_3_sigma"],
        "position_m": summary["position_error_m"]["rmse"],
        "map_m": summary["beacons"]["rmse_m"],
        "map_expected_m": summary["map"]["map_expected_m"],
        "nis_mean": summary["consistency"]["nis_mean"],
        "readings": summary["consistency"]["readings"],
        "updates": summary["map"]["map_updates"],
    }
    begin_s = summary["map"]["map_time_s"]
    return JobOutcome(values, seconds_of(*found.poses, begin_s))


def seconds_of(track: PoseTrack, truth: PoseTruth, begin_s: float) -> dict[str, FloatArray]:
    """Once a second, NEES of the pose, error of the position, and ``sigma_m``, root of the trace of its covariance."""
    known = np.intersect1d(track.seq[track.t_s >= begin_s], truth.seq, return_indices=True)[0][::SECOND]
    track, truth = track.at(np.isin(track.seq, known)), truth.at(np.isin(truth.seq, known))
    errors, P = pose_errors(track, truth), track.covariance
    return {
        "nees": nees(errors, P),
        "error_m": np.hypot(errors[:, 0], errors[:, 1]),
        "sigma_m": np.sqrt(P[:, 0, 0] + P[:, 1, 1]),
    }


def combine(_: Factors, outcomes: Sequence[JobOutcome]) -> JobOutcome:
    """Combine the missions: NEES at each second over all of them, with the band of its chi-squared sum."""
    runs = [outcome.values for outcome in outcomes]
    length = min(len(outcome.arrays["nees"]) for outcome in outcomes)
    squares, errors, sigmas = (
        np.array([outcome.arrays[key][:length] for outcome in outcomes]) for key in ("nees", "error_m", "sigma_m")
    )
    low, high = chi_square_band(_STATES * len(outcomes))
    each = squares.mean(axis=0) / _STATES
    readings = sum(run["readings"] for run in runs)
    values: dict[str, Any] = {
        "complete": sum(run["outcome"] == "complete" for run in runs),
        "waypoints": sum(run["reached"] for run in runs),
        "within_3_sigma": sum(run["within"] for run in runs),
        "nees": float(each.mean()),
        "band": [low, high],
        "in_band": float(np.mean((each >= low) & (each <= high))),
        "nis": sum(run["nis_mean"] * run["readings"] for run in runs) / readings,
        "position_m": rms(np.array([run["position_m"] for run in runs])),
        "position_expected_m": rms(sigmas),
        "map_m": rms(np.array([run["map_m"] for run in runs])),
        "map_expected_m": rms(np.array([run["map_expected_m"] for run in runs])),
    }
    arrays = {"nees": each, "error_m": np.sqrt((errors**2).mean(axis=0)), "sigma_m": np.sqrt((sigmas**2).mean(axis=0))}
    return JobOutcome(values, arrays)


def draw(cells: Sequence[CellResult], out: Path) -> None:
    """Figure ``mote_navigation``: actual and expected errors, and NEES with its band, over time."""
    cell = cells[0]
    seconds = np.arange(len(cell.arrays["nees"]))
    true_mm, expected_mm = 1e3 * cell.arrays["error_m"], 1e3 * cell.arrays["sigma_m"]
    with plot(out / "mote_navigation", 7.5, 5.6, 2, 1, sharex=True) as (above, below):
        above.plot(seconds, true_mm, color=colour(0), label="true error of the position")
        above.plot(seconds, expected_mm, color=colour(1), linestyle="--", label="expected by the filter")
        above.axhline(1e3 * cell.values["map_m"], color=QUIET, linestyle=":", label="true error of the map at the end")
        above.set(ylabel="mm, root mean square", yscale="log")
        above.set_title("A robot that navigates by motes which mapped themselves")
        above.legend(frameon=False, fontsize=8)
        below.axhspan(*cell.values["band"], color=colour(2), alpha=0.15, linewidth=0, label="95 % band")
        below.axhline(1.0, color=LIMIT, linewidth=0.9, linestyle=":")
        below.plot(seconds, cell.arrays["nees"], color=colour(0), linewidth=1.2, label="mean NEES of the pose")
        below.set(xlabel="seconds since the map", ylabel="for each degree of freedom", ylim=(0.0, 2.5))
        below.legend(frameon=False, fontsize=8, ncols=2)


STUDY = Study(
    cells=lambda: [Cell({"case": "route"})],
    run_job=run_job,
    combine=combine,
    columns="""
        complete waypoints within_3_sigma nees band in_band nis
        position_m position_expected_m map_m map_expected_m
    """,
    draw=draw,
    defaults={"system": "cricket"},
    mirrors=(),
    runs=50,
    loader=Part("ccatp.beacons.config.load:load_beacon_mission"),
)
