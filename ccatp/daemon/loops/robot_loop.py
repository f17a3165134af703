"""Common base of main loop and danger loop: session with the robot, bus, and tasks that end together."""

import asyncio
import gc
import time
from abc import abstractmethod
from collections.abc import Coroutine
from typing import Any

import zmq
import zmq.asyncio

from ccatp.daemon.loops.robot_session import LatenessStatistics, RobotSession
from ccatp.daemon.supervision.process import ProcessArgs, open_log, unless_stopped
from ccatp.links import realtime
from ccatp.links.bus import PERIOD_S, HeartbeatPublisher, PeerSubscriber, Publisher
from ccatp.links.robot_messages import Role

WAIT_PERIOD_S = 0.02
# In lockstep the robot sends the next frame as soon as it has its answers, or repeats the last one after a second.
REPEAT_S = 1.0
# A copy of a frame that arrives sooner is a duplicated line and needs no answer.
DUPLICATE_S = 0.5
# A missing frame is reported after the first time; after an invalid line, whose frame the robot repeats, after the
# second one.
OVERDUE_S, INVALID_S = 3.0, 0.5
LOCKSTEP_SILENCE_S = 30.0


class RobotLoop(RobotSession):
    """A loop with a session at the robot. ``peer``: messages of the other loop; ``over``: the loop ends by itself."""

    peer: PeerSubscriber

    def __init__(self, name: str, role: Role, args: ProcessArgs, context: zmq.Context[zmq.Socket[bytes]]) -> None:
        super().__init__(args.config.robot, role, name)
        self._args = args
        self._shadow = zmq.asyncio.Context.shadow(context)
        self.log = open_log(args.run_dir / "log.jsonl", name)
        self.publisher = Publisher(context, args.endpoints.of(name))
        self.heartbeat = HeartbeatPublisher(self.publisher, name)
        self.lateness = LatenessStatistics(self.robot_cfg.slip_after_s)
        self.over = asyncio.Event()
        # In lockstep, by the monotonic clock: start of the session, last repeated frame, last repeated answer, last
        # invalid line, and the frame whose successor was reported as overdue.
        self._joined_s = self._repeated_s = self._answered_again_s = self._invalid_s = self._reported_s = 0.0
        self._explained = 0  # the newest session whose first bad line is reported
        self._counted: tuple[float, int] = (
            0.0,
            0,
        )  # time of the newest frame, frames with old numbers until then

    async def run(self, stop: asyncio.Event) -> None:
        """Join the robot together with the other loop, then serve frames until ``over`` or ``stop`` is set."""
        async with asyncio.TaskGroup() as tasks:
            served = [tasks.create_task(service) for service in self.services()]
            try:
                await self._join(stop)
                await unless_stopped(stop, self.over.wait())
                await self.end(stop)
            finally:
                for task in served:
                    task.cancel()
                self.leave()
                await self.close()

    async def _join(self, stop: asyncio.Event) -> None:
        if not await unless_stopped(stop, self.connect()):
            return
        while not self.is_peer_ready():
            if stop.is_set():
                return
            await asyncio.sleep(WAIT_PERIOD_S)
        gc.freeze()  # otherwise a collection during the run visits all objects of the libraries, for about 50 ms
        joins = self.join(is_patient=self._args.is_taking_over)
        if await unless_stopped(stop, joins) and not self.is_lockstep:
            realtime.enter(self._args.config.processes.realtime_priority, self.log)

    @abstractmethod
    def services(self) -> tuple[Coroutine[Any, Any, None], ...]:
        """The services that run besides the frames."""

    async def connect(self) -> None:
        """Connect to peers other than the robot and the other loop."""

    @abstractmethod
    def is_peer_ready(self) -> bool:
        """Whether messages reach the other loop, and it is ready for this one to join."""

    @abstractmethod
    async def end(self, stop: asyncio.Event) -> None:
        """Send the last messages, write the last lines of the log."""

    async def close(self) -> None:
        """Close the resources of ``connect``."""

    def publish_levels(self) -> None:
        """Publish the levels, which are repeated with the heartbeat."""

    def is_frame_due(self) -> bool:
        """In lockstep: whether the last frame was answered, so that the robot has to send the next one."""
        return False

    @abstractmethod
    def answer_again(self) -> None:
        """Repeat the last answer of the session, if any, with a new number."""

    @abstractmethod
    def report_overdue(self, text: str) -> None:
        """Report that a frame is missing in lockstep, so that the robot stands."""

    def on_bad_line(self) -> None:
        """See ``RobotSession``."""
        self._invalid_s = time.monotonic()
        if self._explained != self.sessions:  # below the limit of bad lines no other line says what is wrong with them
            self._explained = self.sessions
            self.log.warning("bad_line", session=self.sessions, reason=self.link.first_bad_line)
            self.report_bad_line(
                f"a line of the robot is not valid: {self.link.first_bad_line}; 'ccatp conformance' checks the firmware"
            )

    def report_bad_line(self, text: str) -> None:
        """Report the first bad line of a session to the operator; for each loop it is in the log."""

    def on_repeated(self) -> None:
        """In lockstep the robot repeats a frame when it has not received an answer of this or the other loop."""
        if self.is_lockstep:
            self._repeated_s = time.monotonic()
            self._answer_again_after(DUPLICATE_S)

    def _answer_again_after(self, quiet_s: float) -> None:
        now_s = time.monotonic()
        if now_s - max(self.heartbeat.frame_s or 0.0, self._answered_again_s) >= quiet_s:
            self._answered_again_s = now_s
            self.answer_again()

    def _watch_lockstep(self, frame_s: float) -> None:
        """Repeat the answer each second, report a missing frame, and drop the connection to a silent robot.

        The answer is also repeated while a newer one is withheld, to keep the session.
        """
        self._answer_again_after(REPEAT_S)
        now_s = time.monotonic()
        age_s, silent_s = now_s - frame_s, now_s - max(frame_s, self._repeated_s)
        old = self.link.counts["repeated_frames"]
        if self._counted[0] != frame_s:
            self._counted = frame_s, old
        is_invalid, is_repeated = self._invalid_s > frame_s, self._repeated_s > frame_s
        is_overdue = age_s > INVALID_S if is_invalid else age_s > OVERDUE_S and self.is_frame_due()
        if is_overdue and self._reported_s != frame_s:
            self._reported_s = frame_s
            sends = (
                "a line that is not valid" if is_invalid
                else "its last frame again" if is_repeated
                else "frames with older numbers" if old > self._counted[1]
                else "nothing"
            )  # fmt: skip
            self.report_overdue(f"the robot stands: no new frame for {age_s:.1f} s in lockstep; it sends {sends}")
        # The monitor receives no frames before a controller has joined.
        if silent_s > LOCKSTEP_SILENCE_S and (self._role == "controller" or frame_s > self._joined_s):
            self.drop(f"no sensors frame for {silent_s:.0f} s in lockstep, not even the last one again")

    @abstractmethod
    def on_silence(self, age_s: float) -> None:
        """Handle the age of the newest frame; called periodically in real time, also while frames are prompt."""

    def begin_session(self) -> None:
        """Begin a session: restart the statistics of lateness and the age of the frames."""
        self.lateness.reset()
        self._joined_s = time.monotonic()
        self.heartbeat.phase, self.heartbeat.frame_s = "joined", self._joined_s

    async def publish_heartbeat(self) -> None:
        """Publish periodically, until cancelled."""
        while True:
            self.heartbeat.publish()
            self.publish_levels()
            await asyncio.sleep(PERIOD_S)

    async def watch(self) -> None:
        """Handle missing frames, and drop a silent connection; until cancelled."""
        while True:
            await asyncio.sleep(WAIT_PERIOD_S)
            self.peer.maintain()
            frame_s = self.heartbeat.frame_s
            if self.heartbeat.phase != "joined" or frame_s is None:
                continue
            if self.is_lockstep:
                self._watch_lockstep(frame_s)
                continue
            age_s = time.monotonic() - frame_s
            self.on_silence(age_s)
            if age_s > self.robot_cfg.silence_timeout_s:
                self.drop(f"no sensors frame for {age_s:.2f} s")
