"""Counts the calls of each sensors frame in one process of a run; Python imports this module from PYTHONPATH.

CCATP_FRAME_CALLS names the folder that takes the counts of the process, CCATP_FRAME_PACKAGE the folder of the counted
package, CCATP_FRAME_PROCESS a regular expression for its command line. The boundaries of a frame do not depend on names
of the package: asyncio calls ``data_received`` of the robot link when bytes arrive. A process may be a fork of one that
has imported this, so that its command line, number and end are looked at when its first bytes arrive.
"""

import atexit
import json
import os
import re
import sys
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

_BOUNDARY = "data_received"


class _FrameCalls:
    """Calls within ``data_received``, and calls until it is called again."""

    def __init__(self, package: str, process: str, folder: Path) -> None:
        self._package, self._process, self._folder = package, process, folder
        self._is_counting = False
        self._is_ours: dict[CodeType, bool] = {}
        self._codes: list[CodeType] = []
        self._within: tuple[int, int] | None = None  # of the frame whose ``data_received`` has returned
        self._rows: list[tuple[int, int, int, int]] = []

    def __call__(self, frame: FrameType, event: str, _: Any) -> None:
        code = frame.f_code
        is_ours = self._is_ours.get(code)
        if is_ours is None:
            is_ours = self._is_ours[code] = code.co_filename.startswith(self._package)
        if not is_ours:
            return
        if event == "call":
            if code.co_name == _BOUNDARY:
                if not self._is_counting and not self._begins():
                    return
                self._end_frame()
            if self._is_counting:
                self._codes.append(code)
        elif event == "return" and code.co_name == _BOUNDARY:
            self._within = self._count()

    def _begins(self) -> bool:
        """Whether this process is to be counted, which it is from now on; another one is not watched any more."""
        words = Path("/proc/self/cmdline").read_bytes().replace(b"\0", b" ").decode()
        self._is_counting = re.search(self._process, words) is not None
        if self._is_counting:
            atexit.register(self.write)
        else:
            sys.setprofile(None)
        return self._is_counting

    def _count(self) -> tuple[int, int]:
        return len(self._codes), len({code.co_filename for code in self._codes})

    def _end_frame(self) -> None:
        if self._within is not None:
            self._rows.append((*self._within, *self._count()))
        self._codes, self._within = [], None

    def write(self) -> None:
        """Write one row per frame: calls and files within ``data_received``, calls and files in all."""
        sys.setprofile(None)
        (self._folder / f"{os.getpid()}.json").write_text(json.dumps(self._rows), encoding="ascii")


def _begin() -> None:
    folder = os.environ.get("CCATP_FRAME_CALLS")
    if folder is not None:
        package, process = os.environ["CCATP_FRAME_PACKAGE"], os.environ["CCATP_FRAME_PROCESS"]
        sys.setprofile(_FrameCalls(package, process, Path(folder)))


_begin()
