"""Files of a study: ``result.json``, ``result.npz``, ``table.md``, and figures in one style."""

import json
import os
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from ccatp.core import FloatArray
from ccatp.report.plots import INK, dress, new_figure, save_figure
from ccatp.studies.campaign import CellResult, Study

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LIMIT = "#c0392b"
# Distinguishable with any colour vision, and in monochrome print by their lightness.
CYCLE = ("#0b3c5d", "#d08c00", "#1d9a8a", "#b5478a", "#6b7785", "#7a3e00")
_WHOLE = 1e4  # numbers as large as this are shown without a fraction


def plain(value: Any) -> Any:
    """A value for JSON: numpy's numbers as Python's, numbers that are not finite as None."""
    if isinstance(value, Mapping):
        return {str(key): plain(part) for key, part in value.items()}
    if isinstance(value, np.ndarray | list | tuple):
        return [plain(part) for part in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not np.isfinite(value) else value


def chi_square_band(freedom: float) -> tuple[float, float]:
    """95 % interval of the mean of ``freedom`` normalised squares."""
    low, high = (float(chdtri(freedom, tail)) / freedom for tail in (0.975, 0.025))
    return low, high


def columns_of(text: str) -> list[str]:
    """Dotted keys of values; a line of ``text`` has keys of one group, ``error_mm: mean max``, or whole keys."""
    keys = []
    for line in text.strip().splitlines():
        group, colon, names = line.strip().rpartition(":")
        keys += [f"{group}.{name}" if colon else name for name in names.split()]
    return keys


def value_at(values: Mapping[str, Any], key: str) -> Any:
    """The value of a dotted key; None if it is missing."""
    value: Any = values
    for part in key.split("."):
        value = value.get(part) if isinstance(value, Mapping) else None
    return value


def markdown_table(head: Sequence[str], rows: Iterable[Iterable[Any]]) -> str:
    """A Markdown table; floats with four digits, None as a dash, lists of floats as intervals, others as remarks."""
    lines = [f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
    lines += [f"| {' | '.join(map(_text, row))} |" for row in rows]
    return "\n".join(lines) + "\n"


def _text(value: Any) -> str:
    if value is None or value == []:
        return "-"
    if isinstance(value, list):
        return (" to " if isinstance(value[0], float) else "; ").join(map(_text, value))
    if isinstance(value, float):
        return f"{value:.0f}" if abs(value) >= _WHOLE else f"{value:.4g}"
    return str(value)


def table(rows: Sequence[Mapping[str, Any]], columns: str) -> str:
    """Cells as a Markdown table: first the factors, then the columns; the heads are the keys of ``result.json``."""
    names = list(rows[0]) if rows else ["runs"]
    keys = [*names[: names.index("runs") + 1], *columns_of(columns)]
    return markdown_table(keys, ([value_at(row, key) for key in keys] for row in rows))


# -- files ------------------------------------------------------------------------------------------------------------


def write_results(
    study: Study, cells: Sequence[CellResult], out: Path, about: Mapping[str, Any], *, with_figures: bool
) -> dict[str, Any]:
    """Write all files of a campaign; returns the contents of ``result.json``.

    Cells without a run are left out of table and figures. ``about``: further values of ``result.json``, such as elapsed
    time and number of missing jobs.
    """
    rows = [plain({**cell.factors, **cell.values}) for cell in cells]
    result: dict[str, Any] = {"study": study.name, "cells": rows, **plain(about)}
    there = [cell for cell in cells if cell.values["runs"]]
    arrays = {f"{k}/{name}": array for k, cell in enumerate(cells) for name, array in cell.arrays.items()}
    np.savez_compressed(out / "result.npz", allow_pickle=False, **arrays)
    shown = table([row for row in rows if row["runs"]], study.columns)
    _write(out, result, f"# {study.name}: {study.title}\n\n{shown}")
    if with_figures and there:
        study.draw(there, out)
    return result


def write_analysis(
    name: str,
    cells: Sequence[Mapping[str, Any]],
    columns: str,
    out: Path,
    started_s: float,
    arrays: Mapping[str, NDArray[Any]],
) -> dict[str, Any]:
    """Write the files of a study without runs, except its figures; ``started_s``: its start by ``perf_counter``."""
    result = {"study": name, "cells": list(cells), "wall_s": time.perf_counter() - started_s}
    np.savez_compressed(out / "result.npz", allow_pickle=False, **arrays)
    _write(out, result, table(cells, columns))
    return result


def _write(out: Path, result: Mapping[str, Any], markdown: str) -> None:
    """Replace each file atomically: a reader sees the old or the new one, never a part."""
    texts = {"table.md": markdown, "result.json": json.dumps(result, indent=1, allow_nan=False) + "\n"}
    for name, text in texts.items():
        draft = out / f".{name}.{os.getpid()}"
        draft.write_text(text, encoding="utf-8")
        draft.replace(out / name)


# -- figures ----------------------------------------------------------------------------------------------------------


def colour(index: int) -> str:
    """A colour of the cycle."""
    return CYCLE[index % len(CYCLE)]


def grouped(cells: Iterable[CellResult], *factors: str) -> dict[tuple[Any, ...], list[CellResult]]:
    """Cells grouped by the levels of some factors, in order of appearance."""
    groups: dict[tuple[Any, ...], list[CellResult]] = {}
    for cell in cells:
        groups.setdefault(tuple(cell.factors[factor] for factor in factors), []).append(cell)
    return groups


def levels(cells: Iterable[CellResult], factor: str) -> list[Any]:
    """Levels of a factor in some cells, in order of appearance."""
    return list(dict.fromkeys(cell.factors[factor] for cell in cells))


@contextmanager
def plot(
    stem: Path, width_in: float, height_in: float, rows: int = 1, columns: int = 1,
    *, title: str = "", legend: int = 0, grid: Literal["major", "both"] = "major", **shared: Any,
) -> "Iterator[list[Axes]]":  # fmt: skip
    """The axes of a new figure, row by row; at the end of the context it is written as PNG and PDF.

    ``legend``: number of columns of the legend below the figure, which is that of the first axes; 0: none. ``shared``:
    see ``Figure.subplots``. Raises PictureError: a file cannot be written.
    """
    figure = new_figure(width_in, height_in)
    panels: list[Axes] = figure.subplots(rows, columns, squeeze=False, **shared).ravel().tolist()
    yield panels
    if title:
        figure.suptitle(title, fontsize=11)
    if legend:
        labelled = panels[0].get_legend_handles_labels()
        figure.legend(*labelled, loc="outside lower center", ncols=legend, frameon=False, fontsize=8)
    dress(*panels, grid=grid)
    for suffix in (".png", ".pdf"):
        save_figure(figure, stem.with_suffix(suffix))


def band(
    axes: "Axes", x: NDArray[Any], ends: FloatArray, shade: str, style: Literal["-", "--"] = "-", label: str = ""
) -> None:
    """Draw a line with its range; ``ends``: low, middle and high at each x, shape (3, k)."""
    axes.plot(x, ends[1], color=shade, linestyle=style, linewidth=1.5, label=label)
    axes.fill_between(x, ends[0], ends[2], color=shade, alpha=0.1, linewidth=0)


class Measure(NamedTuple):
    """A panel of a figure of ranges; the keys are those of a cell's values."""

    label: str
    ends: tuple[str, str]  # keys of the ends of the bar
    middle: str  # key of the dot on the bar
    mark: str = ""  # key of the mark: a bound, or a published value
    line: float | None = None  # expected value
    is_log: bool = True


class FigureRow(NamedTuple):
    """A row of a figure of ranges; the value of a base is drawn as a line through all rows, for comparison."""

    label: str
    cell: CellResult
    shade: int = 0
    is_base: bool = False


def rows_by(cells: Sequence[CellResult], factor: str, *others: str) -> list[FigureRow]:
    """A row for each cell, labelled by its factors, with a colour for each level of the first one."""
    known = levels(cells, factor)
    return [
        FigureRow(
            ", ".join(str(cell.factors[name]) for name in (factor, *others)), cell, known.index(cell.factors[factor])
        )
        for cell in cells
    ]


def draw_ranges(rows: Sequence[FigureRow], measures: Sequence[Measure], title: str, stem: Path) -> None:
    """Draw the values of cells: a panel for each measure, a row for each cell."""
    from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter  # noqa: PLC0415 - takes a second

    with plot(stem, 10.5, 0.27 * len(rows) + 1.6, 1, len(measures), title=title, sharey=True) as panels:
        for axes, (label, ends, dot, mark, line, is_log) in zip(panels, measures, strict=True):
            for place, (_, cell, shade, is_base) in enumerate(rows):
                low, middle, high, beside = (value_at(cell.values, key) for key in (ends[0], dot, ends[1], mark))
                if middle is None:
                    continue
                if is_base:
                    axes.axvline(middle, color=colour(shade), linewidth=0.9, linestyle="--", alpha=0.7)
                axes.plot([low, high], [place] * 2, color=colour(shade), linewidth=3.0, alpha=0.35)
                axes.plot(middle, place, "D" if is_base else "o", color=colour(shade), markersize=5)
                if beside is not None:
                    axes.plot(beside, place, "|", color=INK, markersize=9, markeredgewidth=1.5)
            if line is not None:
                axes.axvline(line, color=LIMIT, linewidth=1.0, linestyle=":")
            axes.set_xlabel(label)
            axes.xaxis.set_major_locator(MaxNLocator(5))
            if is_log:
                axes.set_xscale("log")
                axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))  # most lie within a decade or two
                axes.xaxis.set_major_formatter("{x:g}")
                axes.xaxis.set_minor_formatter(NullFormatter())
        panels[0].set_yticks(range(len(rows)), [row.label for row in rows])
        panels[0].set_ylim(len(rows) - 0.5, -0.5)  # the first one on top
