"""Fixtures of all tests: nothing may outlive its test."""

import gc
import inspect
import signal
import socket
import tempfile
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import psutil
import pytest
from _pytest.nodeid import coerce_node_id
from hypothesis import settings

from ccatp.config.models import Config
from ccatp.mirror.mirror import Mirror
from tests.support.leaks import child_processes, command_of, no_new_tasks
from tests.support.runs import RecordedRun, record_once
from tests.support.scenario import config_of, mirror_of
from tests.support.temporary import session_folder

pytest_plugins = ["pytester", "tests.faults.linking"]

# A change is judged by the same examples each time; `make test-slow` looks for new ones.
settings.register_profile("repeatable", derandomize=True)
settings.register_profile("explore", derandomize=False, print_blob=True)
settings.load_profile("repeatable")

# A shell makes what it starts in the background deaf to Ctrl-C, and children inherit that; those under test must not.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Processes that end on their own after a test closed its side of them.
GRACE_S = 2.0


@pytest.hookimpl(wrapper=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> Iterator[None]:
    """Tests of a group, or of a file, to one worker, so that what a file sets up is set up once; the long groups first.

    xdist 3.8 writes the group where pytest 9.2 does not look for it any more.
    """
    yield
    if not getattr(config.option, "loadgroup", False):
        return
    for item in items:
        group = item.get_closest_marker("xdist_group")
        if "@" not in item.nodeid:
            item._id = coerce_node_id(f"{item.nodeid}@{group.args[0] if group else item.path.stem}")
    items.sort(key=lambda item: item.get_closest_marker("xdist_group") is None)


def pytest_collection_finish() -> None:
    """What is there now stays until the end: the garbage collector need not look at it again and again."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def own_folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Temporary files of this worker's tests and of their processes lie in one folder, which does not outlive them.

    A daemon or server that names no runtime directory shares it with these tests only.
    """
    tmp_path_factory.getbasetemp()  # stays where it is: it holds what failed tests leave to be looked at
    with session_folder(Path(tempfile.gettempdir())) as folder, pytest.MonkeyPatch.context() as patch:
        patch.setattr(tempfile, "tempdir", str(folder))
        patch.setenv("TMPDIR", str(folder))
        patch.setenv("CCATP_RUNTIME_DIR", str(folder / "run"))
        yield


@pytest.fixture(autouse=True)
def nothing_leaks(request: pytest.FixtureRequest) -> Iterator[None]:
    """Fail a test that leaves a child process or an asyncio task behind."""
    before = child_processes()
    if inspect.iscoroutinefunction(getattr(request.function, "__wrapped__", request.function)):
        request.getfixturevalue("no_task_leaks")
    yield
    if leaked := child_processes() - before:
        shown = ", ".join(command_of(child) for child in leaked)
        _, alive = psutil.wait_procs(leaked, timeout=GRACE_S)
        if alive:
            alive += [below for child in alive for below in child.children(recursive=True)]
            for child in alive:
                child.kill()
            psutil.wait_procs(alive, timeout=GRACE_S)
            pytest.fail(f"child processes left behind: {shown}")


@pytest.fixture
async def no_task_leaks() -> AsyncIterator[None]:
    """Fail when tasks are left in the event loop of the test. Set up for each asyncio test."""
    async with no_new_tasks():
        yield


@pytest.fixture
def runtime_dir() -> Iterator[Path]:
    """A short path: unix sockets do not take a long one."""
    with tempfile.TemporaryDirectory(prefix="ccatp-", ignore_cleanup_errors=True) as folder:
        yield Path(folder)


@pytest.fixture
def free_port() -> int:
    """A TCP port of 127.0.0.1 that was free a moment ago; prefer port 0 where the code under test tells its port."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
    return port


@pytest.fixture(scope="session")
def config() -> Config:
    """The default configuration (frozen, so one serves all)."""
    return config_of()


@pytest.fixture(scope="session")
def mirror() -> Mirror:
    """The default mirror."""
    return mirror_of()


@pytest.fixture(scope="session")
def recorded_run(tmp_path_factory: pytest.TempPathFactory) -> RecordedRun:
    """Two panels surveyed by the real processes, recorded once per session for all workers; only to read from."""
    return record_once(tmp_path_factory)
