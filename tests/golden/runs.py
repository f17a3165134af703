"""Runs golden cases in a source tree: the base in a copy and an environment of its own, this tree in its own."""

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

from tests.golden.cases import Case, Step
from tests.golden.comparison import Renames

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
