"""Glue. A mission among beacons in the main-loop process: senses, mission, wheel rates, store."""

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager

from ccatp.beacon_assembly import assemble_beacons, check_beacon_robot
from ccatp.beacon_mission.mission import BeaconMission
from ccatp.beacon_mission.senses import SenseReader, Senses
from ccatp.beacon_mission.states import DONE, HELD, IDLE, RETURNING, State
from ccatp.beacon_mission.wheel_rates import wheel_rates
from ccatp.config.radio_models import RadioConfig
from ccatp.control.waypoint_steering import HALT
from ccatp.errors import ExitStatus
from ccatp.processes.beacon_telling import BeaconTeller
from ccatp.processes.common import BeaconArgs
from ccatp.processes.work import STILL, Drive, Host, Hosting, MakeWork, Progress, Served
from ccatp.samples import Verdict
from ccatp.storage.beacon_store import BeaconStore
from ccatp.surveying.states import Outcome
from ccatp.wire.beacon_frame import NOTHING, decode_beacon_frame
from ccatp.wire.robot import BadLine, Hello

EXIT_STATUS = {
    Outcome.COMPLETE: ExitStatus.COMPLETE,
    Outcome.AT_BASE: ExitStatus.ABORTED,
    Outcome.STOPPED: ExitStatus.HELD,
    Outcome.NONE: ExitStatus.INTERRUPTED,
}


class BeaconWork:
    """A mission among beacons as the main-loop process hosts it.

    Args:
        cfg: the configuration; nothing of ``sim`` is used.
        host: what the process has for it.
        mission: the pure part.
        store: the mission's database.
    """

    is_busy = False  # it waits for nobody

    def __init__(self, cfg: RadioConfig, host: Host, mission: BeaconMission, store: BeaconStore) -> None:
        """Wire the parts."""
        self._cfg, self._host, self._mission, self._store = cfg, host, mission, store
        self._reader = SenseReader(cfg)
        self._teller = BeaconTeller(host.publisher, host.log, cfg, mission)
        self._senses: Senses | None = None
        self._speed_m_s = 0.0
        self._state: State = IDLE
        self._was_faulted = False
        self._told_arrivals = 0
        # An operator's commands are the mission's; so is what holds it.
        self.pause, self.resume, self.abort, self.stop = mission.pause, mission.resume, mission.abort, mission.stop
        self.interrupt = mission.interrupt

    @property
    def teller(self) -> BeaconTeller:
        """Tells the others."""
        return self._teller

    @property
    def cause(self) -> str:
        """Why it is held."""
        return self._mission.cause

    @property
    def is_paused(self) -> bool:
        """Held until somebody resumes."""
        return self._mission.is_paused

    @property
    def is_quiet(self) -> bool:
        """The robot is at rest; its wheels obey within a frame, so what they were told last is what counts."""
        return abs(self._speed_m_s) <= self._cfg.mission.settle_speed_m_s

    def progress(self) -> Progress:
        """How far it is."""
        mission = self._mission
        at = mission.next_waypoint
        return Progress(
            state=str(mission.state),
            cause=mission.cause,
            done=mission.done,
            skipped=0,
            total=mission.total,
            point=f"waypoint {at + 1}" if at >= 0 else "",
            eta_s=0.0,
            error_mm=1e3 * mission.navigator.belief.sigma_m,
            outcome=str(mission.outcome),
            lower_bound_s=0.0,
            left_out={},
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

    def greet(self) -> None:
        """There are no fans."""

    def lose_sight(self) -> None:
        """The robot booted, or moved unseen: where it is nobody knows, and its map hangs on that."""
        self._reader.forget()
        self._mission.fault("the robot was out of sight: put it at its start and begin anew")

    def keep(self) -> None:
        """Nobody takes over: the map would have to be kept, too."""

    def settle(self) -> None:
        """Tell a state that is new, and end where that is the end."""
        mission, before, was_faulted = self._mission, self._state, self._was_faulted
        if mission.state is before and mission.is_faulted is was_faulted:
            return
        self._state, self._was_faulted = mission.state, mission.is_faulted
        self._teller.log.debug("state", seq=self._host.clock.seq, before=before, after=mission.state)
        if HELD in (mission.state, before) or mission.state is RETURNING:
            text = f"{mission.state}: {mission.cause}" if mission.cause else f"{mission.state}"
            self._teller.say("warning", text)
            self._store.record_event(self._host.clock.t_s, "warning", text)
        if mission.state is DONE:
            self._teller.tell_map()
            self._host.finish(EXIT_STATUS[mission.outcome])
        elif mission.is_faulted and self._host.seat.is_lockstep:
            # Nobody can be waited for while simulated time runs at many times the wall clock.
            self._teller.tell_map()
            self._host.finish(ExitStatus.HELD)

    def note_end(self) -> None:
        """How consistent it was."""
        score = self._mission.navigator.score
        self._teller.log.info("readings", nis_sum=score.nis_sum, nis_size=score.nis_size, refused=score.refused)

    # -- the frame ------------------------------------------------------------------------------------------------

    def listen(self, frame: Served) -> None:
        """Read the senses of the frame; damaged extra keys are as good as none."""
        try:
            extras = decode_beacon_frame(frame.raw)
        except BadLine as error:
            extras = NOTHING
            self._teller.log.warning("bad extra keys", seq=frame.sensors.seq, error=str(error))
        self._senses = self._reader.read(frame.sensors, extras)

    def decide(self, frame: Served, verdict: Verdict | None, _lag_s: float) -> Drive:
        """What the mission wants, as far as the verdict permits it."""
        mission = self._mission
        if self._senses is None:
            raise RuntimeError("decide comes after listen")
        drive = mission.step(self._senses, self._host.seat.frame_period_s, verdict)
        if mission.state is DONE:
            drive = HALT
        self._speed_m_s = drive.speed_m_s
        return Drive(*wheel_rates(drive, self._cfg))

    def stand(self, _frame: Served) -> Drive:
        """The robot stands, and nothing is decided in this frame."""
        self._speed_m_s = 0.0
        return STILL

    def tell(self, frame: Served) -> None:
        """The estimate, arrivals, a state that is new."""
        sensors, mission = frame.sensors, self._mission
        distances = () if self._senses is None else self._senses.distances_m
        self._teller.frame(sensors.seq, sensors.t, frame.raw, distances, is_first=frame.is_first)
        for number in range(self._told_arrivals, len(mission.arrivals)):
            arrival = mission.arrivals[number]
            self._teller.arrival(arrival)
            self._store.record_arrival(sensors.t, number, arrival)
        self._told_arrivals = len(mission.arrivals)
        self.settle()


def hosting_of_beacons(cfg: RadioConfig) -> Hosting:
    """What the process needs of the configuration."""
    return Hosting(
        cfg.robot, cfg.processes.realtime_priority, cfg.mission.verdict_timeout_s, 10.0 * cfg.run.step_s,
        1.0 / cfg.run.step_s,
    )  # fmt: skip


@contextmanager
def open_beacons(args: BeaconArgs) -> Iterator[MakeWork]:
    """The parts and the database of a mission among beacons; what makes the mission of them."""
    cfg = args.config
    mission = assemble_beacons(cfg)
    laps = 0 if cfg.follow.is_active else cfg.mission.laps
    meta = {"system": cfg.system, "seed": str(cfg.run.seed)}
    store = BeaconStore(args.run_dir / "mission.sqlite", meta, cfg.workspace.waypoints_m, laps)
    try:
        yield lambda host: BeaconWork(cfg, host, mission, store)
    finally:
        store.close()
