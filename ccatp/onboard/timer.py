"""A periodic timer of the kernel as a file descriptor; the event loop's own timers are a millisecond coarse."""

import asyncio
import ctypes
import os
from collections.abc import Callable

_CLOCK_MONOTONIC, _CLOEXEC, _NONBLOCK = 1, os.O_CLOEXEC, os.O_NONBLOCK


class _Spec(ctypes.Structure):
    """``struct itimerspec``: interval and first expiry, s and ns."""

    _fields_ = [(name, ctypes.c_long) for name in ("interval_s", "interval_ns", "first_s", "first_ns")]


class PeriodicTimer:
    """Calls ``call`` in the event loop every ``period_s`` until ``close``; periods that were missed are one call."""

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
        """No more calls."""
        if self._fd >= 0:
            self._loop.remove_reader(self._fd)
            os.close(self._fd)
            self._fd = -1
