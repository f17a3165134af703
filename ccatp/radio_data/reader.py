"""Edge. One door to all formats of recorded radio data."""

from pathlib import Path

from ccatp.radio.recording import RecordedRun
from ccatp.radio_data.errors import RadioDataError
from ccatp.radio_data.plaza import read_plaza


def read_run(path: Path, data_format: str | None, robot: int | None) -> RecordedRun:
    """Read and check a recorded run.

    Args:
        path: file or folder of the data set.
        data_format: plaza, mrclam, labyrinth or csv; found out from the files if ``None``.
        robot: which robot, of a set of several.

    Raises:
        RadioDataError: it cannot be read, or is not what it claims to be.
    """
    if not path.exists():
        raise RadioDataError(path, "no such file or folder")
    return read_plaza(path)
