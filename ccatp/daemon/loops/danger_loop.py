"""The danger-loop process: judges every sensors frame, and sends the permit and the verdict.

The configuration selects the safety monitor. The emergency latch is saved in a file for a restarted process.
"""

import asyncio
import sys
import time
from collections.abc import Coroutine
from typing import Any, NamedTuple

import zmq
import zmq.asyncio

from ccatp.conditions import text_of
from ccatp.core import NO_CAUSE, Cause, EventCode, Severity, Verdict
from ccatp.daemon.loops.emergency_file import EMERGENCIES_FILE, PersistentEmergencyLatch
from ccatp.daemon.loops.robot_loop import RobotLoop
from ccatp.daemon.operator.alarms import ActiveCause, active_cause
from ccatp.daemon.operator.observatory import ObservatoryServer
from ccatp.daemon.supervision.process import ProcessArgs, run_process, start_process
from ccatp.errors import ExitStatus
from ccatp.links.bus import EstimateSubscriber
from ccatp.links.frame_answers import PermitRule
from ccatp.links.robot_messages import Hello, Sensors
from ccatp.links.topics import DangerEvent
from ccatp.missions import kind_of
from ccatp.safety.rules import SafetyRules


class PublishedVerdict(NamedTuple):
    """What the last event had: the verdict, the names of all findings, and the active emergencies."""

    code: EventCode = EventCode.NORMAL
    cause: Cause = NO_CAUSE
    severity: Severity = Severity.NONE
    findings: frozenset[str] = frozenset()
    emergencies: tuple[Cause, ...] = ()


class DangerLoop:
    """Connects the monitor to the robot link, the bus and the observatory channel: the work of the danger process."""

    def __init__(self, args: ProcessArgs, context: zmq.Context[zmq.Socket[bytes]]) -> None:
        self.loop = RobotLoop("danger", "monitor", args, context, work=self)
        self.session = self.loop.session
        self.log = self.loop.log
        self.heartbeat = self.loop.heartbeat
        self._context = context
        self._cfg = cfg = args.config
        self.monitor: SafetyRules = kind_of(cfg).rules.get()(cfg)
        self.monitor.latch = PersistentEmergencyLatch(args.run_dir / EMERGENCIES_FILE, self.log)
        self.peer = EstimateSubscriber(
            context, args.endpoints.of("main"), self.heartbeat.publish_if_due, is_taking_over=args.is_taking_over
        )
        self._has_estimate = False
        self._published = PublishedVerdict()
        self._seq = -1
        self._t_s = 0.0
        self._bad_lines = 0
        self._permits = PermitRule()
        self._is_stale = False
        self._observatory = ObservatoryServer(
            args.endpoints.of("emergency"),
            cfg.observatory,
            self.monitor,
            lambda: self.heartbeat.frame_age_s if self._seq >= 0 else None,
            log=self.log,
        )

    def services(self) -> tuple[Coroutine[Any, Any, None], ...]:
        return (self._observatory.serve(zmq.asyncio.Context.shadow(self._context)),)

    async def connect(self) -> None:
        """There is no peer but the robot and the main loop."""

    def is_peer_ready(self) -> bool:
        """Whether messages arrive in both directions, so that the first ones are not lost."""
        self._has_estimate = self._has_estimate or self.peer.has_received()
        return self._has_estimate and self.loop.publisher.has_subscriber("verdict")

    async def end(self, _stop: asyncio.Event) -> None:
        self.log.info("danger_statistics", **self.monitor.counts)

    async def close(self) -> None:
        """The process ends."""

    def on_heartbeat(self) -> None:
        """The verdict is published with each frame."""

    def on_joined(self, hello: Hello) -> None:
        self._permits.begin_session()
        self.monitor.limit_wheels(hello.robot.max_wheel_rad_s)
        self.loop.begin_session()
        port = self.session.cfg.port
        self.log.info("robot_joined", port=port, lockstep=hello.lockstep, session=self.session.count)

    def on_restarted(self) -> None:
        self.monitor.reset()
        if self.session.hello is not None:
            self.monitor.limit_wheels(self.session.hello.robot.max_wheel_rad_s)
        self.peer.reset()
        self._permits.restart()
        self._seq = -1

    def on_lost(self, reason: str) -> None:
        self.heartbeat.phase = "rejoining"
        self.log.warning("robot_link_lost", reason=reason)
        self._publish_verdict(self.monitor.stale(self._seq, self._t_s), -1)

    def on_silence(self, age_s: float) -> None:
        """Withhold the permit."""
        if age_s <= self._cfg.danger.stale_after_s:
            return
        if not self._is_stale:
            self._is_stale = True
            self.log.warning("sensors_stale", age_s=age_s)
        self._publish_verdict(self.monitor.stale(self._seq, self._t_s), self._seq)

    def on_sensors(self, sensors: Sensors, raw: bytes) -> None:
        """Judge one frame. In lockstep it waits for main's estimate of a certain frame, so that a run is repeatable."""
        is_lockstep = self.session.is_lockstep
        self._seq = sensors.seq
        self._t_s = sensors.t
        self.heartbeat.frame_s = time.monotonic()
        self._is_stale = False
        self._bad_lines = 0
        if not self._permits.take(self.session.frame_id(sensors)):
            # The last frame of the session before: its samples are not taken twice.
            self._publish_verdict(self.monitor.stale(sensors.seq, sensors.t), sensors.seq)
            return
        estimate = self.peer.latest(sensors.seq, is_lockstep=is_lockstep)
        try:
            verdict = self.monitor.judge(sensors, raw, estimate)
        except Exception as error:
            # Without a verdict the robot's permit expires, and the robot holds by itself.
            self.log.exception("unhandled_exception", seq=self._seq)
            print(f"ccatp danger: internal error: {type(error).__name__}: {error}", file=sys.stderr, flush=True)
            self.loop.over.set()
            return
        if not is_lockstep and self.loop.lateness.add(sensors.t, time.monotonic()) > self._cfg.danger.stale_after_s:
            verdict = self.monitor.stale(sensors.seq, sensors.t)  # too late: this verdict would be on an old frame
        self._publish_verdict(verdict, sensors.seq)

    def on_bad_line(self) -> None:
        """In lockstep each bad line counts as the period of a frame, so that a run is repeatable."""
        self._bad_lines += 1
        hello = self.session.hello
        is_timed = hello is not None and hello.lockstep
        at_s = self._t_s + self._bad_lines / hello.frame_hz if hello and is_timed else time.monotonic()
        verdict = self.monitor.garbled(self._seq, self._t_s, at_s)
        if verdict is not None:
            self._publish_verdict(verdict, self._seq)

    def answer_again(self) -> None:
        permit = self._permits.permit()
        if permit is not None:
            self.session.link.send_permit(permit.seq, permit.ack, permit.forward, permit.reverse, turn=permit.turn)

    def is_frame_due(self) -> bool:
        """Never for this loop: main decides when a frame is answered."""
        return False

    def report_bad_line(self, text: str) -> None:
        """Main tells the operator."""

    def report_overdue(self, text: str) -> None:
        self.log.warning("frame_overdue", text=text)

    def _publish_verdict(self, verdict: Verdict, ack: int) -> None:
        if ack >= 0:  # the permit first, without waiting for the publication
            self._permits.judge(verdict)
            self.answer_again()
        self.loop.publisher.send("verdict", verdict)
        if not (verdict.cause or self._published.cause):  # still no cause, so there is no finding either
            return
        found, emergencies = self.monitor.found, self.monitor.latch.causes
        names = frozenset(finding.condition.name for finding in found)
        news = PublishedVerdict(verdict.code, verdict.cause, verdict.severity, names, emergencies=tuple(emergencies))
        before, self._published = self._published, news
        if news == before:
            return
        is_verdict_new = news[:3] != before[:3]
        active = [ActiveCause(one.condition.name, text_of(one.cause), one.severity) for one in found]
        others = [verdict.cause, *(cause for cause in emergencies if cause != verdict.cause)]
        active += [active_cause(cause) for cause in others if cause and cause not in [one.cause for one in found]]
        fields: dict[str, Any] = {name: getattr(verdict, name) for name in ("signal", "value", "limit")}
        fields |= {"cause": text_of(verdict.cause), "condition": verdict.cause.condition}
        fields |= {"code": int(verdict.code), "severity": int(verdict.severity)}
        listed = [(name, cause, int(severity)) for name, cause, severity in active]
        event = DangerEvent(seq=verdict.seq, t_s=verdict.t_s, off=verdict.off, active=listed, **fields)
        self.loop.publisher.send("danger_event", event)
        if is_verdict_new:  # otherwise only other findings began or ended; the list of alarms has them
            self.log.info("verdict_changed", seq=verdict.seq, t_s=verdict.t_s, **fields)


def main() -> int:
    """Entry of ``python -m ccatp.daemon.loops.danger_loop``."""
    args = start_process()

    async def serve(context: zmq.Context[zmq.Socket[bytes]], stop: asyncio.Event) -> int:
        await DangerLoop(args, context).loop.run(stop)
        return 0 if stop.is_set() else int(ExitStatus.HELD)

    return run_process("danger", serve)


if __name__ == "__main__":
    raise SystemExit(main())
