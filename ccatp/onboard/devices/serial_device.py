"""What the drivers of all serial devices share: opening with patience, opening again after a loss, and the reason."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress

from ccatp.onboard.devices.serial_line import OpenPort, SerialLine
from ccatp.onboard.hardware import HardwareError

Clock = Callable[[], float]
Sleep = Callable[[float], object]

_POLL_S = 0.005
_SENT_BYTES = 32  # that the last commands have at most
_BITS = 10  # of a byte on the line


class SerialDevice(ABC):
    """A device on a serial line. ``poll`` never waits; after a disconnection it opens the port and begins again.

    Attributes:
        title: in messages.
        key: section of the configuration.
        answer_s: without anything valid for so long the port is closed and opened again.
        patience_s: longest time of ``open``.
    """

    title: str
    key: str
    answer_s: float
    patience_s: float

    def __init__(self, place: tuple[str, int], open_port: OpenPort, clock: Clock, sleep: Sleep) -> None:
        device, baud = place
        self._line = SerialLine(device, baud, open_port, self.key)
        self._clock, self._sleep = clock, sleep
        self._byte_s = _BITS / baud
        self._identity = ""

    @property
    @abstractmethod
    def is_ready(self) -> bool:
        """Whether it works as required."""

    @property
    def identity(self) -> str:
        """What it says of itself; empty before."""
        return self._identity

    @abstractmethod
    def _begin(self, now_s: float) -> None:
        """The port was opened: start the device. Raises OSError."""

    @abstractmethod
    def _receive(self, data: bytes, now_s: float) -> None:
        """Take received bytes, and act in time. Raises OSError or HardwareError."""

    @abstractmethod
    def _stop(self) -> None:
        """The port, which is open, is about to be closed: send the last commands. Raises OSError."""

    def _silence(self) -> str:
        """The reason why it is not ready, with an open port."""
        return f"it does not answer; check its supply, {self.key}.device and {self.key}.baud"

    def open(self) -> None:
        """Open the port and wait until the device is ready. Raises HardwareError."""
        until_s = self._clock() + self.patience_s
        while True:
            self.poll(self._clock())
            if self.is_ready:
                return
            if not self._line.is_open or self._clock() > until_s:
                break
            self._sleep(_POLL_S)
        reason = self.why()
        self.close()
        raise HardwareError(f"{self.title}: {reason}")

    def poll(self, now_s: float) -> None:
        """Read what has arrived, and act in time."""
        line = self._line
        try:
            if line.ensure_open(now_s):
                self._begin(now_s)
            if not line.is_open:
                return
            self._receive(line.read(), now_s)
            if now_s - line.valid_s > self.answer_s:
                raise HardwareError(self.why())
        except OSError as error:
            self._lose(now_s, HardwareError(f"its port is gone: {error.strerror or error}"))
        except (ValueError, HardwareError) as error:
            self._lose(now_s, error)

    def _lose(self, now_s: float, error: ValueError | HardwareError) -> None:
        self._end()
        self._line.lose(now_s, error)

    def _end(self) -> None:
        if self._line.is_open:
            with suppress(OSError):
                self._stop()

    def why(self) -> str:
        """The reason why it is not ready."""
        if not self._line.is_open:
            return self._line.reason
        return self._line.garbage_reason() or self._silence()

    def close(self) -> None:
        """Stop the device and release the port."""
        if self._line.is_open:
            self._end()
            self._sleep(_SENT_BYTES * self._byte_s)  # to release the port discards what is not sent yet
            self._line.release()
