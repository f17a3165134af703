"""A device on a serial line, whatever it says there: opened again after it was lost, with growing waits."""

from collections.abc import Callable
from contextlib import suppress
from math import inf
from typing import Protocol

from ccatp.onboard.hardware import HardwareError

READ_BYTES = 4096
RETRY_S, LONGEST_RETRY_S = 0.1, 2.0  # between two attempts to open the port
GARBAGE_BYTES = 64  # so many bytes without anything valid are reported as a wrong baud rate


class SerialPort(Protocol):
    """A serial port that never waits. Its methods raise OSError if the device is gone."""

    def read(self, size: int, /) -> bytes:
        """The received bytes, at most ``size``."""

    def write(self, data: bytes, /) -> object:
        """Send."""

    def reset_output_buffer(self) -> None:
        """Discard the unsent bytes."""

    def close(self) -> None:
        """Release it."""


OpenPort = Callable[[str, int, str], SerialPort]  # device file, baud rate, section of the configuration


class SerialLine:
    """The port of one device.

    Attributes:
        reason: why it is closed.
        valid_s: when something valid was received, or the port was opened.
        garbage: bytes since then.
    """

    def __init__(self, device: str, baud: int, open_port: OpenPort, key: str) -> None:
        self._device, self._baud, self._open_port, self._key = device, baud, open_port, key
        self._port: SerialPort | None = None
        self._retry_s, self._wait_s = -inf, RETRY_S
        self.reason = ""
        self.valid_s = -inf
        self.garbage = 0

    @property
    def is_open(self) -> bool:
        """Whether the port is open."""
        return self._port is not None

    def ensure_open(self, now_s: float) -> bool:
        """Open the port if it is closed and an attempt is due; true if it was opened now.

        Raises OSError, ValueError or HardwareError.
        """
        if self._port is not None or now_s < self._retry_s:
            return False
        self._port = self._open_port(self._device, self._baud, self._key)
        self.accept(now_s)
        return True

    def read(self) -> bytes:
        """The received bytes; they count as garbage until ``accept``. Raises OSError."""
        data = b"" if self._port is None else self._port.read(READ_BYTES)
        self.garbage += len(data)
        return data

    def write(self, data: bytes) -> None:
        """Send. Raises OSError."""
        if self._port is None:
            raise OSError("the port is closed")
        self._port.write(data)

    def accept(self, now_s: float) -> None:
        """Something valid was received."""
        self.garbage, self.valid_s = 0, now_s

    def recover(self) -> None:
        """The device works: the next loss is followed by a short wait."""
        self._wait_s = RETRY_S

    def lose(self, now_s: float, error: OSError | ValueError | HardwareError) -> None:
        """Close the port after an error, and open it again after a wait."""
        self.release()
        self.reason, self._retry_s = str(error), now_s + self._wait_s
        self._wait_s = min(2.0 * self._wait_s, LONGEST_RETRY_S)

    def release(self) -> None:
        """Close the port."""
        port, self._port = self._port, None
        if port is not None:
            # Closing would wait 30 s for unsent bytes. A device that is gone gives termios.error, which is no OSError.
            with suppress(Exception):
                port.reset_output_buffer()
            with suppress(OSError):
                port.close()

    def garbage_reason(self) -> str:
        """That the bytes make no sense; empty while they are few."""
        return f"garbage at {self._baud} baud; check {self._key}.baud" if self.garbage >= GARBAGE_BYTES else ""
