"""Files that a user names: read up to a limit, written atomically; the file of a traceback."""

import errno
import os
import stat
import tempfile
import traceback
from pathlib import Path
from typing import BinaryIO

from ccatp.errors import ConfigError, one_line

# Of a configuration, a plan, a list of clients, a key: 25 times as long as the longest that is shipped.
MOST_BYTES = 1 << 18
FOR_OTHERS = stat.S_IRWXG | stat.S_IRWXO


def open_input(path: Path) -> BinaryIO:
    """Open a regular file; a pipe or device, which may wait or be endless, is refused.

    Raises OSError: there is none, or it is a folder, a pipe, a socket or a device.
    """
    try:
        handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    except ValueError as error:  # a zero byte, or a character that the file system cannot encode
        raise OSError(errno.EINVAL, "no file can have that name", str(path)) from error
    mode = os.fstat(handle).st_mode
    if not stat.S_ISREG(mode):
        os.close(handle)
        raise OSError(errno.EINVAL, "is a directory" if stat.S_ISDIR(mode) else "is no regular file", str(path))
    return os.fdopen(handle, "rb")


def read_input(path: Path, most_bytes: int = MOST_BYTES) -> bytes:
    """The content of a file; raises OSError as ``open_input``, or where it is longer than ``most_bytes``."""
    with open_input(path) as file:
        data = file.read(most_bytes + 1) or b""
    if len(data) > most_bytes:
        raise OSError(errno.EFBIG, f"is longer than {most_bytes} bytes", str(path))
    return data


def read_text(path: Path, most_bytes: int = MOST_BYTES) -> str:
    """The text of a file in UTF-8, with or without a byte order mark; raises OSError or UnicodeDecodeError."""
    return read_input(path, most_bytes).decode("utf-8-sig")


def read_toml(path: Path) -> str:
    """The text of a TOML file; raises ConfigError where there is none."""
    try:
        return read_text(path).replace("\r\n", "\n").replace("\r", "\n")
    except OSError as error:
        what_to_do = "shorten it" if error.errno == errno.EFBIG else "name a TOML file that exists"
        raise ConfigError(f"{path}: {(error.strerror or str(error)).lower()}; {what_to_do}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: is not UTF-8 text (byte {error.start}); save it as UTF-8") from error


def read_private(path: Path, what: str, forbidden: int, make: str = "make keys with ccatp keys generate") -> bytes:
    """The content of a file whose mode has none of the ``forbidden`` bits; ``ConfigError``: it cannot be used."""
    try:
        data, mode = read_input(path), stat.S_IMODE(path.stat().st_mode)
    except OSError as error:
        raise ConfigError(f"{what}: cannot read {path}: {error.strerror}; {make}") from error
    if mode & forbidden:
        raise ConfigError(f"{what}: {path} is open to others (mode {mode:04o}); chmod go= {path}")
    return data


def read_key(key_file: str, *, must_be_private: bool = False, what: str = "robot.key_file") -> bytes | None:
    """Key of the robot link: the file's bytes without white space around them; ``None`` when no file is named.

    ``must_be_private``: refuse a file that others may read; the key of a simulated robot is no secret. ``ConfigError``:
    the file cannot be read, is empty, or is not private.
    """
    if not key_file:
        return None
    key = read_private(Path(key_file), what, FOR_OTHERS if must_be_private else 0).strip()
    if not key:
        raise ConfigError(f"{what}: {key_file} is empty")
    return key


def write_file(path: Path, text: str, mode: int | None = None, *, is_replacing: bool = True) -> None:
    """Write a file atomically: a reader finds the new content or the old one, also after a power failure.

    ``mode``: that of the old file by default. Where ``path`` is a link, what it points to is replaced. Raises
    ConfigError: it cannot be written, or is there and not to be replaced.
    """
    path = path.resolve()
    new: Path | None = None
    try:
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        new = Path(name)
        with os.fdopen(handle, "w", encoding="utf-8", errors="surrogateescape") as out:
            out.write(text)
            out.flush()
            os.fchmod(out.fileno(), path.stat().st_mode & 0o7777 if mode is None else mode)
            os.fsync(out.fileno())
        if is_replacing:
            new.replace(path)
        else:
            os.link(new, path)  # unlike a rename, this fails where the file exists by now
        sync_folder(path)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror or error}") from error
    finally:
        if new is not None:
            new.unlink(missing_ok=True)


def write_durably(path: Path, data: bytes) -> None:
    """The file has the old content or the new one, whatever ends this process or the machine; raises OSError."""
    new = path.with_name(f"{path.name}.new")
    try:
        with new.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        new.replace(path)
    except OSError:
        new.unlink(missing_ok=True)
        raise
    sync_folder(path)


def sync_folder(path: Path) -> None:
    """Make the name of a new or replaced file durable against a power failure."""
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def keep_traceback(error: BaseException, folder: Path | None = None) -> str:
    """Write the traceback of an unexpected error into a folder, else the temporary one; a line that names the file."""
    what = one_line(f"unexpected {type(error).__name__}: {error}")
    try:
        handle, name = tempfile.mkstemp(dir=folder, prefix="ccatp-error-", suffix=".txt")
        with os.fdopen(handle, "w", encoding="utf-8", errors="backslashreplace") as out:
            traceback.print_exception(error, file=out)
    except OSError:
        return what if folder is None else keep_traceback(error)
    return f"{what}; its traceback is in {name}"
