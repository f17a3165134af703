"""The Plaza sets of CMU: odometry (DR), ranges (TD), beacons (TL) and truth (GT), in one .mat or as texts."""

from pathlib import Path

import numpy as np

from ccatp.beacons.datasets.tables import (
    RadioDataError,
    Table,
    bridged,
    in_order,
    names_of,
    read_table,
    with_unknown_ways,
    within,
    without_gaps_in_numbers,
)
from ccatp.beacons.datasets.truth import checked_heading, pose_of_truth
from ccatp.beacons.slam.recording import Readings, RecordedRun, ReferencePath, Steps

COLUMNS = {
    "DR": ("time [s]", "distance [m]", "turn [rad]"),
    "TD": ("time [s]", "sender", "beacon", "range [m]"),
    "GT": ("time [s]", "x [m]", "y [m]", "heading [rad]"),
    "TL": ("beacon", "x [m]", "y [m]"),
}
NEEDED = ("DR", "TD")


def read_plaza(path: Path) -> RecordedRun:
    """Read a Plaza set (Djugash, Hamner, Roth, JFR 2009).

    Args:
        path: the ``.mat``; or one of the texts ``NAME_DR.txt``, ``NAME_TD.txt``, ``NAME_GT.txt``, ``NAME_TL.txt``
            (plain or gzipped; the last two may be missing); or a folder with one set, whose ``.mat`` goes before texts.

    Raises:
        RadioDataError: a file is missing or is not what it should be.
    """
    file = _chosen(path) if path.is_dir() else path
    tables = _mat_tables(file) if file.suffix == ".mat" else _text_tables(file)
    return _run(_name(file), file, tables)


def is_plaza(file: Path) -> bool:
    """Whether the file's name is one of a Plaza set."""
    return file.suffix == ".mat" or any(f"_{kind}.txt" in file.name for kind in COLUMNS)


def _chosen(folder: Path) -> Path:
    for pattern in ("*.mat", "*_DR.txt*"):
        files = sorted(folder.glob(pattern))
        if len(files) > 1:
            raise RadioDataError(folder, f"holds {len(files)} sets: name one, as in {folder / files[0].name}")
        if files:
            return files[0]
    raise RadioDataError(folder, "holds no Plaza set: neither NAME.mat nor NAME_DR.txt")


def _name(file: Path) -> str:
    stem = file.name.split(".")[0]
    for kind in COLUMNS:
        stem = stem.removesuffix(f"_{kind}")
    return stem.rstrip("_")


def _mat_tables(file: Path) -> dict[str, Table]:
    from scipy.io import loadmat  # noqa: PLC0415 -- slow to import, and texts need none of it
    from scipy.io.matlab import MatReadError  # noqa: PLC0415

    try:
        found = loadmat(file, variable_names=[*COLUMNS])
    except FileNotFoundError as error:
        raise RadioDataError(file, "no such file") from error
    except (MatReadError, NotImplementedError, ValueError, TypeError, OSError, EOFError, IndexError) as error:
        raise RadioDataError(file, f"is no MATLAB file that can be read: {error}") from error
    tables: dict[str, Table] = {}
    for kind, columns in COLUMNS.items():
        if kind not in found:
            if kind in NEEDED:
                raise RadioDataError(file, f"has no variable {kind} ({', '.join(columns)})")
            continue
        tables[kind] = _mat_table(file, kind, found[kind])
    return tables


def _mat_table(file: Path, kind: str, raw: object) -> Table:
    columns = COLUMNS[kind]
    try:
        values = np.asarray(raw, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise RadioDataError(file, f"variable {kind} does not hold numbers") from error
    if values.ndim != 2 or values.shape[1] != len(columns) or not len(values):
        wanted = f"(n, {len(columns)}): {', '.join(columns)}"
        raise RadioDataError(file, f"variable {kind} has shape {values.shape}, wanted {wanted}")
    return Table(Path(f"{file.name} {kind}"), values, np.arange(1, len(values) + 1))


def _text_tables(file: Path) -> dict[str, Table]:
    for kind in COLUMNS:
        if f"_{kind}.txt" in file.name:
            break
    else:
        raise RadioDataError(file, "is no file of a Plaza set: those are NAME.mat, NAME_DR.txt, NAME_TD.txt")
    tables: dict[str, Table] = {}
    for other, columns in COLUMNS.items():
        plain = file.with_name(file.name.replace(f"_{kind}.txt", f"_{other}.txt").removesuffix(".gz"))
        candidates = (plain, plain.with_name(plain.name + ".gz"))
        there = next((candidate for candidate in candidates if candidate.exists()), None)
        if there is not None:
            tables[other] = read_table(there, columns)
        elif other in NEEDED:
            raise RadioDataError(plain, f"no such file; it goes with {file.name}")
    return tables


def _run(name: str, file: Path, tables: dict[str, Table]) -> RecordedRun:
    warnings: list[str] = []
    odometry = in_order(with_unknown_ways(tables["DR"], warnings), warnings, 1)
    ranges = in_order(tables["TD"], warnings)
    reference = in_order(tables["GT"], warnings) if "GT" in tables else None
    steps = _steps(file, odometry, None if reference is None else float(reference.values[0, 0]))
    span_s = (float(steps.times_s[0]), float(steps.times_s[-1]))
    heard = ranges.values[within(ranges.values[:, 0], span_s, "range", warnings)]
    if not len(heard):
        raise RadioDataError(file, "no range within the time of the odometry")
    beacon_ids, beacon = names_of(heard[:, 2])
    nothing = np.full(len(heard), np.nan)
    truth = None
    if reference is not None:
        t, x, y, heading = reference.values.T
        truth = checked_heading(ReferencePath(t, x, y, np.unwrap(heading)), steps, warnings)
    surveyed = without_gaps_in_numbers(tables["TL"], warnings).values.tolist() if "TL" in tables else []
    return RecordedRun(
        name=name,
        kind="plaza",
        steps=steps,
        readings=Readings(heard[:, 0], beacon, heard[:, 3], nothing, nothing.copy()),
        beacon_ids=beacon_ids,
        beacon_truth_m={str(int(i)): (x, y) for i, x, y in surveyed},
        truth=truth,
        first_pose=pose_of_truth(truth, steps, warnings),
        warnings=tuple(warnings),
    )


def _steps(file: Path, odometry: Table, truth_start_s: float | None) -> Steps:
    t, distance, turn = odometry.values.T
    if len(t) < 3:
        raise RadioDataError(file, f"{len(t)} odometry rows: too few for a run")
    usual_s = float(np.median(np.diff(t)))
    start_s = t[0] - usual_s
    if truth_start_s is not None and t[0] - 2.0 * usual_s < truth_start_s < t[0]:
        start_s = truth_start_s
    return bridged(Steps(np.concatenate([[start_s], t]), distance, turn, np.zeros(len(t))))
