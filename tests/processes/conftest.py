"""Real runs on real sockets: each has its own runtime directory and free ports."""

import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from ccatp.links.channels import format_request
from ccatp.links.rpc import RequestFailed, request

# The calibration drive takes as long as a panel: it is done only where it matters.
NO_CALIBRATION = ("--set", "mission.calibration_length_m=0")
FREE_PORTS = ("--set", "sim.robot.port=0", "--set", "sim.etalon.port=0", "--set", "dashboard.enabled=false")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Runs one after the other, beside all other tests: two lockstep runs at once would fight for the cores."""
    for item in items:
        if Path(__file__).parent in item.path.parents and item.get_closest_marker("xdist_group") is None:
            item.add_marker(pytest.mark.xdist_group("processes"))


class Run:
    """One ``ccatp run --sim`` in a process of its own.

    Args:
        run_dir: where it writes.
        runtime_dir: its unix sockets.
        args: further command line arguments.
    """

    free_ports: tuple[str, ...] = FREE_PORTS

    def __init__(self, run_dir: Path, runtime_dir: Path, *args: str) -> None:
        self.run_dir, self.runtime_dir = run_dir, runtime_dir
        command = [sys.executable, "-m", "ccatp", "run", "--sim", "--run-dir", str(run_dir)]
        command += ["--runtime-dir", str(runtime_dir), *self.free_ports, *args]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        self.stdout = self.stderr = ""

    def ask(self, cmd: str, channel: str = "control", **fields: object) -> dict[str, Any]:
        """Send one command and return the reply."""
        return request(f"ipc://{self.runtime_dir / channel}", format_request(cmd, **fields), timeout_s=10.0)

    def until(self, is_there: Callable[[dict[str, Any]], bool], timeout_s: float = 40.0) -> dict[str, Any]:
        """Poll the status until the condition holds."""
        deadline = time.monotonic() + timeout_s
        status: dict[str, Any] = {}
        while time.monotonic() < deadline:
            assert self.process.poll() is None, f"the run ended early:\n{self.wait()}\n{self.stderr}"
            if (self.runtime_dir / "control").exists():
                try:
                    status = self.ask("status")["status"]
                except RequestFailed:
                    continue
                if is_there(status):
                    return status
            time.sleep(0.01)
        raise AssertionError(f"not within {timeout_s} s; last status {status}")

    def wait(self, timeout_s: float = 90.0) -> int:
        """The exit status, when the run ends by itself."""
        self.stdout, self.stderr = self.process.communicate(timeout=timeout_s)
        return self.process.returncode

    @property
    def summary(self) -> dict[str, Any]:
        """The summary it wrote."""
        summary: dict[str, Any] = json.loads((self.run_dir / "summary.json").read_text())
        return summary

    @property
    def config_port(self) -> int:
        """The port on which the robot's stand-in listens."""
        from ccatp.config.load import load_config

        return load_config(self.run_dir / "config.toml").robot.port

    @property
    def etalon_port(self) -> int:
        """The port on which the laser system's stand-in listens."""
        from ccatp.config.load import load_config

        return load_config(self.run_dir / "config.toml").etalon.port

    def end(self) -> None:
        """End it, if it has not ended."""
        if self.process.poll() is None:
            self.process.terminate()
            try:
                self.process.communicate(timeout=15.0)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.communicate()


@pytest.fixture
def runtime_dir() -> Iterator[Path]:
    """A short path: unix sockets do not take a long one."""
    folder = Path(tempfile.mkdtemp(prefix="ccatp-"))
    yield folder
    shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture
def start(tmp_path: Path, runtime_dir: Path) -> Iterator[Callable[..., Run]]:
    """Starts runs and ends those that a failing test leaves behind."""
    runs: list[Run] = []

    def begin(*args: str, calibrates: bool = False) -> Run:
        quick = () if calibrates else NO_CALIBRATION
        run = Run(tmp_path / f"run{len(runs)}", runtime_dir, *quick, *args)
        runs.append(run)
        return run

    yield begin
    for run in runs:
        run.end()
