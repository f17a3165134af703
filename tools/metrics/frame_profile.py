"""``python -m tools.metrics.frame_profile [--panels N]``: where the CPU time of a lockstep frame goes, by process."""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

_CALLS_HOOK = Path(__file__).with_name("frame_hook")
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
        run_survey(root, python, _CALLS_HOOK, settings, ("--panels", "1"))
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


_ROOT = Path(__file__).resolve().parents[2]
_PROFILE_HOOK = Path(__file__).with_name("profile_hook")
_FRAME_HZ = 100.0


class ProcessProfile(NamedTuple):
    """CPU time of a lockstep frame in one process, us: main thread by (function, innermost function), other threads."""

    name: str
    rows: Counter[tuple[str, str]]
    others_us: float


def profile(root: Path, panels: int) -> list[ProcessProfile]:
    """Run a survey of ``root``; the processes, those that use most first."""
    with tempfile.TemporaryDirectory(prefix="ccatp-profile-") as folder:
        arguments = "--json", "--panels", str(panels)
        out = run_survey(root, Path(sys.executable), _PROFILE_HOOK, {"CCATP_PROFILE": folder}, arguments)
        frames = json.loads(out)["mission_time_s"] * _FRAME_HZ
        found = [json.loads(path.read_text()) for path in Path(folder).glob("*.json")]
    profiles = [
        ProcessProfile(
            name.removeprefix("ccatp").lstrip(".") or "supervisor",
            Counter({(own, inner): 1e6 * time_s / frames for own, inner, time_s in rows}),
            1e6 * others_s / frames,
        )
        for name, others_s, rows in found
        if rows
    ]
    return sorted(profiles, key=lambda one: one.rows.total(), reverse=True)


def print_profile(one: ProcessProfile, shown: int, *, is_by_file: bool) -> None:
    """The functions or files that take most, with what libraries do for them."""
    print(f"\n{one.name}: {one.rows.total():.0f} us a frame, other threads {one.others_us:.0f} us")
    times_us: Counter[str] = Counter()
    for (own, inner), us in one.rows.items():
        times_us[own.partition(":")[0] if is_by_file else own if inner == own else f"{own} -> {inner}"] += us
    ranked = times_us.most_common()
    for name, us in ranked[:shown]:
        print(f"{us:8.1f}  {name}")
    print(f"{sum(us for _, us in ranked[shown:]):8.1f}  {len(ranked[shown:])} others")


def main() -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(prog="python -m tools.metrics.frame_profile", description=__doc__)
    parser.add_argument("--panels", type=int, default=4)
    parser.add_argument("--files", action="store_true", help="by file, not by function")
    parser.add_argument("--shown", type=int, default=12, help="rows of each process")
    options = parser.parse_args()
    for one in profile(_ROOT, options.panels):
        print_profile(one, options.shown, is_by_file=options.files)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
