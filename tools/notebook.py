"""``python -m tools.notebook`` writes docs/analysis.ipynb: docs/python.md with what its code prints and draws."""

import base64
import io
import json
import re
from collections.abc import Iterator, Sequence
from contextlib import redirect_stdout
from typing import Any, NamedTuple

import matplotlib as mpl
import matplotlib.pyplot as plt

from tools.generated_docs import DOCS

PAGE, NOTEBOOK = DOCS / "python.md", DOCS / "analysis.ipynb"
_CODE = re.compile(r"^```python\n(.*?)\n```$", re.DOTALL | re.MULTILINE)
_DPI = 80


class Cell(NamedTuple):
    """A cell of a notebook: code, or Markdown."""

    is_code: bool
    source: str


class CellOutput(NamedTuple):
    """What a cell of code printed, and its figures as PNG."""

    text: str
    pictures: tuple[bytes, ...]


def cells_of(page: str) -> list[Cell]:
    """The text of a page and its blocks of Python, in their order."""
    parts = _CODE.split(page)
    cells = (Cell(bool(number % 2), part.strip()) for number, part in enumerate(parts))
    return [cell for cell in cells if cell.source]


def execute(cells: Sequence[Cell]) -> Iterator[CellOutput]:
    """Execute the cells of code one after the other in one namespace."""
    mpl.use("Agg")
    names: dict[str, object] = {"__name__": "__notebook__"}
    for number, cell in enumerate(cell for cell in cells if cell.is_code):
        with redirect_stdout(io.StringIO()) as printed:
            exec(compile(cell.source, f"{PAGE.name}, block {number + 1}", "exec"), names)
        yield CellOutput(printed.getvalue(), tuple(_pictures()))


def _pictures() -> Iterator[bytes]:
    for number in plt.get_fignums():
        drawn = io.BytesIO()
        plt.figure(number).savefig(drawn, format="png", dpi=_DPI, metadata={"Software": None})
        plt.close(number)
        yield drawn.getvalue()


def notebook(cells: Sequence[Cell], outputs: Sequence[CellOutput]) -> dict[str, Any]:
    """The notebook, format 4.5."""
    left = iter(enumerate(outputs, start=1))
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    return {
        "cells": [_code_cell(cell, number, *next(left)) if cell.is_code else _text_cell(cell, number)
                  for number, cell in enumerate(cells)],
        "metadata": {"kernelspec": kernel, "language_info": {"name": "python"}},
        "nbformat": 4,
        "nbformat_minor": 5,
    }  # fmt: skip


def _text_cell(cell: Cell, number: int) -> dict[str, Any]:
    return {"cell_type": "markdown", "id": f"cell-{number}", "metadata": {}, "source": _lines(cell.source)}


def _code_cell(cell: Cell, number: int, count: int, output: CellOutput) -> dict[str, Any]:
    outputs: list[dict[str, Any]] = []
    if output.text:
        outputs.append({"name": "stdout", "output_type": "stream", "text": _lines(output.text)})
    for picture in output.pictures:
        data = {"image/png": base64.b64encode(picture).decode("ascii"), "text/plain": ["<Figure>"]}
        outputs.append({"data": data, "metadata": {}, "output_type": "display_data"})
    return {
        "cell_type": "code", "execution_count": count, "id": f"cell-{number}", "metadata": {}, "outputs": outputs,
        "source": _lines(cell.source),
    }  # fmt: skip


def _lines(text: str) -> list[str]:
    return text.splitlines(keepends=True)


def outputs_of(written: dict[str, Any]) -> list[CellOutput]:
    """What the cells of code of a notebook printed and drew."""
    found = []
    for cell in written["cells"]:
        if cell["cell_type"] == "code":
            text = "".join(line for one in cell["outputs"] for line in one.get("text", ()))
            pictures = [one["data"]["image/png"] for one in cell["outputs"] if "data" in one]
            found.append(CellOutput(text, tuple(map(base64.b64decode, pictures))))
    return found


def sources_of(written: dict[str, Any]) -> list[Cell]:
    """The cells of a notebook without their outputs."""
    return [Cell(cell["cell_type"] == "code", "".join(cell["source"])) for cell in written["cells"]]


if __name__ == "__main__":
    page = cells_of(PAGE.read_text(encoding="utf-8"))
    text = json.dumps(notebook(page, list(execute(page))), indent=1, ensure_ascii=False)
    NOTEBOOK.write_text(f"{text}\n", encoding="utf-8")
    print(NOTEBOOK)
