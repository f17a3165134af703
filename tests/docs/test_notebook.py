"""The notebook is the page on analysis in Python, with what its code prints and draws now."""

import io
import json

import matplotlib.image
import pytest

from tests.support.examples import is_like
from tools.notebook import NOTEBOOK, PAGE, Cell, CellOutput, cells_of, execute, notebook, outputs_of, sources_of

PAGE_CELLS = cells_of(PAGE.read_text(encoding="utf-8"))
WRITTEN = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
FIGURES = 4  # errors by leg, a filter of one's own, two nights, a Monte Carlo study


@pytest.fixture(scope="module")
def executed() -> list[CellOutput]:
    return list(execute(PAGE_CELLS))


def test_the_notebook_has_the_text_and_the_code_of_the_page() -> None:
    assert sources_of(WRITTEN) == PAGE_CELLS, "python -m tools.notebook"


def test_its_cells_print_what_the_notebook_shows(executed: list[CellOutput]) -> None:
    shown = outputs_of(WRITTEN)
    assert len(shown) == len(executed)
    unlike = [now.text for was, now in zip(shown, executed, strict=True) if not is_like(was.text, now.text)]
    assert unlike == []
    assert all(one.text for one in executed)


def test_its_figures_are_drawn(executed: list[CellOutput]) -> None:
    counts = [len(one.pictures) for one in executed]
    assert counts == [len(one.pictures) for one in outputs_of(WRITTEN)]
    pictures = [picture for one in executed for picture in one.pictures]
    assert len(pictures) == FIGURES
    for picture in pictures:
        pixels = matplotlib.image.imread(io.BytesIO(picture))
        assert pixels.std() > 0.01  # not empty


def test_a_notebook_can_be_read_back() -> None:
    cells = [Cell(False, "# A\n\ntext"), Cell(True, "print(1)\nprint(2)"), Cell(True, "pass")]
    outputs = [CellOutput("1\n2\n", (b"one", b"two")), CellOutput("", ())]
    made = json.loads(json.dumps(notebook(cells, outputs)))
    assert (sources_of(made), outputs_of(made)) == (cells, outputs)
    assert [cell["execution_count"] for cell in made["cells"] if cell["cell_type"] == "code"] == [1, 2]
