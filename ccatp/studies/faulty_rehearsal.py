"""Pure. A rehearsal whose robot has a plan of faults: frames lost or garbled, a clock that jumps, wheels blocked."""

from ccatp.config.models import Config
from ccatp.sim.faults.plan import FaultPlan
from ccatp.sim.faults.record import Injected
from ccatp.studies.fault_plans import NoFrames
from ccatp.studies.rehearsal import Rehearsing
from ccatp.wire.robot import Sensors

_LOST_FRAMES = 500  # without a frame for so long a mission is over


class FaultyRehearsal(Rehearsing):
    """As the processes: a frame that nobody can take is passed over, and one that is not newer is answered with zeros.

    Args:
        cfg: the configuration.
        plan: what shall go wrong.
        with_track: keep true and estimated pose of every frame.

    Attributes:
        denied_s: when lines that were no frames took the permit away.
        weak_frames: frames on an overhang in which the fans gave less than their floor.
    """

    def __init__(self, cfg: Config, plan: FaultPlan, *, with_track: bool = False) -> None:
        super().__init__(cfg, with_track=with_track, faults=plan)
        self.denied_s: list[float] = []
        self.weak_frames = 0

    @property
    def injected(self) -> tuple[Injected, ...]:
        """What became of each fault of the plan."""
        injector = self.robot.injector
        return () if injector is None else injector.injected

    def _note_truth(self) -> None:
        super()._note_truth()
        for _ in range(_LOST_FRAMES):
            if self.robot.delivered is not None:
                return
            self._hear_garbled()
            self.robot.advance()
            super()._note_truth()
        raise NoFrames(f"no frame arrives any more after {self.robot.t_s:.2f} s")

    def _hear_garbled(self) -> None:
        """As the danger loop on a line that no client may take."""
        last = self.monitor.verdict
        if not self.robot.delivered_line or last.seq < 0:
            return
        verdict = self.monitor.garbled(last.seq, last.t_s, self.robot.t_s)
        if verdict is not None:
            self.denied_s.append(self.robot.t_s)
            self._drive_seq += 1  # numbers drives and permits alike here
            self.robot.permit(self._drive_seq, verdict.forward, verdict.reverse, verdict.turn)

    def _serve(self, frame: Sensors, dt_s: float) -> None:
        if self.mirror.overhang and self.robot.fans.thrust < self.cfg.sim.robot.fan_floor:
            self.weak_frames += 1
        if dt_s > 0.0:
            super()._serve(frame, dt_s)
            return
        self.localizer.step(frame.t, frame.imu, frame.enc, frame.edge, frame.gravity)
        self._drive_seq += 1
        self._foresee(self._drive_seq, 0.0, 0.0)
        self.robot.drive(self._drive_seq, 0.0, 0.0)
