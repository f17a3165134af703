"""The emergency latch survives its process."""

from io import StringIO
from pathlib import Path
from uuid import UUID

import pytest
import structlog

from ccatp.daemon.danger_loop import FILE, RESERVE_BYTES, PersistentEmergencyLatch, active_ids

Log = structlog.typing.FilteringBoundLogger


@pytest.fixture
def told() -> StringIO:
    return StringIO()


@pytest.fixture
def log(told: StringIO) -> Log:
    logger: Log = structlog.wrap_logger(structlog.PrintLogger(told))
    return logger


@pytest.mark.fault("P2")
def test_an_emergency_is_there_after_a_restart_until_it_is_cleared(tmp_path: Path, log: Log) -> None:
    path = tmp_path / FILE
    latch = PersistentEmergencyLatch(path, log)
    assert not latch.is_latched
    assert latch.raise_emergency("fire", "a", "smoke") is None
    assert latch.raise_emergency("power", "b") is None
    assert latch.clear("b", at_base_or_held=True) is None
    again = PersistentEmergencyLatch(path, log)
    assert again.newest == latch.newest
    assert again.raised == 2
    assert active_ids(path) == ["a"]
    assert again.raise_emergency("power", "b") is None  # cleared is cleared
    assert again.newest == latch.newest
    assert again.clear("a", at_base_or_held=True) is None
    assert not PersistentEmergencyLatch(path, log).is_latched


@pytest.mark.parametrize("text", ["", "{", "[]", '{"active": [{"id": "a"}], "cleared": []}', '{"active": 3}'])
def test_a_file_that_cannot_be_read_counts_as_an_emergency(tmp_path: Path, log: Log, told: StringIO, text: str) -> None:
    (tmp_path / FILE).write_text(text)
    latch = PersistentEmergencyLatch(tmp_path / FILE, log)
    assert latch.is_latched
    newest = latch.newest
    assert newest is not None
    assert f"'ccatp clear {UUID(newest.id)}' ends it" in told.getvalue()
    again = PersistentEmergencyLatch(tmp_path / FILE, log)
    assert again.newest == newest  # the same after a restart
    assert again.clear(newest.id, at_base_or_held=True) is None
    assert not PersistentEmergencyLatch(tmp_path / FILE, log).is_latched


def no_room(*_: int) -> None:
    raise OSError(28, "No space left on device")


def test_a_disk_that_refuses_does_not_keep_an_emergency_from_being_latched(
    tmp_path: Path, log: Log, told: StringIO, monkeypatch: pytest.MonkeyPatch
) -> None:
    latch = PersistentEmergencyLatch(tmp_path / FILE, log)
    monkeypatch.setattr("os.fsync", no_room)
    assert latch.raise_emergency("fire", "a") is None
    assert latch.is_latched
    assert "emergencies_not_saved" in told.getvalue()


@pytest.mark.fault("P13")
def test_an_emergency_is_kept_on_a_full_disk(tmp_path: Path, log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    """The room for it was taken before; a full disk gives no more."""
    latch = PersistentEmergencyLatch(tmp_path / FILE, log)
    assert (tmp_path / f"{FILE}.new").stat().st_size == RESERVE_BYTES
    monkeypatch.setattr("os.posix_fallocate", no_room)
    assert latch.raise_emergency("earthquake", "a") is None
    assert PersistentEmergencyLatch(tmp_path / FILE, log).is_shaking
