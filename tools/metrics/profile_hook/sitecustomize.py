"""Samples where each process of a run spends its CPU time; Python imports this module from PYTHONPATH.

CCATP_PROFILE names the folder that takes the samples of the processes, CCATP_FRAME_PACKAGE the folder of the package. A
timer of CPU time interrupts the main thread: unlike a tracing profiler it costs a call no more than it takes. Each
sample weighs the CPU time of the main thread since the one before, so that they add up to it.
"""

import atexit
import json
import os
import signal
import sys
import time
from collections import defaultdict
from pathlib import Path
from types import FrameType

_PERIOD_S = 0.001  # the kernel may round it up to its own tick
# The outermost functions of serving: ``asyncio.Runner.run``, whatever the event loop, and that of the supervisor. A
# process that serves a connection has begun with the first data of it; what was before is the start.
_LOOPS = ("run", "runners.py"), ("_watch", "supervisor.py")
_FIRST = "data_received"


class _Samples:
    """CPU time of the main thread by (function of the package, innermost function), s."""

    def __init__(self, package: str, path: Path) -> None:
        self._package, self._path = package, path
        self._times_s: defaultdict[tuple[str, str], float] = defaultdict(float)
        self._thread_s = time.thread_time()
        self._others_s = time.process_time() - self._thread_s
        self._has_begun = False

    def __call__(self, _number: int, frame: FrameType | None) -> None:
        now_s = time.thread_time()
        spent_s, self._thread_s = now_s - self._thread_s, now_s
        inner = own = ""
        while frame is not None:
            code = frame.f_code
            inner = inner or _name(code.co_filename, code.co_name)
            if not own and code.co_filename.startswith(self._package):
                own = _name(code.co_filename, code.co_name)
            if code.co_name == _FIRST and not self._has_begun:
                self._has_begun = True
                self._times_s.clear()
            if (code.co_name, Path(code.co_filename).name) in _LOOPS:
                self._times_s[own or "the event loop", inner] += spent_s
                return
            frame = frame.f_back

    def write(self) -> None:
        """Write name of the process, CPU time of its other threads, s, and rows of function, innermost function, s."""
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        words = [word for word in sys.orig_argv if word.startswith("ccatp")]
        others_s = time.process_time() - time.thread_time() - self._others_s
        rows = [[*names, time_s] for names, time_s in self._times_s.items()]
        self._path.write_text(json.dumps([words[0] if words else "", others_s, rows]), encoding="utf-8")


def _name(path: str, function: str) -> str:
    return f"{Path(path).name}:{function}"


def _begin() -> None:
    folder = os.environ.get("CCATP_PROFILE")
    if folder is None:
        return
    samples = _Samples(os.environ["CCATP_FRAME_PACKAGE"], Path(folder) / f"{os.getpid()}.json")
    atexit.register(samples.write)
    signal.signal(signal.SIGPROF, samples)
    signal.siginterrupt(signal.SIGPROF, False)
    signal.setitimer(signal.ITIMER_PROF, _PERIOD_S, _PERIOD_S)


_begin()
