"""What the drivers of the serial devices share: opening with patience, and naming what answers instead."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from math import inf

from ccatp.beacons.onboard.recognition import QUESTIONS, recognize
from ccatp.onboard.devices.serial_line import OpenPort, SerialLine
from ccatp.onboard.hardware import HardwareError

Clock = Callable[[], float]
Sleep = Callable[[float], object]

ANSWER_S = 4.0  # without anything valid for so long the port is closed and opened again
_POLL_S = 0.005
_SEEN_BYTES = 512  # that are kept to recognize another device


class SerialDevice(ABC):
    """A device on a serial line. ``poll`` never waits; after a disconnection it opens the port and begins again.

    Attributes:
        identity: what it says of itself; empty before.
    """

    title: str  # in messages
    key: str  # section of the configuration

    def __init__(self, device: str, baud: int, open_port: OpenPort) -> None:
        self._line = SerialLine(device, baud, open_port)
        self._seen = b""
        self._asks_s = inf  # when any known device is asked to show itself
        self.identity = ""

    @abstractmethod
    def _begin(self, now_s: float) -> None:
        """The port was opened: start the device. Raises OSError."""

    @abstractmethod
    def _receive(self, data: bytes, now_s: float) -> None:
        """Take received bytes, and act in time. Raises OSError or HardwareError."""

    @property
    @abstractmethod
    def is_ready(self) -> bool:
        """Whether it works as required."""

    def open(self, clock: Clock, sleep: Sleep, patience_s: float) -> None:
        """Open the port and wait until the device is ready. Raises HardwareError."""
        until_s = clock() + patience_s
        while True:
            self.poll(clock())
            if self.is_ready:
                return
            if not self._line.is_open or clock() > until_s:
                break
            sleep(_POLL_S)
        reason = self.why()
        self.close()
        raise HardwareError(f"{self.title}: {reason}")

    def poll(self, now_s: float) -> None:
        """Read what has arrived, and act in time."""
        line = self._line
        try:
            if line.ensure_open(now_s):
                self._seen, self._asks_s = b"", now_s + 0.5 * ANSWER_S
                self._begin(now_s)
            if not line.is_open:
                return
            data = line.read()
            if data:
                self._seen = (self._seen + data)[-_SEEN_BYTES:]
            self._receive(data, now_s)
            if now_s - line.valid_s > ANSWER_S:
                raise HardwareError(self.why())
            if now_s >= self._asks_s and not self.is_ready and now_s - line.valid_s > 0.4 * ANSWER_S:
                self._asks_s = inf
                line.write(QUESTIONS)
        except OSError as error:
            self._lose(now_s, HardwareError(f"its port is gone: {error.strerror or error}"))
        except (ValueError, HardwareError) as error:
            self._lose(now_s, error)

    def _lose(self, now_s: float, error: ValueError | HardwareError) -> None:
        with suppress(OSError):
            self._stop()
        self._line.lose(now_s, error)

    @abstractmethod
    def _stop(self) -> None:
        """The port is about to be closed. Raises OSError."""

    def why(self) -> str:
        """The reason why it is not ready."""
        if not self._line.is_open:
            return self._line.reason
        if self._line.garbage and (other := recognize(self._seen)):
            return f"{other} answers on its port; exchange the ports, or correct {self.key}.device"
        if reason := self._line.garbage_reason(self.key):
            return reason
        return f"it does not answer; check its supply, {self.key}.device and {self.key}.baud"

    def close(self) -> None:
        """Release the port."""
        with suppress(OSError):
            self._stop()
        self._line.release()
