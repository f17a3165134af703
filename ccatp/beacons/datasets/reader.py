"""Reads a recorded run of any format: detects the format, rejects impossible values, and warns of suspicious ones."""

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from ccatp.beacons.datasets.assembly import NOTHING, checked_run
from ccatp.beacons.datasets.columns import is_columns, lacking, read_columns
from ccatp.beacons.datasets.events import is_events_csv, read_events_csv
from ccatp.beacons.datasets.formats import (
    ROBOT_FILE,
    is_labyrinth,
    is_plaza,
    read_labyrinth,
    read_mrclam,
    read_plaza,
    robots_in,
)
from ccatp.beacons.datasets.pyfg import is_pyfg, read_pyfg
from ccatp.beacons.datasets.ros_bags import SUFFIXES as BAGS
from ccatp.beacons.datasets.ros_bags import read_bag
from ccatp.beacons.datasets.tables import NotTextError, RadioDataError, content_lines, read_text
from ccatp.beacons.estimation.recording import Known, RecordedRun

TEXTS = (".txt", ".csv", ".tsv")
READERS = {
    "plaza": read_plaza,
    "labyrinth": read_labyrinth,
    "csv": read_events_csv,
    "columns": read_columns,
    "pyfg": read_pyfg,
}
FORMATS = ("plaza", "mrclam", "labyrinth", "csv", "columns", "pyfg", "bag")


def read_run(
    path: Path, data_format: str | None, robot: int | None, topics_file: Path | None = None,
    *, tag: str = "", turns_heading: bool = True, known: Known = NOTHING,
) -> RecordedRun:  # fmt: skip
    """Read and check a recorded run.

    ``data_format``: one of ``FORMATS``; detected from the files if ``None``. ``topics_file``: only for a bag.
    ``tag``, ``turns_heading``, ``known``: see ``checked_run``. Raises RadioDataError: it cannot be read, or has
    another format.
    """
    data_format = found_format(path, data_format)
    if robot is not None and data_format != "mrclam":
        raise RadioDataError(path, f"a {data_format} set has one vehicle: leave out --robot")
    use_tag = ""
    try:
        if data_format == "mrclam":
            recording = read_mrclam(path, robot)
        elif data_format == "bag":
            recording, use_tag = read_bag(path, topics_file)
        else:
            recording = READERS[data_format](path)
        return checked_run(recording, turns_heading=turns_heading, known=known, tag=tag or use_tag)
    except RadioDataError as error:
        raise error.with_page() from error


def found_format(path: Path, given: str | None = None) -> str:
    """The format of a file or folder: the given one, or else by file names and the first line.

    Raises RadioDataError: it does not exist, is empty, or has none of the formats.
    """
    if not path.exists():
        raise RadioDataError(path, "no such file or folder")
    if given is not None:
        return given
    try:
        return _detected(path)
    except RadioDataError as error:
        raise error.with_page() from error


def _detected(path: Path) -> str:
    is_folder = path.is_dir()
    files = [file for file in sorted(path.iterdir()) if file.is_file()] if is_folder else [path]
    if path.suffix in BAGS or any(file.name == "metadata.yaml" for file in files):
        return "bag"
    if robots_in(path) if is_folder else ROBOT_FILE.search(path.name):
        return "mrclam"
    texts = _texts_beside_others(files) if is_folder else [] if is_plaza(path) else [read_text(path)]
    if any(is_labyrinth(text) for text in texts):
        return "labyrinth"
    if is_plaza(path):
        return "plaza"
    if any(is_columns(text) for text in texts):
        return "columns"
    for text in () if is_folder else texts:
        if not content_lines(text):
            raise RadioDataError(path, "is empty: no line but comments; give a recording")
        if is_events_csv(text):
            return "csv"
        if is_pyfg(text):
            return "pyfg"
    what = f"none of the formats {', '.join(FORMATS)}; if it is one, name it with --format"
    if lacks := next(filter(None, map(lacking, texts)), ""):
        what = f"none of the formats {', '.join(FORMATS)}; as a table of readings, {lacks}"
    raise RadioDataError(path, what)


def _texts_beside_others(files: Sequence[Path]) -> list[str]:
    """The texts of a folder; other files in it do not tell its format."""
    texts = []
    for file in files:
        if not is_plaza(file) and {*TEXTS} & {*file.suffixes}:
            with suppress(NotTextError):
                texts.append(read_text(file))
    return texts
