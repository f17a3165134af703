"""The checkpoint: whatever byte is wrong, one whole record remains."""

from pathlib import Path

import msgspec
import pytest

from ccatp.records.checkpoint import Checkpoint, CheckpointError, CheckpointFile, read_checkpoint


def record(count: int) -> Checkpoint:
    return Checkpoint(
        count=count, boot=7, seq=10 * count, t_s=0.1 * count, x_m=1.25, y_m=-0.5, heading_rad=0.75, sigma_m=1e-4,
        heading_sigma_rad=1e-3, speed_m_s=0.1, rate_rad_s=0.0, state="driving", abort_cause="", held_cause="",
        elapsed_s=3.0, last_fix="1-2-3",
    )  # fmt: skip


@pytest.mark.parametrize("is_patient", [True, False])
def test_the_newest_record_is_read_back(tmp_path: Path, is_patient: bool) -> None:
    path = tmp_path / "checkpoint"
    file = CheckpointFile(path, is_patient=is_patient)
    for count in range(1, 8):
        file.write(record(count), is_durable=count % 3 == 0)
    file.close()
    found = read_checkpoint(path)
    assert found is not None
    assert (found.count, found.x_m, found.last_fix) == (7, 1.25, "1-2-3")
    assert file.failure == ""


def test_nothing_there(tmp_path: Path) -> None:
    assert read_checkpoint(tmp_path / "none") is None
    (tmp_path / "empty").touch()
    assert read_checkpoint(tmp_path / "empty") is None


@pytest.mark.fault("P16")
def test_flipped_bits_and_cuts_leave_a_whole_record_or_none(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint"
    file = CheckpointFile(path, is_patient=True)
    written = {count: msgspec.to_builtins(record(count)) for count in (1, 2)}
    file.write(record(1))
    file.write(record(2))
    file.close()
    whole = path.read_bytes()
    for offset in (*range(8), *range(8, len(whole), 5)):  # length and checksum of a slot, and all over the records
        path.write_bytes(whole[:offset] + bytes([whole[offset] ^ 1 << offset % 8]) + whole[offset + 1 :])
        found = read_checkpoint(path)
        assert found is not None  # one slot is untouched
        assert msgspec.to_builtins(found) == written[found.count]
    whole_from = 8 + int.from_bytes(whole[:4], "little")  # length and checksum, and the record of an even count
    for length in range(1, len(whole), 7):
        path.write_bytes(whole[:length])
        if length < whole_from:  # nobody knows where the robot is, and least of all is it at base
            with pytest.raises(CheckpointError, match="damaged"):
                read_checkpoint(path)
        else:
            found = read_checkpoint(path)
            assert found is not None
            assert msgspec.to_builtins(found) == written[found.count]


def test_a_sound_checksum_over_something_else_is_no_record(tmp_path: Path) -> None:
    import zlib

    body = b'{"count": 1}'
    path = tmp_path / "checkpoint"
    path.write_bytes(len(body).to_bytes(4, "little") + zlib.crc32(body).to_bytes(4, "little") + body)
    with pytest.raises(
        CheckpointError, match=r"checkpoint: damaged, so the robot's place is not known; set it at base"
    ):
        read_checkpoint(path)


def test_a_disk_that_refuses_is_told_and_does_no_harm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> int:
        raise OSError(28, "No space left on device")

    file = CheckpointFile(tmp_path / "checkpoint", is_patient=True)
    with monkeypatch.context() as patch:
        patch.setattr("os.pwrite", refuse)
        file.write(record(1))
    assert file.failure == "No space left on device"
    file.write(record(2))
    assert file.failure == ""
    file.close()
