"""Children that a run can do without."""

import os
import time
from pathlib import Path

import pytest

from ccatp.config.models import Config
from ccatp.daemon.child_processes import ProcessManager, ProcessSpec

# Ends with the status in its variable, or waits for its end.
CODE = "import os, sys, time; status = int(os.environ['STATUS']); sys.exit(status) if status else time.sleep(60.0)"
SPEC = ProcessSpec("page", "ending_child", is_needed=False, niceness=7)


@pytest.fixture
def child(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "ending_child.py").write_text(CODE)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))


def run_until_told(children: ProcessManager, said: list[str], lines: int) -> object:
    """Look until so many lines were said, or an end."""
    deadline = time.monotonic() + 30.0
    while len(said) < lines and time.monotonic() < deadline:
        if (end := children.poll(time.monotonic())) is not None:
            return end
        time.sleep(0.01)
    return None


@pytest.mark.usefixtures("child")
def test_it_is_restarted_and_then_done_without(config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    monkeypatch.setenv("STATUS", "1")
    children = ProcessManager(config.run, lambda _spec, _is_restarted: ([], ()), lambda _level, text: said.append(text))
    children.start(SPEC)
    assert run_until_told(children, said, config.run.restart_limit + 1) is None
    assert said[0] == "process page ended with status 1: restarting it, the survey goes on"
    assert said[-1].endswith("more than 3 times within 60 s: the survey goes on without it")
    assert children.fds == []
    assert children.poll(time.monotonic()) is None
    assert not children.is_recovering(time.monotonic())  # nobody waits for it
    children.stop_all()


@pytest.mark.usefixtures("child")
def test_what_it_would_say_again_is_not_tried_again(config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    monkeypatch.setenv("STATUS", "2")
    children = ProcessManager(config.run, lambda _spec, _is_restarted: ([], ()), lambda _level, text: said.append(text))
    children.start(SPEC)
    assert run_until_told(children, said, 1) is None
    assert said == ["process page ended with status 2: the survey goes on without it"]
    assert children.restarts == 0


@pytest.mark.usefixtures("child")
def test_it_is_nicer_than_its_parent_from_the_start(config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STATUS", "0")
    children = ProcessManager(config.run, lambda _spec, _is_restarted: ([], ()), lambda _level, _text: None)
    children.start(SPEC)
    (found,) = children._children.values()
    own = os.getpriority(os.PRIO_PROCESS, 0)
    assert os.getpriority(os.PRIO_PROCESS, found.process.pid) == min(own + 7, 19)
    children.kill_all()


@pytest.mark.usefixtures("child")
def test_the_last_to_be_stopped_has_its_time(config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    monkeypatch.setenv("STATUS", "0")
    monkeypatch.setattr("ccatp.daemon.child_processes.STOP_TIMEOUT_S", 0.0)  # others have used it up
    monkeypatch.setattr("ccatp.daemon.child_processes.LEAST_STOP_S", 30.0)
    children = ProcessManager(config.run, lambda _spec, _is_restarted: ([], ()), lambda _level, text: said.append(text))
    children.start(SPEC)
    children.stop_all()
    children.kill_all()
    assert said == []
