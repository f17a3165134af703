"""A scan: the dish turns from position to position, and each radio is asked at each; the robot stands meanwhile.

A scan counts as a whole: if the robot moves, the module restarts, or the dish has lost steps, there is no scan, and so
no bearing. Without a dish a scan is one request of each radio, and gives strengths without a direction.
"""

from collections import Counter
from enum import Enum, auto
from math import tau
from typing import NamedTuple

from ccatp.beacons.config.onboard_models import SCAN_LEVELS, DishConfig
from ccatp.beacons.links.messages import RadioSample, RadioScan
from ccatp.beacons.onboard.dish import Dish
from ccatp.beacons.onboard.xbee import Coordinator
from ccatp.onboard.devices.serial_device import Clock, Sleep
from ccatp.onboard.hardware import HardwareError

REOPEN_S = 2.0  # between two attempts to open the lines of the dish
_DIGITS = 6
_SILENT_POSITIONS = 5  # without any level, which are reported before the end of the scan
_FAILURES = {
    "lost": "requests without an answer",
    "failed": "requests not delivered",
    "mixed": "answers with another packet, or damaged bytes, behind them",
    "none": "answers without a possible strength",
}


class Phase(Enum):
    """What the scanner does."""

    HOMING = auto()
    READY = auto()
    TURNING = auto()
    SETTLING = auto()
    ASKING = auto()
    RETURNING = auto()


class ScanResult(NamedTuple):
    """A scan with a dish, or strengths without one."""

    scan: RadioScan | None
    radio: list[RadioSample]


class Scanner:
    """Call ``poll`` once in each step of the control loop.

    Attributes:
        fault: reason why no scan is possible now; empty if it is.
        silence: why the newest scan gave nothing, or has no level of some radios; empty if it has a level of each.
    """

    def __init__(
        self, config: DishConfig, coordinator: Coordinator, dish: Dish | None, clock: Clock, sleep: Sleep
    ) -> None:
        self._config, self._coordinator, self._dish = config, coordinator, dish
        self._clock, self._sleep = clock, sleep
        self._phase = Phase.READY if dish is None else Phase.HOMING
        self._levels: dict[str, list[float | None]] = {}
        self._left: list[str] = []  # radios that are not asked yet at this position
        self._at = self._resets = 0
        self._directions = 1 if dish is None else config.positions
        self._step_s = self._settled_s = self._reopen_s = 0.0
        self._result: ScanResult | None = None
        self.fault = self.silence = ""
        self._failures: Counter[str] = Counter()  # of requests before the scan

    @property
    def is_ready(self) -> bool:
        """Whether a scan can begin."""
        radio = self._coordinator
        return self._phase is Phase.READY and not self.fault and radio.is_ready and bool(radio.wanted)

    @property
    def is_scanning(self) -> bool:
        """Whether the robot must stand."""
        return self._phase in {Phase.TURNING, Phase.SETTLING, Phase.ASKING, Phase.RETURNING}

    # -- the dish as a device -----------------------------------------------------------------------------------------

    @property
    def identity(self) -> str:
        """Of the dish."""
        return "" if self._dish is None else self._dish.identity

    def open(self) -> None:
        """Open the lines of the dish and turn it straight ahead. Raises HardwareError."""
        if self._dish is None:
            return
        self._dish.open()
        self._begin_homing()
        while not self._dish.is_homed:
            self.poll(self._clock())
            if self.fault:
                raise HardwareError(self.fault)
            self._sleep(self._config.step_s)

    def close(self) -> None:
        """Release the lines of the dish."""
        if self._dish is not None:
            self._dish.close()

    # -- scans --------------------------------------------------------------------------------------------------------

    def begin(self) -> None:
        """Begin a scan of the radios that are known now."""
        self._levels = {name: [] for name in self._coordinator.wanted[: SCAN_LEVELS // self._directions]}
        self._failures = self._coordinator.counts.copy()
        self._at, self._resets, self._phase = 0, self._coordinator.resets, Phase.TURNING

    def interrupt(self, reason: str) -> None:
        """The scan gives nothing; the dish turns back."""
        if not self.is_scanning or not self._levels:
            return
        self.silence = f"the newest scan gave nothing: {reason}"
        self._levels = {}
        self._phase = Phase.READY if self._dish is None else Phase.RETURNING

    def take(self) -> ScanResult | None:
        """The scan that has ended since the last call."""
        result, self._result = self._result, None
        return result

    def _begin_homing(self) -> None:
        """The lines of the dish were opened, or its position is not known any more."""
        if self._dish is not None:
            self.interrupt("the dish has lost its position")
            self._dish.begin_homing()
            self._phase, self.fault = Phase.HOMING, ""

    def _reopen(self, now_s: float) -> None:
        """After a fault the lines are opened again, and the dish is homed. Raises HardwareError."""
        if self._dish is None or not self.fault or now_s < self._reopen_s:
            return
        self._reopen_s = now_s + REOPEN_S
        self._dish.close()
        self._dish.open()
        self._begin_homing()

    def poll(self, now_s: float) -> None:
        """Go on."""
        if self.is_scanning and self._levels:
            if self._coordinator.resets != self._resets:
                self.interrupt("the radio module restarted")
            elif not self._coordinator.is_ready:
                self.interrupt(f"radio: {self._coordinator.why()}")
        try:
            self._reopen(now_s)
            self._go_on(now_s)
        except HardwareError as error:
            self.interrupt(str(error))
            self._phase, self.fault = Phase.HOMING, str(error)

    def _go_on(self, now_s: float) -> None:
        config = self._config
        if self._phase is Phase.SETTLING:
            if now_s >= self._settled_s:
                self._left, self._phase = list(self._levels), Phase.ASKING
                self._ask_next(now_s)
        elif self._phase is Phase.ASKING:
            if (strength := self._coordinator.take()) is not None:
                self._levels[strength.name].append(strength.dbm)
                self._ask_next(now_s)
        elif self._dish is None:
            if self._phase is Phase.TURNING:
                self._phase, self._settled_s = Phase.SETTLING, now_s
        elif now_s >= self._step_s and not self.fault and self._dish.is_open:
            self._step_s = now_s + config.step_s
            self._move(self._dish, now_s)

    def _move(self, dish: Dish, now_s: float) -> None:
        """One step of the dish, if it has to turn. Raises HardwareError."""
        config = self._config
        if self._phase is Phase.HOMING and dish.home():
            self._phase = Phase.READY
        elif self._phase is Phase.TURNING:
            if dish.turn(self._at * config.steps_per_turn // config.positions):
                self._phase, self._settled_s = Phase.SETTLING, now_s + config.settle_s
        elif self._phase is Phase.RETURNING and dish.turn_back():
            if abs(dish.lost_steps) > config.tolerance_steps:
                self.interrupt(f"the dish has lost {abs(dish.lost_steps)} steps")
                self._begin_homing()
                return
            self._phase = Phase.READY
            if self._levels:
                self._finish(now_s)

    def _ask_next(self, now_s: float) -> None:
        if self._left:
            try:
                self._coordinator.ask(self._left.pop(0), now_s)
            except OSError as error:
                self.interrupt(f"radio: {error}")
            return
        self._at += 1
        if self._at == _SILENT_POSITIONS and not any(any(levels) for levels in self._levels.values()):
            self._note_silence()
        if self._at < self._directions:
            self._phase = Phase.TURNING
        elif self._dish is not None:
            self._phase = Phase.RETURNING
        else:
            self._phase = Phase.READY
            self._finish(now_s)

    def _note_silence(self) -> None:
        silent = [name for name in self._coordinator.wanted if not any(self._levels.get(name, ()))]
        failures = self._coordinator.counts - self._failures
        why = ", ".join(f"{count} {_FAILURES[name]}" for name, count in failures.items())
        self.silence = f"no level of {', '.join(silent)}: {why or 'too many radios for a frame'}" if silent else ""

    def _finish(self, now_s: float) -> None:
        """Radios that did not answer once, or turned out not to be measurable meanwhile, are left out."""
        received = {name: self._levels[name] for name in self._coordinator.wanted if any(self._levels.get(name, ()))}
        self._note_silence()
        t_s = round(now_s, _DIGITS)
        if self._dish is None:
            samples = [RadioSample(t_s, name, z, None) for name, (z,) in received.items() if z is not None]
            self._result = ScanResult(None, samples)
        elif received:
            self._result = ScanResult(RadioScan(t_s, tau / self._directions, received), [])
