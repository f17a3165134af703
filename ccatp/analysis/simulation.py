"""A survey that is simulated in this process, with the same tables as one that was recorded."""

from collections.abc import Iterator, Mapping
from dataclasses import asdict
from os import PathLike
from pathlib import Path

import msgspec
import numpy as np

from ccatp import __version__
from ccatp.analysis.run import ALARM_COLUMNS
from ccatp.analysis.samples import KINDS, SessionFrames
from ccatp.analysis.survey import SurveyRun
from ccatp.analysis.table import table_of_records
from ccatp.config.load import dump_config, load_config
from ccatp.config.models import Config
from ccatp.core import NO_CAUSE, Cause, Fix
from ccatp.daemon.loops.mission_runner import TimedFrame
from ccatp.daemon.operator.alarms import LASTING, LEAST_S, active_cause
from ccatp.errors import ExitStatus
from ccatp.links.robot_codec import decode_from_robot, encode
from ccatp.links.robot_messages import Sensors
from ccatp.links.topics import ArrivalMessage, FixMessage, MissionStatus
from ccatp.records.run_reader import RecordedFrame
from ccatp.records.store import StoredPoint, planned_point
from ccatp.report.findings import findings_of
from ccatp.report.record import RecordedSession, SurveyFiles, changed_from_shipped
from ccatp.sim.fault_plan import FaultPlan, read_plan
from ccatp.studies.sil_run import SilResult, SilRun
from ccatp.survey.behaviours import MissionCommand
from ccatp.survey.fix_review import ReviewedFix
from ccatp.survey.route_follower import StateEstimate


def simulate(
    *,
    mirror: str | None = None,
    panels: int | None = None,
    seed: int | None = None,
    world: str | None = None,
    filter_name: str | None = None,
    settings: Mapping[str, object] | None = None,
    faults: str | PathLike[str] | None = None,
    keep_samples: bool = True,
) -> SurveyRun:
    """Simulate a survey, in about a twentieth of its time; what is not given is as in the shipped configuration.

    Decisions and estimates are those of ``ccatp run --sim`` with the same configuration. ``settings``: dotted keys of
    the configuration; ``faults``: file of a fault plan. ``keep_samples`` costs about 100 MB for a thousand seconds.
    Raises ConfigError: a value cannot be used; PlanError: a point cannot be reached; NoFrames: a plan ends all frames.
    """
    named = {
        "run.mirror": mirror, "run.panels": panels, "run.seed": seed, "run.world": world, "run.filter": filter_name,
    }  # fmt: skip
    given = {key: value for key, value in named.items() if value is not None}
    cfg = load_config(None, {**(settings or {}), **given})
    plan = None if faults is None else read_plan(Path(faults), lockstep=True)
    run = _ObservedRun(cfg, plan, keep_samples=keep_samples)
    return run.observed(run.run())


class _ObservedRun(SilRun):
    """A simulation that keeps what the recorder of the daemon keeps."""

    def __init__(self, cfg: Config, faults: FaultPlan | None, *, keep_samples: bool) -> None:
        super().__init__(cfg, faults)
        self._keeps_samples = keep_samples
        self._lines: list[tuple[int, float, bytes]] = []
        self._times_s: list[float] = []
        self._sigmas_m: list[float] = []
        self._fixes: list[FixMessage] = []
        self._arrivals: list[ArrivalMessage] = []
        self._alarms: list[dict[str, object]] = []
        self._cause = NO_CAUSE
        self._raised_s = 0.0

    def _serve(self, sensors: Sensors, dt_s: float) -> None:
        super()._serve(sensors, dt_s)
        if dt_s <= 0.0:
            return
        if self._keeps_samples:
            self._lines.append((sensors.seq, sensors.t + self._time.offset_s, encode(sensors)))
        verdict = self._verdict
        if verdict is not None and verdict.cause.condition != self._cause.condition:
            self._note_alarm(verdict.cause, sensors.t + self._time.offset_s)

    def _publish(self, frame: TimedFrame) -> None:
        """Keep pose and sigma of one moment: a fix later in the frame changes both."""
        super()._publish(frame)
        self._times_s.append(frame.t_s)
        self._sigmas_m.append(self.localizer.position_sigma_m)

    def _note_alarm(self, cause: Cause, t_s: float) -> None:
        """The cause of the verdict changed; one that is not severe and passes at once is no alarm, as in the daemon."""
        if self._cause.condition:
            self._alarms[-1]["ended_t_s"] = t_s
            if active_cause(self._cause).severity < LASTING and t_s - self._raised_s < LEAST_S:
                self._alarms.pop()
        if cause.condition:
            name, text, severity = active_cause(cause)
            self._alarms.append({"name": name, "cause": text, "severity": severity.name.lower(), "raised_t_s": t_s})
        self._cause, self._raised_s = cause, t_s

    def execute(self, command: MissionCommand, motion: StateEstimate) -> None:
        super().execute(command, motion)
        if command.arrived is not None:
            seq = self.robot.delivered_seq
            message = ArrivalMessage(seq=seq, t_s=motion.t_s, point=command.arrived, error_mm=float("nan"))
            self._arrivals.append(message)

    def _fuse(self, fix: Fix) -> ReviewedFix:
        found, point = super()._fuse(fix), self.mission.state.measuring_point
        message = FixMessage(
            seq=self.robot.delivered_seq,
            point=None if point is None else (*point,),
            is_fused=not found.doubt,
            jump_mm=1e3 * found.jump_m,
            is_set_aside=found.is_set_aside,
            **asdict(fix),
        )
        self._fixes.append(msgspec.structs.replace(message, t_s=fix.t_s + self._time.offset_s))
        return found

    def observed(self, result: SilResult) -> SurveyRun:
        """The tables of the run."""
        cfg, state = self.cfg, self.mission.state
        estimates = self.trace.estimates()._replace(t_s=np.array(self._times_s))
        status = MissionStatus(
            seq=0,
            t_s=result.mission_time_s,
            state=str(state.mode),
            cause=result.cause,
            condition=state.cause.condition,
            outcome=str(state.outcome),
            exit_status=-1 if state.outcome else ExitStatus.HELD,
        )
        session = RecordedSession(
            name="simulation",
            number=1,
            offset_s=0.0,
            version=__version__,
            track=estimates,
            sigma_m=np.array(self._sigmas_m),
            truth=self.trace.truth(),
            arrivals=tuple(self._arrivals),
            fixes=tuple(self._fixes),
            statuses=(status,),
            changes=(),
        )
        misalignments = self.robot.world.misalignments.items()
        record = SurveyFiles(
            name=f"{cfg.mirror.name}-{cfg.world.name}-s{cfg.run.seed}",
            config_text=dump_config(cfg),
            changed=changed_from_shipped(cfg),
            is_simulation=True,
            summary=result.summary,
            recordings=(),
            log=(),
            files={},
            missing=(),
            warnings=(),
            cfg=cfg,
            mirror=self.mirror,
            sessions=(session,),
            points=self._points(),
            measured=self.laser.measured,
            injected={panel: (m.piston_m, m.tip_rad, m.tilt_rad) for panel, m in misalignments},
        )
        findings = findings_of(record)
        return SurveyRun(
            name=record.name,
            is_simulation=True,
            summary=result.summary,
            warnings=findings.warnings,
            config=cfg,
            alarms=table_of_records(ALARM_COLUMNS, self._alarms),
            frames=lambda: (SessionFrames(1, 0.0, self._frames()),),
            sample_kinds=KINDS,
            findings=findings,
        )

    def _points(self) -> tuple[StoredPoint, ...]:
        measured = {one.point: one.fix.t_s for one in self.laser.measured}
        points = [planned_point(point, self.cfg.mirror.panels) for point in sorted(self.parts.points)]
        skipped = self.mission.state.points.skipped
        return tuple(
            one._replace(status="measured", t_s=measured[one.point])
            if one.point in measured
            else one._replace(status="skipped" if one.point in skipped else "planned")
            for one in points
        )

    def _frames(self) -> Iterator[RecordedFrame]:
        if not self._keeps_samples:
            raise ValueError("this simulation kept no samples: simulate with keep_samples=True")
        for number, t_s, line in self._lines:
            sensors = decode_from_robot(line)
            if isinstance(sensors, Sensors):
                yield RecordedFrame(number, t_s, sensors, line)
