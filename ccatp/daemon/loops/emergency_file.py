"""The emergencies of a run in a file: they are on the disk before a request is answered."""

import json
import os
import uuid
from contextlib import suppress
from pathlib import Path

import structlog

from ccatp.config.files import read_text, sync_folder
from ccatp.core import EmergencyKind
from ccatp.safety.emergency_latch import Emergency, EmergencyLatch

EMERGENCIES_FILE = "emergencies.json"
# Enough for some hundred active emergencies and as many cleared ones.
RESERVE_BYTES = 65536


def read_active(path: Path) -> list[Emergency]:
    """The active emergencies in a file. Raises OSError, ValueError, KeyError or TypeError: it cannot be read."""
    return [Emergency(EmergencyKind(e["kind"]), str(e["id"]), e["note"]) for e in json.loads(read_text(path))["active"]]


def latched_kinds(path: Path) -> set[EmergencyKind]:
    """The kinds of the active emergencies in a file; one that cannot be read is taken for an emergency, as below."""
    try:
        return {one.kind for one in read_active(path)}
    except FileNotFoundError:
        return set()
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError):
        return {EmergencyKind.OPERATOR}


class PersistentEmergencyLatch(EmergencyLatch):
    """A latch that is on the disk before the reply is sent.

    An existing file is read. A failure to read or write is logged; the latch in memory remains valid.
    """

    def __init__(self, path: Path, log: structlog.typing.FilteringBoundLogger) -> None:
        super().__init__()
        self._path, self._log = path, log
        self._new = path.with_name(f"{path.name}.new")
        with suppress(OSError):
            self._reserve()
        try:
            kept = json.loads(read_text(path))
            self._active = {one.id: one for one in read_active(path)}
            self._cleared = dict.fromkeys(map(str, kept["cleared"]))
            self.raised = int(kept.get("raised", len(self._active) + len(self._cleared)))
        except FileNotFoundError:
            return
        except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
            # The content is not known, so the survey is aborted, to be safe.
            unknown = str(uuid.uuid4())
            advice = f"taken for an emergency; 'ccatp clear {unknown}' ends it"
            log.error("emergencies_unreadable", path=str(path), error=str(error), advice=advice)
            super().raise_emergency(EmergencyKind.OPERATOR, unknown, f"{path.name} cannot be read")
            self._save()
        if self._active:
            log.warning("emergencies_restored", active=sorted(self._active))

    def raise_emergency(self, kind: str, emergency_id: str, note: str = "") -> str | None:
        """See ``EmergencyLatch``; saved before it returns."""
        before = self.raised
        refusal = super().raise_emergency(kind, emergency_id, note)
        if self.raised != before:
            self._save()
        return refusal

    def clear(self, emergency_id: str, at_base_or_held: bool) -> str | None:
        """See ``EmergencyLatch``; saved before it returns."""
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
            sync_folder(self._path)
        except OSError as error:
            self._log.error("emergencies_not_saved", error=str(error))
        with suppress(OSError):
            self._reserve()

    def _reserve(self) -> None:
        """Reserve space for the next state, so that an emergency can be saved on a full disk."""
        with self._new.open("ab") as file:
            os.posix_fallocate(file.fileno(), 0, RESERVE_BYTES)
