"""Edge. The log file as something that never fails: what the disk does not take is dropped and counted."""

import io
import sys
from contextlib import suppress
from pathlib import Path


class LogStream(io.TextIOBase):
    """Appends whole lines; several processes may share the file.

    Args:
        path: the file.
        process: whose log it is, for the alarm on standard error when the first line is dropped.

    Attributes:
        dropped: lines that are not in the file, or only in part.
    """

    def __init__(self, path: Path, process: str) -> None:
        """Open the file; raises ``OSError`` where it cannot be made."""
        self._path, self._process = path, process
        self._file = path.open("ab", buffering=0)
        self._is_torn = False
        self.dropped = 0

    def write(self, text: str) -> int:
        """Append; always takes all of it."""
        data = text.encode("utf-8", "backslashreplace")
        if self._is_torn:
            data = b"\n" + data
        try:
            written = self._file.write(data)
        except OSError as error:
            self._drop(error.strerror or str(error))
            return len(text)
        if written != len(data):
            self._is_torn = self._is_torn or bool(written)
            self._drop("the disk took a part of a line")
        else:
            self._is_torn = False
        return len(text)

    def _drop(self, why: str) -> None:
        self.dropped += 1
        if self.dropped > 1:
            return
        with suppress(OSError):  # standard error may lie on the same disk
            print(f"ccatp {self._process}: {self._path}: lines are dropped: {why}", file=sys.stderr, flush=True)

    def close(self) -> None:
        """Close the file."""
        self._file.close()
        super().close()
