"""Edge. The folder of the unix sockets and the lock of one daemon."""

import os
import stat
import tempfile
from collections.abc import Mapping
from pathlib import Path

from ccatp.errors import RuntimeDirError

# sockaddr_un.sun_path holds 108 bytes with its closing zero on Linux.
MAX_SOCKET_PATH_BYTES = 107
# The longest name of a socket in the folder; the sockets of the lanes between the processes are named by this too.
MAX_SOCKET_NAME_BYTES = 24


def runtime_dir_path(configured: str, environ: Mapping[str, str]) -> Path:
    """The folder, which need not exist: the configured one, or the first that the environment offers.

    ``run.runtime_dir``, else ``$CCATP_RUNTIME_DIR``, else ``$XDG_RUNTIME_DIR/ccatp``, else ``ccatp-<uid>`` in the
    temporary directory.

    Args:
        configured: ``run.runtime_dir``; empty when nothing is configured.
        environ: the environment.

    Raises:
        RuntimeDirError: the path is too long for a unix socket in it.
    """
    if configured:
        path = Path(configured).expanduser()
    elif environ.get("CCATP_RUNTIME_DIR"):
        path = Path(environ["CCATP_RUNTIME_DIR"])
    elif environ.get("XDG_RUNTIME_DIR"):
        path = Path(environ["XDG_RUNTIME_DIR"]) / "ccatp"
    else:
        path = Path(tempfile.gettempdir()) / f"ccatp-{os.getuid()}"
    path = path.absolute()
    longest = len(os.fsencode(path)) + 1 + MAX_SOCKET_NAME_BYTES
    if longest > MAX_SOCKET_PATH_BYTES:
        raise RuntimeDirError(
            f"runtime directory {path}: {longest} bytes with a socket's name, a unix socket takes at most "
            f"{MAX_SOCKET_PATH_BYTES}; choose a shorter one with --runtime-dir or CCATP_RUNTIME_DIR"
        )
    return path


def make_runtime_dir(configured: str, environ: Mapping[str, str]) -> Path:
    """The folder, made with mode 0700 when it is missing, and checked to be the caller's own.

    Raises:
        RuntimeDirError: it cannot be made, is not a folder, belongs to somebody else or is writable for others.
    """
    path = runtime_dir_path(configured, environ)
    try:
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        info = path.lstat()
    except OSError as error:
        raise RuntimeDirError(
            f"runtime directory {path}: {error.strerror}; choose another with --runtime-dir"
        ) from error
    if not stat.S_ISDIR(info.st_mode):
        raise RuntimeDirError(f"runtime directory {path}: is a link, not a folder; choose another with --runtime-dir")
    if info.st_uid != os.getuid():
        raise RuntimeDirError(
            f"runtime directory {path}: belongs to user {info.st_uid}, not to {os.getuid()}; "
            "choose another with --runtime-dir"
        )
    if info.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        raise RuntimeDirError(
            f"runtime directory {path}: others may write there (mode {stat.S_IMODE(info.st_mode):04o}); "
            f"chmod 700 {path}"
        )
    return path
