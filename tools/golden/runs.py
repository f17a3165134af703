"""The golden cases, in names of the base (``renames.toml``), and how they are run.

The base runs in a copy and an environment of its own, this tree in its own. A step of a case is a command line of
``ccatp`` and what happens meanwhile. In its arguments ``{run}`` is the run directory of the case, ``{root}`` the source
tree, ``{data}`` the folder of recorded radio data, ``{here}`` this folder.
"""

import fcntl
import hashlib
import json
import os
import platform
import shutil
import subprocess
import sys
import tarfile
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

from tools.golden.comparison import Renames

_EMERGENCY_ID = "6f1c3c1e-5a0f-4d0e-9f2b-0c8f5b6a7d11"
_SETTLING_S = 3.0  # the recorder writes after a second at the latest; what is written survives the end by ``kill -9``
_REPLY_S = 10.0
_PAUSE_S = 1.0  # the reply comes when the robot is at rest, which takes frames: longer than it takes to be received


@dataclass(frozen=True)
class Action:
    """What happens before a frame: a request to a socket of the runtime directory, or the end by ``kill -9``."""

    frame: int
    socket: str = ""
    request: dict[str, Any] | None = None
    wait_s: float = _REPLY_S

    def resolved(self, runtime_dir: str) -> dict[str, Any]:
        """The action in the form that the hook reads."""
        if self.request is None:
            return {"frame": self.frame, "kill": _SETTLING_S}
        endpoint = f"ipc://{runtime_dir}/{self.socket}"
        return {"frame": self.frame, "endpoint": endpoint, "request": self.request, "wait_s": self.wait_s}


@dataclass(frozen=True)
class Step:
    """One command. ``is_run``: it has a run directory and a runtime directory of its own."""

    arguments: tuple[str, ...]
    actions: tuple[Action, ...] = ()
    is_run: bool = False


@dataclass(frozen=True)
class Case:
    """A name, the steps one after the other, and what is compared: everything, or the final results alone."""

    name: str
    steps: tuple[Step, ...]
    is_quick: bool = False
    only_results: bool = False
    needs_data: bool = False


def _survey(*arguments: str, actions: tuple[Action, ...] = ()) -> Step:
    ports = ("--set", "sim.robot.port=0", "--set", "sim.etalon.port=0", "--set", "dashboard.port=0")
    return Step(("run", "--sim", "--run-dir", "{run}", *ports, *arguments), actions, is_run=True)


def _beacons(system: str) -> Step:
    ports = ("--set", "sim.robot.port=0", "--set", "dashboard.port=0")
    config = f"{{root}}/configs/{system}.toml"
    return Step(("run", "--sim", "--run-dir", "{run}", "--config", config, *ports), is_run=True)


def _emergency(kind: str, frame: int) -> Action:
    return Action(frame, "emergency", {"cmd": "emergency", "kind": kind, "id": _EMERGENCY_ID, "note": "golden"})


def _clear(frame: int) -> Action:
    return Action(frame, "emergency", {"cmd": "clear", "id": _EMERGENCY_ID})


def _surveys() -> list[Case]:
    return [
        Case(f"survey-{mirror}-{world}", (_survey("--mirror", mirror, "--world", world, "--panels", "2"),))
        for mirror in ("fyst-m1", "fyst-m2", "thesis-m1", "thesis-m2")
        for world in ("thesis", "hard", "extreme")
    ]


def _emergencies() -> list[Case]:
    one = ("--panels", "1")
    cases = [
        Case(f"emergency-{kind}", (_survey(*one, actions=(_emergency(kind, 1200),)),), is_quick=kind == "fire")
        for kind in ("fire", "power", "weather", "operator")
    ]
    # Frames come at ten a second meanwhile: it is over after three seconds.
    shaking = (_emergency("earthquake", 1200), _clear(1230))
    return [*cases, Case("emergency-earthquake", (_survey(*one, actions=shaking),))]


def _radio() -> list[Case]:
    data = {
        "plaza": "{data}/plaza/Plaza2_.mat",
        "mrclam": "{data}/mrclam/set7",
        "labyrinth": "{data}/uwb_labyrinth/labyrinth_0_600s.txt.gz",
    }
    cases = [
        Case(
            f"radio-slam-{name}",
            tuple(Step(("radio", "slam", path, "--filter", kind, "--json")) for kind in ("ekf-slam", "smoother")),
            is_quick=name == "plaza",
            needs_data=True,
        )
        for name, path in data.items()
    ]
    ranges = ("radio", "map", "--ranges", "{data}/uwb_planar/session_8_14.csv", "--json")
    simulated = ("radio", "map", "--json")
    return [
        *cases,
        Case("radio-map-recorded", (Step(ranges), Step((*ranges, "--offset"))), is_quick=True, needs_data=True),
        Case("radio-map-simulated", (Step(simulated), Step((*simulated, "--method", "ekf"))), is_quick=True),
    ]


def _others() -> list[Case]:
    killed = _survey("--panels", "2", actions=(Action(6000),))
    recorded = (
        _survey("--mirror", "thesis-m2", "--world", "hard", "--panels", "1"),
        Step(("align", "{run}", "--json")),
        Step(("replay", "{run}", "--json")),
        Step(("replay", "{run}", "--filter", "ukf", "--json")),
    )
    operator = (
        Action(1000, "control", {"cmd": "pause"}, _PAUSE_S),
        Action(1030, "control", {"cmd": "resume"}),
        Action(3000, "control", {"cmd": "abort"}),
    )
    plans = tuple(
        Step(("plan", "--mirror", mirror, "--json")) for mirror in ("fyst-m1", "fyst-m2", "thesis-m1", "thesis-m2")
    )
    return [
        Case("align", recorded, is_quick=True),
        Case("resume", (killed, _survey("--panels", "2", "--resume")), only_results=True),
        Case("operator", (_survey("--panels", "1", actions=operator),)),
        Case("faults", (_survey("--panels", "1", "--faults", "{here}/fault_plan.toml"),)),
        *(Case(f"filter-{name}", (_survey("--panels", "1", "--filter", name),)) for name in ("kf", "ukf")),
        *(
            Case(f"beacons-{name}", (_beacons(name),), is_quick=name == "cricket")
            for name in ("zigbee", "follow", "cricket")
        ),
        Case("plan", plans),
    ]


CASES: tuple[Case, ...] = (*_surveys(), *_emergencies(), *_others(), *_radio())


HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
RESULTS = ROOT / "build" / "golden"
_HOOK = HERE / "wire_hook"
_TIMEOUT_S = 900.0
_DONE = "done.json"


class GoldenError(Exception):
    """The comparison could not be made; says why."""


@dataclass(frozen=True)
class Side:
    """A source tree with its interpreter, and the folder for what its cases leave behind."""

    name: str
    root: Path
    python: Path
    results: Path
    renames: Renames


def this_side(renames: Renames) -> Side:
    """The working tree, with the interpreter that runs this."""
    return Side("new", ROOT, Path(sys.executable), RESULTS / "new", renames)


def base_side(cache: Path, commit: str) -> Side:
    """The tree of a commit with an environment from its own lock file; both are made unless they are there.

    Raises:
        GoldenError: the commit is not there, or its environment cannot be made.
    """
    done = subprocess.run(
        ["git", "rev-parse", "--verify", "--quiet", f"{commit}^{{commit}}"],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    if done.returncode != 0:
        raise GoldenError(f"there is no commit {commit} here; name another one with --base, or fetch it")
    sha = done.stdout.strip()
    folder = cache / f"base-{sha[:12]}"
    root = folder / "tree"
    with locked(folder):
        if not root.exists():
            _extract(sha, root)
        _make_environment(root)
    return Side("base", root, root / ".venv" / "bin" / "python", folder / "results", Renames())


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """One process at a time uses the folder: several working trees may share a base."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    with folder.with_name(f"{folder.name}.lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _extract(sha: str, root: Path) -> None:
    archive = subprocess.run(["git", "archive", sha], cwd=ROOT, capture_output=True, check=True).stdout
    root.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=root.parent) as folder:
        with tarfile.open(fileobj=BytesIO(archive)) as tar:
            tar.extractall(f"{folder}/tree", filter="data")
        Path(f"{folder}/tree").rename(root)


def _make_environment(root: Path) -> None:
    """By the Makefile of that tree, with the Python that runs this."""
    python = f"PYTHON={Path(sys.base_prefix) / 'bin' / f'python{sys.version_info.major}.{sys.version_info.minor}'}"
    # What make told its own recipe is not for the one of another tree.
    environment = {key: value for key, value in os.environ.items() if not key.startswith("MAKE") and key != "MFLAGS"}
    command = ["make", "--silent", "VENV=.venv", python, ".venv/.installed"]
    done = subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise GoldenError(f"{root}: {' '.join(command)} failed:\n{done.stdout}{done.stderr}")


class Runner:
    """Runs cases, and stops all of them at once."""

    def __init__(self, data: Path, *, reuse_base: bool) -> None:
        """``data``: recorded radio data. ``reuse_base``: results of the base made on this machine are taken again."""
        self._data, self._reuse_base = data, reuse_base
        self._is_stopped = threading.Event()
        self._running: set[subprocess.Popen[bytes]] = set()
        self._lock = threading.Lock()

    def run(self, side: Side, case: Case) -> Path:
        """Run the case, unless it was; returns the folder with what it left.

        Raises:
            GoldenError: a step did not end in time.
        """
        folder = side.results / case.name
        key = _key_of(side, case)
        done = folder / _DONE
        if self._reuse_base and side.name == "base" and done.exists() and json.loads(done.read_text()) == key:
            return folder
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        # Names of sockets are at most 107 characters long, the folder's own name may be longer.
        with tempfile.TemporaryDirectory(prefix="ccatp-golden-") as sockets:
            for number, step in enumerate(case.steps):
                self._run_step(side, step, folder, number, sockets)
        done.write_text(json.dumps(key))
        return folder

    def stop(self) -> None:
        """End what is running; no step begins after this."""
        self._is_stopped.set()
        with self._lock:
            for process in self._running:
                process.terminate()

    def _run_step(self, side: Side, step: Step, folder: Path, number: int, sockets: str) -> None:
        places = {"run": folder / "run", "root": side.root, "data": self._data, "here": HERE}
        arguments = [argument.format(**places) for argument in side.renames.arguments(step.arguments)]
        if step.is_run:
            arguments += [*side.renames.arguments(["--runtime-dir"]), sockets]
        environment = {
            **{key: value for key, value in os.environ.items() if not key.startswith(("CCATP_", "PYTHON"))},
            "PYTHONPATH": os.pathsep.join((str(_HOOK), str(side.root))),
            "OPENBLAS_NUM_THREADS": "1",
            "CCATP_GOLDEN_DIR": str(folder),
            "CCATP_GOLDEN_ACTIONS": json.dumps([action.resolved(sockets) for action in step.actions]),
        }
        command = [str(side.python), "-m", "ccatp", *arguments]
        with (folder / f"out.{number}").open("wb") as out, (folder / f"err.{number}").open("wb") as err:
            with self._lock:
                if self._is_stopped.is_set():
                    raise GoldenError("stopped")
                process = subprocess.Popen(
                    command, cwd=folder, env=environment, stdin=subprocess.DEVNULL, stdout=out, stderr=err
                )
                self._running.add(process)
            try:
                status = process.wait(_TIMEOUT_S)
            except subprocess.TimeoutExpired as error:
                raise GoldenError(f"{folder}: {' '.join(command)} took more than {_TIMEOUT_S:g} s") from error
            finally:
                process.kill()  # the other processes of a run end with this one
                process.wait()
                self._running.discard(process)
        (folder / f"exit.{number}").write_text(str(status))
        for path in (folder / f"out.{number}", folder / f"err.{number}"):
            text = path.read_text(encoding="utf-8", errors="replace")
            path.write_text(text.replace(str(folder), "{folder}").replace(str(side.root), "{root}"))


def _key_of(side: Side, case: Case) -> dict[str, str]:
    """What results depend on, beside the commit that the folder is named after."""
    hook = b"".join(path.read_bytes() for path in (*sorted(_HOOK.glob("*.py")), HERE / "fault_plan.toml"))
    return {
        "case": repr(case),
        "hook": hashlib.sha256(hook).hexdigest(),
        "python": platform.python_version(),
        "cpu": _cpu(),
        "root": str(side.root),
    }


def _cpu() -> str:
    """The processor and its instruction sets: linear algebra rounds by them."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    wanted = {line.partition(":")[0].strip(): line for line in lines}
    return hashlib.sha256("".join(wanted.get(key, "") for key in ("model name", "flags")).encode()).hexdigest()
