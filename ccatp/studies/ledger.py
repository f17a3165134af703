"""Edge. What a campaign has done so far: one line for each finished job, safe on the disk before the next begins.

A campaign that is killed at any instant goes on from its ledger. Each shard writes a file of its own, so that shards
may share a directory; all of them are read.
"""

import base64
import fcntl
import io
import json
import os
from collections.abc import Iterable
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

import numpy as np

from ccatp.studies.campaign import Arrays, CampaignError, Job, Outcome, plain
from ccatp.studies.plan import WHOLE, Shard

PATTERN = "jobs*.jsonl"


def make_out(out: Path) -> None:
    """Make a study's directory, before any work.

    Raises:
        CampaignError: it cannot be made.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CampaignError(f"--out: cannot make {out}: {error.strerror or error}; choose another --out") from error


class Ledger:
    """The finished jobs in a directory.

    Args:
        out: the campaign's directory; made if it is not there.
        shard: whose file is written.
        others: directories whose jobs are taken over.

    Raises:
        CampaignError: ``out`` cannot be made, another campaign writes here, a directory does not exist, or a file holds
            what is no ledger.
    """

    def __init__(self, out: Path, shard: Shard = WHOLE, others: Iterable[Path] = ()) -> None:
        """Open the shard's file and read all that is there."""
        make_out(out)
        name = "jobs.jsonl" if shard == WHOLE else f"jobs-{shard.number}of{shard.of}.jsonl"
        self._done: dict[str, tuple[str, Path, Outcome]] = {}
        self._took_s: dict[str, float] = {}
        self._file: BinaryIO = (out / name).open("a+b")
        try:
            _lock(self._file)
            _cut_torn_line(self._file)
            for folder in (out, *others):
                self._read_all(folder)
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> "Ledger":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._file.close()

    def outcome(self, job: Job) -> Outcome | None:
        """What came of a job, or None where it is still to do.

        Raises:
            CampaignError: a job of the same name was done under other circumstances.
        """
        found = self._done.get(job.key)
        if found is None:
            return None
        fingerprint, path, outcome = found
        if fingerprint != job.fingerprint:
            raise CampaignError(
                f"{path}: job {job.key} was done with another configuration or version; "
                "give the options of then, or another --out"
            )
        return outcome

    def took_s(self, job: Job) -> float:
        """How long a job took its worker; 0 where it is still to do."""
        return self._took_s.get(job.key, 0.0)

    @property
    def durations_s(self) -> dict[str, list[float]]:
        """How long finished jobs took, by cell."""
        found: dict[str, list[float]] = {}
        for key, took_s in self._took_s.items():
            found.setdefault(key.rpartition(",seed=")[0], []).append(took_s)
        return found

    def add(self, job: Job, outcome: Outcome, took_s: float = 0.0) -> None:
        """Note a finished job and how long it took its worker, and return when it is on the disk."""
        record = {
            "key": job.key,
            "fingerprint": job.fingerprint,
            "took_s": round(took_s, 3),
            "values": plain(outcome.values),
            "arrays": _packed(outcome.arrays),
        }
        line = json.dumps(record, allow_nan=False).encode() + b"\n"
        self._file.write(line)
        self._file.flush()
        os.fsync(self._file.fileno())
        self._take(json.loads(line), Path(self._file.name))

    def _read_all(self, folder: Path) -> None:
        if not folder.is_dir():
            raise CampaignError(f"{folder}: is no directory; name one that a campaign wrote")
        for path in sorted(folder.glob(PATTERN)):
            lines = path.read_bytes().split(b"\n")
            for number, line in enumerate(lines[:-1], start=1):  # what follows the last line end is torn
                try:
                    self._take(json.loads(line), path)
                except (ValueError, KeyError, TypeError) as error:
                    raise CampaignError(f"{path}:{number}: is no finished job; remove the line") from error

    def _take(self, record: dict[str, Any], path: Path) -> None:
        outcome = Outcome(record["values"], _unpacked(record["arrays"]))
        self._done.setdefault(record["key"], (record["fingerprint"], path, outcome))
        self._took_s.setdefault(record["key"], float(record["took_s"]))


def _lock(file: BinaryIO) -> None:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        raise CampaignError(
            f"{file.name}: another campaign writes there; wait for it or choose another --out"
        ) from error


def _cut_torn_line(file: BinaryIO) -> None:
    """Cut what was being written when the last campaign was killed."""
    file.seek(0)
    whole = file.read()
    file.truncate(whole.rfind(b"\n") + 1)


def _packed(arrays: Arrays) -> str:
    stream = io.BytesIO()
    np.savez_compressed(stream, allow_pickle=False, **arrays)
    return base64.b64encode(stream.getvalue()).decode()


def _unpacked(text: str) -> Arrays:
    with np.load(io.BytesIO(base64.b64decode(text)), allow_pickle=False) as arrays:
        return dict(arrays)
