"""Glue. The latch of emergencies in a file: a danger loop that is started anew knows what the last one was told."""

import json
import os
import uuid
from contextlib import suppress
from pathlib import Path

import structlog

from ccatp.hazards.abort_latch import AbortLatch, Emergency
from ccatp.samples import EmergencyKind

FILE = "emergencies.json"
# A latch of some hundred emergencies, and as many that were cleared.
RESERVE_BYTES = 65536


def active_ids(path: Path) -> list[str]:
    """The ids of the emergencies that a file holds, as far as it can be read."""
    try:
        return [str(e["id"]) for e in json.loads(path.read_text(encoding="utf-8"))["active"]]
    except (OSError, ValueError, KeyError, TypeError):
        return []


class DurableLatch(AbortLatch):
    """A latch that is on the disk before anybody is told that it is latched.

    Args:
        path: the file; one that is there is read.
        log: told when the file cannot be read or written; the latch holds all the same.
    """

    def __init__(self, path: Path, log: structlog.typing.FilteringBoundLogger) -> None:
        """Latched as the file says."""
        super().__init__()
        self._path, self._log = path, log
        self._new = path.with_name(f"{path.name}.new")
        with suppress(OSError):
            self._reserve()
        try:
            kept = json.loads(path.read_text(encoding="utf-8"))
            self._active = {e["id"]: Emergency(EmergencyKind(e["kind"]), e["id"], e["note"]) for e in kept["active"]}
            self._cleared = dict.fromkeys(map(str, kept["cleared"]))
            self.raised = int(kept.get("raised", len(self._active) + len(self._cleared)))
        except FileNotFoundError:
            return
        except (OSError, ValueError, KeyError, TypeError) as error:
            # What it held is not known: the survey is aborted rather than driven on.
            unknown = str(uuid.uuid4())
            what = f"{path} cannot be read: taken for an emergency; 'ccatp clear {unknown}' ends it"
            log.error(what, error=str(error))
            super().raise_emergency(EmergencyKind.OPERATOR, unknown, f"{path.name} cannot be read")
            self._save()
        if self._active:
            log.warning("emergencies of before", active=sorted(self._active))

    def raise_emergency(self, kind: str, emergency_id: str, note: str = "") -> str | None:
        """As ``AbortLatch``, and on the disk."""
        before = self.raised
        refusal = super().raise_emergency(kind, emergency_id, note)
        if self.raised != before:
            self._save()
        return refusal

    def clear(self, emergency_id: str, at_base_or_held: bool) -> str | None:
        """As ``AbortLatch``, and on the disk."""
        before = len(self._active)
        refusal = super().clear(emergency_id, at_base_or_held)
        if len(self._active) != before:
            self._save()
        return refusal

    def _save(self) -> None:
        active = [{"id": e.id, "kind": e.kind, "note": e.note} for e in self._active.values()]
        text = json.dumps({"active": active, "cleared": list(self._cleared), "raised": self.raised})
        with suppress(OSError):
            self._reserve()
        try:
            with self._new.open("r+b") as file:
                file.write(text.encode())
                file.truncate()
                file.flush()
                os.fsync(file.fileno())
            self._new.replace(self._path)
            folder = os.open(self._path.parent, os.O_RDONLY)
            try:
                os.fsync(folder)
            finally:
                os.close(folder)
        except OSError as error:
            self._log.error("emergencies cannot be kept: lost if this process dies", error=str(error))
        with suppress(OSError):
            self._reserve()

    def _reserve(self) -> None:
        """Room for the next state, taken while there is some: an emergency is kept though the disk is full."""
        with self._new.open("ab") as file:
            os.posix_fallocate(file.fileno(), 0, RESERVE_BYTES)
