"""A Cricket mote in listener mode on a serial line: the pulses that it received, and its temperature."""

from math import inf

from ccatp.beacons.config.onboard_models import COLDEST_C, HOTTEST_C, ListenersConfig
from ccatp.beacons.links.cricket_lines import ASK_REPORT, LineReader, Senders
from ccatp.beacons.links.messages import MoteBurst
from ccatp.beacons.onboard.recognition import BeaconDevice
from ccatp.onboard.devices.serial_device import Clock, Sleep
from ccatp.onboard.devices.serial_line import OpenPort
from ccatp.onboard.hardware import HardwareError

ASK_S = 2.0  # of silence, after which the mote is asked for its report
REPORT_S = 60.0  # between two reports: they hold the temperature
_USELESS = 10  # damaged and repeated lines without one that is right, which are a fault
_DIGITS = 6


class CricketListener(BeaconDevice):
    """The mote. ``senders``: those of all listeners.

    Attributes:
        name: of the listener, in readings.
        reader: of the received bytes.
    """

    key = "devices.listeners"

    def __init__(
        self, name: str, config: ListenersConfig, senders: Senders, open_port: OpenPort, clock: Clock, sleep: Sleep
    ) -> None:
        super().__init__((config.devices[name], config.baud), open_port, clock, sleep)
        self._config, self._senders = config, senders
        self.name, self.title = name, f"listener {name}"
        self.reader = LineReader()
        self._bursts: list[MoteBurst] = []
        self._ask_s = self._report_s = 0.0
        self._heard_s = -inf
        self._useless_before = 0  # the newest pulse

    @property
    def is_ready(self) -> bool:
        """It has sent a line."""
        return self._line.is_open and (bool(self._identity) or self.reader.counts["pulses"] > 0)

    def take(self) -> list[MoteBurst]:
        """The pulses since the last call, oldest first."""
        bursts, self._bursts = self._bursts, []
        return bursts

    def fault(self, now_s: float) -> str:
        """The reason if it has sent nothing for ``timeout_s``, or nothing that is right; empty otherwise."""
        if self._line.is_open and now_s - self._heard_s <= self._config.timeout_s:
            if self._useless - self._useless_before >= _USELESS:
                return "its lines are damaged or repeated; check its output format (3) and its cable"
            if not self._is_temperature_possible:
                return f"its thermometer shows {self.reader.report.temperature_c:g} degrees; switch it off (P TP 0)"
            if twins := sorted(self._senders.twins):
                return f"several motes have the space id {', '.join(twins)}; give each another one (P SP)"
            return ""
        return self.why()

    @property
    def _useless(self) -> int:
        return self.reader.counts["garbled"] + self.reader.counts["duplicates"]

    @property
    def _is_temperature_possible(self) -> bool:
        temperature_c = self.reader.report.temperature_c
        return temperature_c is None or COLDEST_C <= temperature_c <= HOTTEST_C

    def _begin(self, now_s: float) -> None:
        super()._begin(now_s)
        self.reader, self._useless_before = LineReader(), 0
        self._identity = ""
        self._ask(now_s)

    def _ask(self, now_s: float) -> None:
        self._ask_s, self._report_s = now_s + ASK_S, now_s + REPORT_S
        self._line.write(ASK_REPORT)

    def _receive(self, data: bytes, now_s: float) -> None:
        super()._receive(data, now_s)
        reader = self.reader
        before = reader.counts["silent"] + reader.counts["reports"]
        pulses, report = reader.feed(data), reader.report
        if report.mode is not None and report.mode != "Listener":
            raise HardwareError(f"the mote is in {report.mode.lower()} mode; set it to listener mode (MD)")
        if report.unique_id is not None:
            self._identity = f"Cricket {report.unique_id} {report.space or ''}".strip()
            self._senders.listeners[report.unique_id] = self.name
        if pulses or reader.counts["silent"] + reader.counts["reports"] > before:
            self._heard_s = now_s
            self._useless_before = self._useless if pulses else self._useless_before
            self._line.accept(now_s)
            self._line.recover()
            self._ask_s = now_s + ASK_S
        temperature_c = report.temperature_c
        if temperature_c is None or not self._is_temperature_possible:
            temperature_c = self._config.temperature_c
        t_s = round(now_s, _DIGITS)
        for pulse in pulses:
            self._senders.count(pulse)
            if (sender := self._senders.name_of(pulse)) is not None:
                self._bursts.append(MoteBurst(t_s, sender, self.name, temperature_c, [pulse.delay_s]))
        if now_s >= min(self._ask_s, self._report_s):
            self._ask(now_s)

    def _stop(self) -> None:
        pass  # a mote goes on by itself
