"""Pure. What is wrong with a recorded data set: one line that names the file and, where there is one, the line."""

from pathlib import Path

from ccatp.errors import CcatpError, ExitStatus


class RadioDataError(CcatpError):
    """A recorded data set that cannot be used.

    Args:
        where: the file or folder.
        problem: what is wrong and what to do about it.
        line: number of the line, from 1, where it is a line's fault.
    """

    exit_status = ExitStatus.USAGE

    def __init__(self, where: Path | str, problem: str, line: int | None = None) -> None:
        super().__init__(f"{where}:{line}: {problem}" if line is not None else f"{where}: {problem}")
