"""Edge. The figure of the study `sensitivity`."""

from collections.abc import Sequence
from pathlib import Path

from ccatp.studies.campaign import CellResult
from ccatp.studies.range_figures import Row, draw_ranges

_BASES = ("none", "all")


def draw_sensitivity(cells: Sequence[CellResult], out: Path) -> None:
    """One figure for each mirror, the undisturbed and the fully disturbed world as lines."""
    worlds = list(dict.fromkeys(cell.factors["world"] for cell in cells))
    for mirror in dict.fromkeys(str(cell.factors["mirror"]) for cell in cells):
        there = [cell for cell in cells if cell.factors["mirror"] == mirror]
        rows = [Row(_name(c), c, worlds.index(c.factors["world"]), c.factors["group"] in _BASES) for c in there]
        draw_ranges(rows, f"What each disturbance costs on {mirror}", out / f"sensitivity-{mirror}")


def _name(cell: CellResult) -> str:
    group = str(cell.factors["group"])
    return f"world {cell.factors['world']}" if group in _BASES else group
