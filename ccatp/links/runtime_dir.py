"""The folder of the unix sockets and the lock of one daemon."""

import os
import stat
import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from fcntl import LOCK_EX, LOCK_NB, LOCK_SH, flock
from pathlib import Path

from ccatp.errors import ConfigError, RefusedError

LOCK_FILE = "lock"
RUN_LOCK = ".lock"  # in a run directory; held by the daemon that writes there
ORIGIN_FILE = "origin.json"  # in a run directory: what a resumed run keeps and its configuration does not have
# Held by the simulated robot that publishes its truth there.
TRUTH_LOCK_FILE = "truth.lock"
# Folders in the usual folder: each of a simulation that began while another daemon ran.
BESIDE = "sim-{}"
# A process that checks whether a lock is held holds it for an instant.
_SECOND_LOOK_S = 0.05

# sockaddr_un.sun_path holds 108 bytes with its closing zero on Linux.
MAX_SOCKET_PATH_BYTES = 107
# The longest name of a socket in the folder; the sockets of the lanes between the processes are named by this too.
MAX_SOCKET_NAME_BYTES = 24


def runtime_dir_path(configured: str, environ: Mapping[str, str]) -> Path:
    """Path of the folder, which need not exist: the configured one, or the first that the environment names.

    ``configured`` (``run.runtime_dir``) unless empty, else ``$CCATP_RUNTIME_DIR``, else ``$XDG_RUNTIME_DIR/ccatp``,
    else ``ccatp-<uid>`` in the temporary directory. ``ConfigError``: the path is too long for a unix socket in it.
    """
    if configured:
        try:
            path = Path(configured).expanduser()
        except RuntimeError as error:
            raise ConfigError(f"runtime directory {configured}: no such user, or no home; write it in full") from error
    elif environ.get("CCATP_RUNTIME_DIR"):
        path = Path(environ["CCATP_RUNTIME_DIR"])
    elif environ.get("XDG_RUNTIME_DIR"):
        path = Path(environ["XDG_RUNTIME_DIR"]) / "ccatp"
    else:
        path = Path(tempfile.gettempdir()) / f"ccatp-{os.getuid()}"
    path = path.absolute()
    longest = len(os.fsencode(path)) + 1 + MAX_SOCKET_NAME_BYTES
    if longest > MAX_SOCKET_PATH_BYTES:
        raise ConfigError(
            f"runtime directory {path}: {longest} bytes with a socket's name, a unix socket takes at most "
            f"{MAX_SOCKET_PATH_BYTES}; choose a shorter one with --runtime-dir or CCATP_RUNTIME_DIR"
        )
    return path


def make_runtime_dir(configured: str, environ: Mapping[str, str]) -> Path:
    """The folder, made with mode 0700 if it is missing; it must belong to the caller.

    ``ConfigError``: it cannot be made, is not a folder, belongs to another user or is writable for others.
    """
    path = runtime_dir_path(configured, environ)
    make_own_dir(path, "--runtime-dir", stat.S_IWGRP | stat.S_IWOTH)
    return path


def make_own_dir(path: Path, option: str, forbidden: int) -> None:
    """Make a folder with mode 0700, or check that it belongs to the caller and has no ``forbidden`` bits in its mode.

    ``option`` names the folder on the command line. ``ConfigError``: it cannot be made, or may not be used.
    """
    instead = f"choose another with {option}"
    try:
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        info = path.lstat()
    except OSError as error:
        raise ConfigError(f"folder {path} cannot be made: {error.strerror}; {instead}") from error
    if not stat.S_ISDIR(info.st_mode):
        raise ConfigError(f"folder {path} is a link, not a folder; {instead}")
    if info.st_uid != os.getuid():
        raise ConfigError(f"folder {path} belongs to user {info.st_uid}, not to {os.getuid()}; {instead}")
    if info.st_mode & forbidden:
        mode = stat.S_IMODE(info.st_mode)
        raise ConfigError(f"folder {path} is open to others (mode {mode:04o}); chmod 700 {path}")


def running_in(usual: Path) -> list[Path]:
    """The folders in which a daemon runs: the usual one, and those of further simulations."""
    return [folder for folder in (usual, *sorted(usual.glob(BESIDE.format("*")))) if is_held(folder / LOCK_FILE)]


@contextmanager
def locked(path: Path, refusal: str, wait_s: float = _SECOND_LOOK_S) -> Iterator[int]:
    """Hold the lock of a file during the block; the end of the process releases it in any case.

    Yields the file's descriptor: processes that inherit it hold the lock, too. ``RefusedError``: another process still
    holds it after ``wait_s``.
    """
    with path.open("w") as file:
        deadline_s = time.monotonic() + wait_s
        while not _takes(file.fileno(), LOCK_EX):
            if time.monotonic() >= deadline_s:
                raise RefusedError(refusal)
            time.sleep(_SECOND_LOOK_S)
        yield file.fileno()


def is_held(path: Path) -> bool | None:
    """Whether a process holds the lock of a file; ``None`` where it cannot be read."""
    try:
        with path.open() as file:
            return not _takes(file.fileno(), LOCK_SH)
    except OSError:
        return None


def remove_sockets(runtime_dir: Path, names: Iterable[str]) -> None:
    """Remove sockets that no process serves any more; other files remain."""
    for name in names:
        path = runtime_dir / name
        with suppress(OSError):
            if stat.S_ISSOCK(path.lstat().st_mode):
                path.unlink()


def _takes(fd: int, operation: int) -> bool:
    try:
        flock(fd, operation | LOCK_NB)
    except OSError:
        return False
    return True
