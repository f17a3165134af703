"""Samples where each process of a run spends its CPU time; Python imports this module from PYTHONPATH.

CCATP_PROFILE names the folder that takes the samples of the processes, CCATP_FRAME_PACKAGE the folder of the package. A
timer of CPU time interrupts the main thread: unlike a tracing profiler it costs a call no more than it takes. Each
sample weighs the CPU time of the main thread since the one before, so that they add up to it. A fork of a process
begins its own samples, because it inherits neither the timer nor the CPU time.
"""

import atexit
import json
import os
import signal
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

    def __init__(self, package: str, folder: Path) -> None:
        self._package, self._folder = package, folder
        self._times_s: defaultdict[tuple[str, str], float] = defaultdict(float)
        self.begin()

    def begin(self) -> None:
        """Take samples of this process from now on."""
        self._times_s.clear()
        self._thread_s = time.thread_time()
        self._others_s = time.process_time() - self._thread_s
        self._has_begun = False
        signal.signal(signal.SIGPROF, self)
        signal.siginterrupt(signal.SIGPROF, False)
        signal.setitimer(signal.ITIMER_PROF, _PERIOD_S, _PERIOD_S)

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
        line = Path("/proc/self/cmdline").read_text(encoding="utf-8", errors="replace")
        words = [word for word in line.split("\0") if word.startswith("ccatp")]
        others_s = time.process_time() - time.thread_time() - self._others_s
        rows = [[*names, time_s] for names, time_s in self._times_s.items()]
        path = self._folder / f"{os.getpid()}.json"
        path.write_text(json.dumps([words[0] if words else "", others_s, rows]), encoding="utf-8")


def _name(path: str, function: str) -> str:
    return f"{Path(path).name}:{function}"


def _begin() -> None:
    folder = os.environ.get("CCATP_PROFILE")
    if folder is None:
        return
    samples = _Samples(os.environ["CCATP_FRAME_PACKAGE"], Path(folder))
    atexit.register(samples.write)
    os.register_at_fork(after_in_child=samples.begin)


_begin()
