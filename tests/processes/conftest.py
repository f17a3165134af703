"""Real runs on real sockets; `tests.support.runs` starts them."""

import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.support.runs import NO_CALIBRATION, Run

Start = Callable[..., Run]
# Two queues of about the same length, for two of the workers: within a queue one run after the other.
SECOND = {"test_restarts", "test_replay", "test_study"}


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put each test into one of the queues."""
    here = f"{Path(__file__).parent}{os.sep}"
    for item in items:
        if str(item.path).startswith(here) and item.get_closest_marker("xdist_group") is None:
            # Who reads the recorded run waits for it: all of them in the queue that records it.
            is_second = item.path.stem in SECOND or "recorded_run" in getattr(item, "fixturenames", ())
            item.add_marker(pytest.mark.xdist_group("processes-2" if is_second else "processes-1"))


@pytest.fixture
def start(tmp_path: Path, runtime_dir: Path) -> Iterator[Start]:
    """Starts runs, without the calibration drive and in a directory of their own unless told otherwise; ends them."""
    with ExitStack() as stack:
        count = 0

        def begin(
            *args: str, calibrates: bool = False, run_dir: Path | None = None, sockets: Path = runtime_dir
        ) -> Run:
            nonlocal count
            count += 1
            quick = () if calibrates else NO_CALIBRATION
            return stack.enter_context(Run(run_dir or tmp_path / f"run{count}", sockets, *quick, *args))

        yield begin
