"""Pure. The figures of a replay as text."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from ccatp.mirror.batches import FloatArray
from ccatp.replaying.judging import Judged

COLUMNS = ("recorded", "replayed", "smoothed")
# Section and key of a figure, and how a reader would call it.
ROWS = (
    ("position_error_mm", "mean", "position mean"),
    ("position_error_mm", "p50", "position p50"),
    ("position_error_mm", "p99", "position p99"),
    ("position_error_mm", "max", "position max"),
    ("moving_error_mm", "rms", "in motion rms"),
    ("arrival_error_mm", "rms", "at arrivals rms"),
    ("arrival_error_mm", "max", "at arrivals max"),
)
HEADER = ("part", "seq", "t_s", "x_m", "y_m", "heading_rad")


def table_lines(result: Mapping[str, Any]) -> Iterator[str]:
    """The result of ``judge`` as a table: a column for each estimate, a dash for what is not known."""
    columns = [name for name in COLUMNS if result[name] is not None]
    against = "the truth" if result["reference"] == "truth" else "the recorded estimate"
    yield _line(f"error against {against}", columns)
    for section, key, name in ROWS:
        cells = [_cell((result[column].get(section) or {}).get(key)) for column in columns]
        yield _line(f"  {name} (mm)", cells)
    cells = [_cell((result[column].get("heading_error_mrad") or {}).get("rms")) for column in columns]
    yield _line("  heading rms (mrad)", cells)
    yield _line("  NEES mean (3 is right)", [_cell(result[column].get("nees_mean")) for column in columns])
    yield _line("distance of the fixes", columns)
    for key in ("mean", "max"):
        cells = [_cell((result[column].get("fix_distance_mm") or {}).get(key)) for column in columns]
        yield _line(f"  {key} (mm)", cells)
    yield from _difference(result["difference"])


def _difference(found: Mapping[str, Any]) -> Iterator[str]:
    yield _line("replayed less recorded", ["rms", "max"])
    for section, name in (("position_mm", "position (mm)"), ("heading_mrad", "heading (mrad)")):
        yield _line(f"  {name}", [_cell(found[section]["rms"]), _cell(found[section]["max"])])


def _line(name: str, cells: Sequence[str]) -> str:
    return f"{name:<34}" + "".join(f"{cell:>12}" for cell in cells)


def _cell(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:.4f}" if value == 0.0 or abs(value) >= 1e-3 else f"{value:.1e}"


def csv_lines(parts: Sequence[Judged]) -> Iterator[str]:
    """Poses of each frame, deck frame: replayed, smoothed, recorded and true; empty where there is none."""
    names = ("smoothed", "recorded", "true")
    yield ",".join((*HEADER, *(f"{name}_{key}" for name in names for key in HEADER[3:])))
    for number, part in enumerate(parts, 1):
        trace = part.replayed.trace
        others = [_by_frame(other) for other in (part.replayed.smoothed, part.recorded, part.truth)]
        for seq, t_s, pose in zip(trace.seq.tolist(), trace.t_s.tolist(), trace.pose.tolist(), strict=True):
            found = [rows.get(seq, ("", "", "")) for rows in others]
            yield ",".join(str(cell) for cell in (number, seq, t_s, *pose, *(cell for row in found for cell in row)))


def _by_frame(trace: Any) -> dict[int, Sequence[float]]:
    if trace is None:
        return {}
    poses: FloatArray = trace.pose
    return dict(zip(trace.seq.tolist(), poses.tolist(), strict=True))
