"""Glue. The danger-loop process: judges every sensors frame, gives the robot its permit and main its verdict."""

import asyncio
import os
import sys
import time
from typing import Any

import zmq
import zmq.asyncio

from ccatp.bus import Publisher, Subscriber
from ccatp.danger import DangerMonitor
from ccatp.errors import CcatpError
from ccatp.mirror.mirror import build_mirror
from ccatp.processes import realtime, spinning
from ccatp.processes.common import ProcessArgs, die_with_parent, open_log, parse_args, report, stop_on_signals
from ccatp.processes.observing import Observatory, ObservatoryDesk
from ccatp.robot_link import RobotLink, read_key
from ccatp.samples import EventCode, Severity, Verdict
from ccatp.wire.robot import Sensors
from ccatp.wire.topics import DangerEvent, Estimate, Presence, last_estimate_before

PRESENCE_PERIOD_S = 0.1
WAIT_PERIOD_S = 0.02
# In lockstep simulated time stands still while we wait; longer than this main is gone and the frame is judged without.
LOCKSTEP_WAIT_S = 10.0


class DangerLoop:
    """Wires the monitor to the robot link, the bus and the observatory channel.

    Args:
        args: configuration and endpoints.
        context: ZeroMQ context of the process.
    """

    def __init__(self, args: ProcessArgs, context: zmq.Context[zmq.Socket[bytes]]) -> None:
        """Build the pure part and bind the sockets."""
        cfg = args.config
        self._cfg, self._endpoints, self._context = cfg, args.endpoints, context
        self.log = open_log(args.run_dir / "log.jsonl", "danger")
        self.monitor = DangerMonitor(build_mirror(cfg.mirror), cfg.robot, cfg.danger, cfg.health)
        self._publisher = Publisher(context, args.endpoints.of("danger"))
        self._subscriber = Subscriber(context, [args.endpoints.of("main")], ["estimate", "presence.main"])
        self._estimate: Estimate | None = None
        self._phase = "starting"
        self._told = (EventCode.NORMAL, "", Severity.NONE)
        self._seq = self._first_seq = -1
        self._permit_seq = 0
        self._t_s = 0.0
        self._frame_wall_s = time.monotonic()
        self._is_stale = False
        self.link = RobotLink(
            host=cfg.robot.host,
            port=cfg.robot.port,
            role="monitor",
            client="danger",
            key=read_key(cfg.robot.key_file),
            on_sensors=self.on_sensors,
            on_lost=self._on_lost,
        )
        desk = ObservatoryDesk(self.monitor, self._age_s, self.log)
        self._observatory = Observatory(args.endpoints.of("emergency"), cfg.observatory, desk)
        self.lost = asyncio.Event()
        self._is_lockstep = False

    async def run(self, stop: asyncio.Event) -> None:
        """Join the robot, then judge frames until ``stop`` is set or the link is lost."""
        shadow = zmq.asyncio.Context.shadow(self._context)
        async with asyncio.TaskGroup() as tasks:
            served = [tasks.create_task(work) for work in (self._observatory.serve(shadow), self._beat())]
            try:
                await self._wait_for_main(stop)
                hello = await self.link.connect(self._cfg.robot.connect_timeout_s)
                self._is_lockstep = hello.lockstep
                self._phase = "joined"
                if not hello.lockstep:
                    realtime.enter(self._cfg.run.realtime_priority, self.log)
                self.log.info("joined", port=self._cfg.robot.port, lockstep=hello.lockstep)
                waits = [tasks.create_task(stop.wait()), tasks.create_task(self.lost.wait())]
                await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
                for wait in waits:
                    wait.cancel()
            finally:
                for task in served:
                    task.cancel()
                self.link.close()
        self.log.info("stopped", episodes=self.monitor.episodes_opened, edges=self.monitor.edges_declared)

    def _age_s(self) -> float | None:
        return None if self._seq < 0 else time.monotonic() - self._frame_wall_s

    async def _wait_for_main(self, stop: asyncio.Event) -> None:
        """Join the robot only when main's messages get through: its first estimate must not be lost."""
        while not stop.is_set() and self._subscriber.receive() is None:  # noqa: ASYNC110 - no event of the loop
            await asyncio.sleep(WAIT_PERIOD_S)

    def on_sensors(self, sensors: Sensors, _raw: bytes) -> None:
        """Judge one frame. In lockstep with a certain estimate of main's, so that the run is repeatable."""
        self._seq, self._t_s, self._frame_wall_s, self._is_stale = sensors.seq, sensors.t, time.monotonic(), False
        if self._first_seq < 0:
            self._first_seq = sensors.seq
        wanted = last_estimate_before(sensors.seq)
        self._take_estimates(wanted if wanted >= self._first_seq else -1)
        try:
            verdict = self.monitor.step(sensors, self._estimate)
        except Exception as error:
            # Without a verdict the robot's permit runs out: it holds by itself.
            self.log.exception("surprise in a frame", seq=self._seq)
            print(f"ccatp danger: internal error: {type(error).__name__}: {error}", file=sys.stderr, flush=True)
            self.lost.set()
            return
        self._give(verdict, sensors.seq)

    def _give(self, verdict: Verdict, ack: int) -> None:
        if ack >= 0:  # the robot first: what it may do does not wait for anyone to read why
            self._permit_seq += 1
            self.link.send_permit(self._permit_seq, ack, verdict.forward, verdict.reverse, verdict.turn)
        self._publisher.send("verdict", verdict)
        if (verdict.code, verdict.cause, verdict.severity) != self._told:
            self._announce(verdict)

    def _announce(self, verdict: Verdict) -> None:
        self._told = verdict.code, verdict.cause, verdict.severity
        fields: dict[str, Any] = {
            "code": int(verdict.code),
            "cause": verdict.cause,
            "signal": verdict.signal,
            "value": verdict.value,
            "limit": verdict.limit,
            "severity": int(verdict.severity),
        }
        self._publisher.send("danger_event", DangerEvent(seq=verdict.seq, t_s=verdict.t_s, off=verdict.off, **fields))
        self.log.info("verdict", seq=verdict.seq, t_s=verdict.t_s, **fields)

    def _take_estimates(self, wanted_seq: int) -> None:
        if self._is_lockstep and self._estimate_seq() >= wanted_seq:
            return
        deadline = time.monotonic() + LOCKSTEP_WAIT_S
        while True:
            must_wait = self._is_lockstep and self._estimate_seq() < wanted_seq
            received = self._subscriber.receive(max(0.0, deadline - time.monotonic()) if must_wait else 0.0)
            if received is None:
                return
            if isinstance(received[1], Estimate):
                self._estimate = received[1]
            if must_wait and self._estimate_seq() >= wanted_seq:
                return

    def _estimate_seq(self) -> int:
        return -1 if self._estimate is None else self._estimate.seq

    async def _beat(self) -> None:
        """Be seen alive; where frames stop coming, withhold the permit aloud."""
        count = 0
        while True:
            self._publisher.send(
                "presence.danger",
                Presence(
                    seq=count,
                    t_s=time.monotonic(),
                    process="danger",
                    pid=os.getpid(),
                    phase=self._phase,
                    frame_age_s=self._age_s(),
                ),
            )
            count += 1
            age_s = time.monotonic() - self._frame_wall_s
            if self._phase == "joined" and not self._is_lockstep and age_s > self._cfg.danger.stale_after_s:
                self._declare_stale(age_s)
            await asyncio.sleep(PRESENCE_PERIOD_S)

    def _declare_stale(self, age_s: float) -> None:
        if not self._is_stale:
            self._is_stale = True
            self.log.warning("sensors stale", age_s=age_s)
        self._give(self.monitor.stale(self._seq, self._t_s), self._seq)

    def _on_lost(self, reason: str) -> None:
        self.log.warning("robot link lost", reason=reason)
        print(f"ccatp danger: robot link lost: {reason}", file=sys.stderr, flush=True)
        self.lost.set()

    def close(self) -> None:
        """Close the sockets."""
        self._subscriber.close()
        self._publisher.close()


async def run(args: ProcessArgs) -> int:
    """The process, from its arguments to its exit status."""
    stop = asyncio.Event()
    stop_on_signals(stop)
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    loop: DangerLoop | None = None
    status = 0
    try:
        loop = DangerLoop(args, context)
        await loop.run(stop)
    except* CcatpError as group:
        status = report("danger", group)
    finally:
        if loop is not None:
            loop.close()
        context.destroy(linger=0)
    return status or (0 if stop.is_set() else 4)


def main() -> int:
    """Entry of ``python -m ccatp.processes.danger_loop``."""
    die_with_parent()
    args = parse_args()
    if not args.is_realtime:
        spinning.leave_a_core(os.getppid())
    return spinning.run(run(args), is_spinning=not args.is_realtime)


if __name__ == "__main__":
    raise SystemExit(main())
