"""The limit of open files of the processes of a run."""

import resource

from ccatp.errors import ConfigError

# Open files of one process: 32 clients of the page, sockets, recording, database. Most systems permit 1024.
OPEN_FILES = 256


def permit_open_files() -> None:
    """Raise the limit of open files, which the processes inherit; ConfigError: the system permits too few."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if 0 <= hard < OPEN_FILES:  # -1 is no limit
        raise ConfigError(f"only {hard} files may be open, a run needs {OPEN_FILES}; raise the limit with ulimit -n")
    if 0 <= soft < OPEN_FILES:
        resource.setrlimit(resource.RLIMIT_NOFILE, (OPEN_FILES, hard))
