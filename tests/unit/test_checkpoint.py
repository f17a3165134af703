"""The checkpoint: whatever byte is wrong, one whole record remains; one of another version is refused."""

import zlib
from pathlib import Path

import msgspec
import pytest

from ccatp.records.checkpoint import CheckpointError, CheckpointFile, read_checkpoint

SLOT = 65536


class Place(msgspec.Struct, frozen=True, tag=2, forbid_unknown_fields=True):
    number: int
    x_m: float = 1.25
    note: str = "driving"


class NewerPlace(Place, frozen=True, tag=2, forbid_unknown_fields=True):
    y_m: float = -0.5


@pytest.mark.parametrize("is_patient", [True, False])
def test_the_newest_record_is_read_back(tmp_path: Path, is_patient: bool) -> None:
    path = tmp_path / "checkpoint"
    file = CheckpointFile(path, is_patient=is_patient)
    for count in range(1, 8):
        file.write(Place(count), is_durable=count % 3 == 0)
    file.close()
    assert read_checkpoint(path, Place) == Place(7)
    assert file.failure == ""
    again = CheckpointFile(path, is_patient=is_patient)
    again.write(Place(8))
    again.close()
    assert read_checkpoint(path, Place) == Place(8)


def test_nothing_there(tmp_path: Path) -> None:
    assert read_checkpoint(tmp_path / "none", Place) is None
    (tmp_path / "empty").touch()
    with pytest.raises(CheckpointError, match="empty: empty, so the robot's place is not known; set it at base"):
        read_checkpoint(tmp_path / "empty", Place)
    CheckpointFile(tmp_path / "new", is_patient=True).close()
    assert not (tmp_path / "new").exists()  # until it has a record


@pytest.mark.fault("P16")
def test_flipped_bits_and_cuts_leave_a_whole_record_or_none(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint"
    file = CheckpointFile(path, is_patient=True)
    file.write(Place(1))
    file.write(Place(2))
    file.close()
    whole = path.read_bytes()
    length = len(whole) - SLOT  # of either slot: length, checksum, count and record
    for offset in (*range(length), *range(SLOT, len(whole))):
        path.write_bytes(whole[:offset] + bytes([whole[offset] ^ 1 << offset % 8]) + whole[offset + 1 :])
        assert read_checkpoint(path, Place) == Place(1 if offset < length else 2)  # the other slot is untouched
    for cut in (*range(1, length), *range(length, SLOT, 997), *range(SLOT, len(whole))):
        path.write_bytes(whole[:cut])
        if cut < length:  # nobody knows where the robot is, and least of all is it at base
            with pytest.raises(CheckpointError, match="damaged"):
                read_checkpoint(path, Place)
        else:
            assert read_checkpoint(path, Place) == Place(2)


def test_a_record_longer_than_a_slot_takes_the_older_one_with_it(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint"
    file = CheckpointFile(path, is_patient=True)
    for number in (1, 2, 3):
        file.write(Place(number, note=SLOT * "x"))
        found = read_checkpoint(path, Place)
        assert found is not None
        assert found.number == number
    file.close()


@pytest.mark.parametrize(
    "record", [{"count": 1, "boot": 7}, {"type": 1, "number": 1}, NewerPlace(1), {"type": 2, "x_m": 0.0}, 1]
)
def test_a_record_of_another_version_is_refused(tmp_path: Path, record: object) -> None:
    path = tmp_path / "checkpoint"
    file = CheckpointFile(path, is_patient=True)
    file.write(record)  # type: ignore[arg-type]
    file.close()
    refusal = r"^\S*checkpoint: of another version of ccatp \(.*\), so the robot's place is not known; set it at base"
    with pytest.raises(CheckpointError, match=refusal):
        read_checkpoint(path, Place)


def test_a_record_of_before_is_refused(tmp_path: Path) -> None:
    """Slots of 4096 bytes with JSON behind length and checksum."""
    body = b'{"count": 1, "boot": 7, "state": "driving"}'
    path = tmp_path / "checkpoint"
    path.write_bytes(len(body).to_bytes(4, "little") + zlib.crc32(body).to_bytes(4, "little") + body)
    with pytest.raises(CheckpointError, match="of another version of ccatp"):
        read_checkpoint(path, Place)


def test_a_disk_that_refuses_is_told_and_does_no_harm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> int:
        raise OSError(28, "No space left on device")

    file = CheckpointFile(tmp_path / "checkpoint", is_patient=True)
    with monkeypatch.context() as patch:
        patch.setattr("os.pwrite", refuse)
        file.write(Place(1))
    assert file.failure == "No space left on device"
    file.write(Place(2))
    assert file.failure == ""
    file.close()
