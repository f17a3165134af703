"""The process that draws the report of a run: it imports what draws while the robot drives, and draws at the end.

``ReportProcess`` is the supervisor's end of the socket between them.
"""

import gc
import json
import os
import signal
import socket
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from importlib import import_module
from pathlib import Path
from typing import Self

import structlog

from ccatp.daemon.supervision.fork_server import ChildProcess
from ccatp.daemon.supervision.process import STOP_SIGNALS, die_with_parent
from ccatp.errors import CcatpError

MODULE = "ccatp.daemon.operator.report_process"
# What draws the figures of a report; its own modules import it where they draw.
DRAWING = ("ccatp.report.run_page", "matplotlib.figure", "matplotlib.backends.backend_svg")
DRAW = b"draw"
ANSWER_BYTES = 65_536


class ReportProcess:
    """Draws the report of one run on request.

    ``start`` starts a module with arguments and descriptors. ``locks``: descriptors that it inherits; who comes next in
    the run directory waits for them.
    """

    def __init__(
        self,
        start: Callable[[str, Sequence[str], Sequence[int]], ChildProcess],
        run_dir: Path,
        locks: Sequence[int] = (),
    ) -> None:
        self._start, self._run_dir, self._locks = start, run_dir, locks
        self._process: ChildProcess | None = None
        self._channel: socket.socket | None = None

    def begin(self) -> socket.socket:
        """Start the process, which imports what it needs, unless it was started. Raises OSError."""
        if self._channel is None:
            ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            with theirs, ExitStack() as unless_started:
                unless_started.callback(ours.close)
                fd = theirs.fileno()
                self._process = self._start(MODULE, [str(self._run_dir), str(fd)], [fd, *self._locks])
                unless_started.pop_all()
            self._channel = ours
        return self._channel

    def write(self, log: structlog.typing.FilteringBoundLogger) -> str:
        """Write the report of the run, which has ended; returns where it is, or why there is none.

        A signal only ends the writing; the status of the run does not change.
        """
        stops: list[int] = []
        # No exception while the process starts: it would be lost.
        previous = {n: signal.signal(n, lambda number, _frame: stops.append(number)) for n in STOP_SIGNALS}
        try:
            channel = self.begin()
            for number in STOP_SIGNALS:
                signal.signal(number, signal.default_int_handler)
            if stops:
                return by_hand(self._run_dir)
            channel.send(DRAW)
            answer: Mapping[str, str] = json.loads(channel.recv(ANSWER_BYTES))
        except KeyboardInterrupt:
            return by_hand(self._run_dir)
        except (OSError, ValueError):
            answer = {"failed": "the process that draws it has died"}
        finally:
            for number, handler in previous.items():
                signal.signal(number, handler)
        if "failed" in answer:  # the survey has ended, and its record is on the disk
            log.error("report_failed", error=answer["failed"])
            return by_hand(self._run_dir)
        return answer.get("report") or f"none; {answer['refused']}"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._channel is not None:
            self._channel.close()
        if self._process is not None:
            self._process.kill()
            self._process.wait()


def by_hand(run_dir: Path) -> str:
    """Says that there is no report, and how to make it."""
    return f"none; make it with: ccatp report {run_dir}"


def written(run_dir: Path) -> dict[str, str]:
    """Write the report of a run: ``report`` is its path, or ``refused`` or ``failed`` says why there is none."""
    try:
        from ccatp.report.run_page import report_run  # noqa: PLC0415 - what fails here is an answer

        data, _ = report_run(run_dir)
    except CcatpError as error:
        return {"refused": str(error)}
    except Exception as error:
        return {"failed": f"{type(error).__name__}: {error}"}
    return {"report": str(data["report"])}


def main() -> int:
    """Entry of ``python -m ccatp.daemon.operator.report_process RUN_DIR DESCRIPTOR``."""
    die_with_parent()
    run_dir, channel = Path(sys.argv[1]), socket.socket(fileno=int(sys.argv[2]))
    if sys.platform == "linux":  # it must not interrupt the loops, but shall be ready when they end
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
    with suppress(Exception):  # the answer says what is missing
        for module in DRAWING:
            import_module(module)
        from ccatp.report.record import kind_of_run  # noqa: PLC0415

        if (part := kind_of_run(run_dir).report) is not None:
            part.get()
    gc.freeze()  # no collection need visit all this again
    with channel:
        if channel.recv(len(DRAW)) == DRAW:
            channel.send(json.dumps(written(run_dir)).encode())
    return 0


if __name__ == "__main__":
    sys.exit(main())
