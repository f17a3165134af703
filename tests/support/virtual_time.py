"""An event loop on whose clock nothing waits."""

import asyncio
import selectors
from collections.abc import Coroutine
from typing import Any, TypeVar

T = TypeVar("T")
# What lies in a socket of this machine is there after this wall time.
SOCKET_S = 0.002


class VirtualSelector(selectors.DefaultSelector):
    """Waits for sockets, if there are any, a moment, for anything else by moving the clock on."""

    now_s = 0.0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        found = super().select(0)
        if found or timeout == 0:
            return found
        has_sockets = len(self.get_map()) > 1  # one is the loop's own
        found = super().select((SOCKET_S if has_sockets else 0) if timeout is not None else None)
        if not found and timeout is not None:
            self.now_s += timeout
        return found


class VirtualLoop(asyncio.SelectorEventLoop):
    """Its time is virtual."""

    def __init__(self) -> None:
        self.virtual = VirtualSelector()
        super().__init__(self.virtual)

    def time(self) -> float:
        return self.virtual.now_s


def run_virtual(work: Coroutine[Any, Any, T]) -> tuple[T, float]:
    """The result of a coroutine, and the virtual time it took, s."""
    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        result = runner.run(work)
        return result, runner.get_loop().time()
