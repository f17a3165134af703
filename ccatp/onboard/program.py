"""The process of the on-board program: the link's server, the control loop, messages to the service manager.

One event loop does everything: at ``servo.loop_hz`` it runs the wheels, and after the step that completes a frame it
sends the frame. Only the inertial unit, whose bus may hang, is read in a thread of its own. If this process stops, it
no longer restarts the external timer, which then brakes the motors.
"""

import asyncio
import ctypes
import gc
import os
import signal
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import structlog

from ccatp.links import realtime
from ccatp.links.service_manager import take_from
from ccatp.onboard.controlled import ControlledRobot
from ccatp.onboard.kinds import RobotHardware
from ccatp.onboard.server import TcpRobotServer

PRIORITY = 40  # of SCHED_FIFO, where permitted: below the kernel's own interrupt threads (50)
_BIN_S, _BINS = 1e-5, 10_000
_WATCHDOG_SHARE = 0.25  # interval of the watchdog messages / watchdog's period
_REPORT_S = 10.0  # least time between two log lines of an intermittent fault

_CLOCK_MONOTONIC, _CLOEXEC, _NONBLOCK = 1, os.O_CLOEXEC, os.O_NONBLOCK


class _Spec(ctypes.Structure):
    """``struct itimerspec``: interval and first expiry, s and ns."""

    _fields_ = [(name, ctypes.c_long) for name in ("interval_s", "interval_ns", "first_s", "first_ns")]


class PeriodicTimer:
    """Calls ``call`` in the event loop every ``period_s`` until ``close``; several missed periods give one call.

    It is a kernel timer with a file descriptor, because the event loop's timers have a resolution of a millisecond.
    """

    def __init__(self, period_s: float, call: Callable[[], None]) -> None:
        libc = ctypes.CDLL(None, use_errno=True)
        self._fd = libc.timerfd_create(_CLOCK_MONOTONIC, _CLOEXEC | _NONBLOCK)
        whole_s, part_s = divmod(period_s, 1.0)
        spec = _Spec(int(whole_s), round(part_s * 1e9), int(whole_s), round(part_s * 1e9))
        if self._fd < 0 or libc.timerfd_settime(self._fd, 0, ctypes.byref(spec), None):
            raise OSError(ctypes.get_errno(), f"no timer of {period_s:g} s: {os.strerror(ctypes.get_errno())}")
        self._loop, self._call = asyncio.get_running_loop(), call
        self._loop.add_reader(self._fd, self._on_expiry)

    def _on_expiry(self) -> None:
        os.read(self._fd, 8)
        self._call()

    def close(self) -> None:
        """Stop the calls."""
        if self._fd >= 0:
            self._loop.remove_reader(self._fd)
            os.close(self._fd)
            self._fd = -1


@dataclass
class Lateness:
    """Histogram, of bounded size, of the delay of each step of a loop: time since the last step minus the period."""

    counts: list[int] = field(default_factory=lambda: [0] * _BINS)
    steps: int = 0
    largest_s: float = 0.0

    def add(self, late_s: float) -> None:
        """Count a step."""
        self.steps += 1
        self.counts[min(max(int(late_s / _BIN_S), 0), _BINS - 1)] += 1
        self.largest_s = max(self.largest_s, late_s)

    def percentile_s(self, share: float) -> float:
        """The delay that this share of the steps did not exceed, to within a bin."""
        left = share * self.steps
        for k, count in enumerate(self.counts):
            left -= count
            if left <= 0.0:
                return (k + 1) * _BIN_S
        return self.largest_s


class OnboardServer(TcpRobotServer):
    """The server of the robot link on the robot. Its clock is the computer's ``monotonic`` clock since ``boot_s``.

    Attributes:
        lateness: of the control loop.
        each_step: called after each step, with the robot and the time.
    """

    robot: ControlledRobot

    def __init__(
        self,
        robot: ControlledRobot,
        boot_s: float,
        *,
        key: bytes | None = None,
        log: structlog.typing.FilteringBoundLogger,
    ) -> None:
        super().__init__(robot, lockstep=False, key=key, log=log)
        self._step_s, self._device_log = 1.0 / robot.loop_hz, log
        self._periodic: PeriodicTimer | None = None
        self._started_s, self._clock_s = boot_s, 0.0
        self.lateness = Lateness()
        self._reported: dict[str, float] = {}
        self._faults: frozenset[str] = frozenset()
        self.each_step: list[Callable[[ControlledRobot, float], None]] = []

    def begin(self, now_s: float) -> None:
        """Start the server; the robot's clock counts from ``boot_s``, since samples have that time."""
        super().begin(self._started_s)
        self._clock_s = now_s

    def _start_timer(self) -> None:
        self._periodic = PeriodicTimer(self._step_s, self._on_step)

    def _stop_timer(self) -> None:
        if self._periodic is not None:
            self._periodic.close()

    def _on_step(self) -> None:
        try:
            self.step(asyncio.get_running_loop().time())
        except Exception as error:
            self._stop_timer()
            self.fail(error)

    def step(self, now_s: float) -> None:
        """Run the wheels, and send the frame if it is due."""
        robot = self.robot
        self.lateness.add(now_s - self._clock_s - self._step_s)
        self._clock_s = now_s
        robot.control(now_s - self._boot_s)
        if robot.faults.keys() != self._faults:
            self._report(now_s)
        if now_s + 0.5 * self._step_s >= self.next_frame_s:
            self.tick(now_s)
        for call in self.each_step:
            call(robot, now_s)

    def _skip_stop(self, now_s: float) -> float:
        # Samples and frames have the same clock, which continues while the process is stopped.
        return now_s - self.next_frame_s

    def _advance_robot(self) -> None:
        self.robot.advance_to(self._frame_wall_s - self._boot_s)

    def _report(self, now_s: float) -> None:
        faults, self._faults = self.robot.faults, frozenset(self.robot.faults)
        for name, why in faults.items():
            if now_s - self._reported.get(name, -_REPORT_S) >= _REPORT_S:
                self._reported[name] = now_s
                self._device_log.warning("device_failed", device=name, why=why)


async def serve(
    robot: ControlledRobot,
    listener: socket.socket,
    stop: asyncio.Event,
    key: bytes | None,
    log: structlog.typing.FilteringBoundLogger,
    boot_s: float,
    *each_step: Callable[[ControlledRobot, float], None],
) -> None:
    """Run the robot on started hardware until ``stop`` is set; call ``each_step`` after each step of the loop."""
    notifier, watchdog_s = take_from(os.environ)
    server = OnboardServer(robot, boot_s, key=key, log=log)
    server.each_step += each_step
    if watchdog_s is not None:
        period_s, sent_s = _WATCHDOG_SHARE * watchdog_s, [0.0]

        def stroke(_: ControlledRobot, now_s: float) -> None:
            # Sent from the control loop, so that the messages end when this loop hangs.
            if now_s - sent_s[0] >= period_s:
                sent_s[0] = now_s
                notifier.send("WATCHDOG=1")

        server.each_step.append(stroke)
    # The collector does not scan frozen objects, so that a collection delays a step less.
    gc.collect()
    gc.freeze()
    port = await server.start(listener)
    notifier.send("READY=1", f"STATUS=robot link at port {port}")
    try:
        await server.run(stop)
    finally:
        notifier.send("STOPPING=1")
        late = server.lateness
        log.info(
            "control_loop",
            steps=late.steps,
            late_us_p50=round(1e6 * late.percentile_s(0.5)),
            late_us_p99=round(1e6 * late.percentile_s(0.99)),
            late_us_max=round(1e6 * late.largest_s),
            missed_timer=robot.late_steps,
            dropped_samples=robot.dropped_samples,
        )


def run(
    make_hardware: Callable[[Callable[[], float]], RobotHardware],
    make_robot: Callable[[RobotHardware], ControlledRobot],
    listener: socket.socket,
    key: bytes | None,
    log: structlog.typing.FilteringBoundLogger,
) -> int:
    """Run until SIGTERM, SIGINT or SIGHUP. Raises ``HardwareError``.

    ``make_hardware`` gets the robot's clock, ``make_robot`` the started hardware.
    """
    loop = asyncio.new_event_loop()
    boot_s = time.monotonic()
    hardware = make_hardware(lambda: time.monotonic() - boot_s)
    try:
        hardware.start()
        realtime.enter(PRIORITY, log)
        stop = asyncio.Event()
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            loop.add_signal_handler(number, stop.set)
        loop.run_until_complete(serve(make_robot(hardware), listener, stop, key, log, boot_s))
    finally:
        hardware.close()
        loop.close()
    return 0
