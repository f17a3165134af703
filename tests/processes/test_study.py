"""Campaigns as processes: killed, interrupted, without room, on a cluster."""

import json
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from tests.support.runs import until

# Half a second of work a job, and no mission behind it.
STUDY = ("danger", "--mirror", "thesis-m1", "--only", "crossing=0", "--no-figures")
PATIENCE_S = 120.0


COMMAND = [sys.executable, "-m", "ccatp", "study", *STUDY]


def finished(*args: str, runs: int = 2, **options: Any) -> subprocess.CompletedProcess[str]:
    line = [*COMMAND, "--runs", str(runs), *args]
    return subprocess.run(line, capture_output=True, text=True, timeout=PATIENCE_S, check=False, **options)


@pytest.fixture
def started() -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Starts processes and ends those that a failing test leaves behind."""
    processes: list[subprocess.Popen[str]] = []

    def start(line: list[str]) -> subprocess.Popen[str]:
        # In a session of its own: a signal to it reaches its workers, too, as Ctrl-C in a terminal does.
        process = subprocess.Popen(
            line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
        )
        processes.append(process)
        return process

    yield start
    for process in processes:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def lines_of(out: Path) -> list[bytes]:
    path = out / "jobs.jsonl"
    return path.read_bytes().splitlines(keepends=True) if path.exists() else []


def keys_of(out: Path) -> list[str]:
    return [json.loads(line)["key"] for line in lines_of(out)]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    """Cells of the campaign, done at one go in one process."""
    out = tmp_path_factory.mktemp("whole")
    run = finished("--workers", "1", "--out", str(out), "--json")
    assert run.returncode == 0, run.stderr
    cells: list[dict[str, Any]] = json.loads(run.stdout)["cells"]
    return cells


@pytest.mark.slow
def test_a_campaign_killed_at_any_instant_continues(
    started: Callable[..., subprocess.Popen[str]], whole: list[dict[str, Any]], tmp_path: Path
) -> None:
    run = started([*COMMAND, "--runs", "2", "--workers", "2", "--out", str(tmp_path)])
    until(lambda: len(lines_of(tmp_path)) >= 2)
    workers = psutil.Process(run.pid).children(recursive=True)
    run.kill()
    run.wait()
    _, alive = psutil.wait_procs(workers, timeout=10.0)
    assert not alive  # workers end with their parent
    done = keys_of(tmp_path)
    with (tmp_path / "jobs.jsonl").open("ab") as ledger:
        ledger.write(b'{"key": "torn')
    again = finished("--workers", "2", "--out", str(tmp_path), "--json")
    assert again.returncode == 0, again.stderr
    assert f"{8 - len(done)} jobs to do, {len(done)} done before" in again.stderr
    assert keys_of(tmp_path)[: len(done)] == done
    assert len(keys_of(tmp_path)) == 8
    # Nothing but the result there; the cells are those of a campaign that nobody killed, in one process.
    assert json.loads(again.stdout)["cells"] == whole


def test_ctrl_c_keeps_what_is_done(started: Callable[..., subprocess.Popen[str]], tmp_path: Path) -> None:
    run = started([*COMMAND, "--runs", "50", "--workers", "2", "--out", str(tmp_path)])
    until(lambda: bool(lines_of(tmp_path)))
    os.killpg(run.pid, signal.SIGINT)
    stdout, stderr = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 130
    assert stdout == ""
    assert stderr.splitlines()[-1] == (
        f"ccatp: interrupted; what is done is kept in {tmp_path}: the same command continues from there"
    )
    assert "Traceback" not in stderr
    assert keys_of(tmp_path)


@pytest.mark.slow
def test_a_full_disk_is_one_line(tmp_path: Path) -> None:
    def little_room() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (1500, 1500))

    run = finished("--workers", "1", "--out", str(tmp_path), runs=1, preexec_fn=little_room)
    assert run.returncode == 4
    assert run.stderr.splitlines()[-1].startswith(f"ccatp: {tmp_path}")
    assert "make room or choose another --out: what is done is kept" in run.stderr
    assert "Traceback" not in run.stderr
    room = finished("--workers", "1", "--out", str(tmp_path), runs=1)
    assert room.returncode == 0, room.stderr


@pytest.fixture
def cluster(started: Callable[..., subprocess.Popen[str]], tmp_path: Path) -> str:
    """A scheduler and a worker on the loopback; without work or each other they end by themselves."""
    file = tmp_path / "scheduler.json"
    python = [sys.executable, "-W", "ignore", "-m"]
    local = ["--host", "127.0.0.1", "--no-dashboard"]
    started([
        *python, "distributed.cli.dask_scheduler", *local, "--port", "0", "--scheduler-file", str(file),
        "--idle-timeout", "60s",
    ])  # fmt: skip
    until(lambda: file.exists() and file.read_text().endswith("}"))
    started([
        *python, "distributed.cli.dask_worker", "--scheduler-file", str(file), *local, "--nworkers", "1",
        "--nthreads", "1", "--no-nanny", "--death-timeout", "30", "--local-directory", str(tmp_path),
    ])  # fmt: skip
    address: str = json.loads(file.read_text())["address"]
    return address


@pytest.mark.slow
def test_a_cluster_gives_the_same_cells(cluster: str, whole: list[dict[str, Any]], tmp_path: Path) -> None:
    out = tmp_path / "out"
    run = finished("--cluster", cluster, "--out", str(out), "--json")
    assert run.returncode == 0, run.stderr
    assert json.loads(run.stdout)["cells"] == whole
    assert len(keys_of(out)) == 8
