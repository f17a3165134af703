"""Calls and files per sensors frame in the main loop, counted by ``sys.setprofile`` during a simulated survey."""

import json
import os
import statistics
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

_HOOK = Path(__file__).with_name("frame_hook")
MAIN_LOOP = r"\bmain_loop\b"
_LEAST_FRAMES = 1000
_LOG_LINES = 10
_PORTS = ("sim.robot", "sim.etalon", "dashboard")  # others may run on this machine


class MeasurementError(Exception):
    """The calls could not be counted; says why."""


class FrameCalls(NamedTuple):
    """Medians over the frames of a run, most of which drive steadily.

    ``calls``, ``files``: from the bytes of the frame to its drive command; ``all_calls``, ``all_files``: until the next
    frame, with everything that the event loop does meanwhile.
    """

    frames: int
    calls: int
    files: int
    all_calls: int
    all_files: int


def measure(root: Path, python: Path, process: str = MAIN_LOOP) -> FrameCalls:
    """Run ``ccatp run --sim --panels 1`` of the checkout ``root``.

    Args:
        python: interpreter of an environment with the dependencies of that checkout.
        process: regular expression for the command line of the process to be measured.

    Raises:
        MeasurementError: the run failed, or no process matched.
    """
    with tempfile.TemporaryDirectory(prefix="ccatp-metrics-") as counts:
        settings = {"CCATP_FRAME_CALLS": counts, "CCATP_FRAME_PROCESS": process}
        run_survey(root, python, _HOOK, settings, ("--panels", "1"))
        rows = [row for file in Path(counts).iterdir() for row in json.loads(file.read_text())]
    if len(rows) < _LEAST_FRAMES:
        raise MeasurementError(
            f"{len(rows)} frames in processes that match {process!r}; expected {_LEAST_FRAMES} or more"
        )
    return FrameCalls(len(rows), *(round(statistics.median(column)) for column in zip(*rows, strict=True)))


def run_survey(root: Path, python: Path, hook: Path, settings: Mapping[str, str], arguments: Sequence[str]) -> str:
    """Standard output of ``ccatp run --sim`` of the checkout ``root``, whose processes all import a hook.

    ``hook`` is the folder of the hook's ``sitecustomize``, ``settings`` what it finds in the environment.
    """
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join((str(hook), str(root))),
        "CCATP_FRAME_PACKAGE": f"{root / 'ccatp'}{os.sep}",
        **settings,
    }
    with tempfile.TemporaryDirectory(prefix="ccatp-metrics-") as folder:
        command = [str(python), "-m", "ccatp", "run", "--sim", *arguments]
        command += ["--run-dir", f"{folder}/run", "--runtime-dir", f"{folder}/sockets"]
        command += [word for place in _PORTS for word in ("--set", f"{place}.port=0")]
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        tail = "\n".join(done.stderr.splitlines()[-_LOG_LINES:])
        raise MeasurementError(f"{' '.join(command)} ended with {done.returncode}:\n{tail}")
    return done.stdout
