"""A run recorded once, and copies of it that a test may spoil."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.pages import drawn, undrawn
from tests.support.recorded import record_surveyed

__all__ = ["drawn", "undrawn"]


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One panel in a hard world, complete; recorded once per session for all workers. Not to be written to."""
    return record_surveyed(tmp_path_factory)


@pytest.fixture
def run_dir(recorded: Path, tmp_path: Path) -> Path:
    """A copy."""
    return Path(shutil.copytree(recorded, tmp_path / "tonight"))


@pytest.fixture
def without(run_dir: Path) -> Callable[..., Path]:
    """The copy without some of its files."""

    def remove(*names: str) -> Path:
        for name in names:
            (run_dir / name).unlink()
        return run_dir

    return remove
