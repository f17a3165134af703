"""Edge. Writes what came of a campaign: ``result.json``, ``result.npz``, ``table.md`` and the figures."""

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ccatp.studies.campaign import CellResult, Column, Study, plain


def write_results(
    study: Study, cells: Sequence[CellResult], out: Path, about: Mapping[str, Any], *, with_figures: bool
) -> dict[str, Any]:
    """Write all files of a result.

    Args:
        study: the study.
        cells: its cells; those without a run are left out of table and figures.
        out: directory.
        about: what else ``result.json`` says of the campaign: its wall time, jobs that are missing.
        with_figures: draw.

    Returns:
        What ``result.json`` holds.
    """
    rows = [plain({**cell.factors, **cell.values}) for cell in cells]
    result: dict[str, Any] = {"study": study.name, "cells": rows, **plain(about)}
    there = [cell for cell in cells if cell.values["runs"]]
    arrays = {f"{k}/{name}": array for k, cell in enumerate(cells) for name, array in cell.arrays.items()}
    np.savez_compressed(out / "result.npz", allow_pickle=False, **arrays)
    write_whole(out / "table.md", f"# {study.title}\n\n" + table([row for row in rows if row["runs"]], study.columns))
    write_whole(out / "result.json", json.dumps(result, indent=1, allow_nan=False) + "\n")
    if with_figures and there:
        study.draw(there, out)
    return result


def table(rows: Sequence[Mapping[str, Any]], columns: Sequence[Column]) -> str:
    """Cells as a Markdown table: their factors first, then the columns."""
    skipped = {"runs"}
    factors = []
    for row in rows[:1]:
        for name in row:
            if name in skipped:
                break
            factors.append(Column(name, name))
    shown = [*factors, Column("runs", "runs"), *columns]
    lines = ["| " + " | ".join(column.heading for column in shown) + " |", "|" + "---|" * len(shown)]
    lines += ["| " + " | ".join(_text(row, column) for column in shown) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def write_whole(path: Path, text: str) -> None:
    """Write a file so that a reader sees the old one or the new one, never a part."""
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    draft.write_text(text, encoding="utf-8")
    draft.replace(path)


def _text(row: Mapping[str, Any], column: Column) -> str:
    value: Any = row
    for part in column.key.split("."):
        value = value.get(part) if isinstance(value, Mapping) else None
    if value is None or value == []:
        return "-"
    if isinstance(value, list):  # an interval, or remarks
        return (" to " if column.spec else "; ").join(_number(part, column.spec) for part in value)
    return _number(value, column.spec)


def _number(value: Any, spec: str) -> str:
    return format(value, spec) if isinstance(value, int | float) and spec else str(value)
