"""Reads points of other instruments: CSV, and the text exports of laser trackers and photogrammetry.

A line has a label, x, y, z, and one sigma or one for each axis. Separators are tabs, semicolons, commas or blanks;
numbers may have a decimal comma and separators of thousands. A header may name columns in any order, and a unit.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

from ccatp.core import Vector3
from ccatp.errors import UsageError

UNITS_M = {"mm": 1e-3, "m": 1.0, "um": 1e-6}
_NAMES = {
    "label": ("label", "name", "point", "id", "target", "target label", "point name", "point id"),
    "x": ("x",), "y": ("y",), "z": ("z",),
    "sx": ("sx", "sigma x", "sigmax", "ux"), "sy": ("sy", "sigma y", "sigmay", "uy"),
    "sz": ("sz", "sigma z", "sigmaz", "uz"), "sigma": ("sigma", "s", "std", "u"),
}  # fmt: skip
_ORDERS = {4: ("label", "x", "y", "z"), 5: ("label", "x", "y", "z", "sigma"),
           7: ("label", "x", "y", "z", "sx", "sy", "sz")}  # fmt: skip
_WITHOUT_LABEL = {3: ("x", "y", "z"), 6: ("x", "y", "z", "sx", "sy", "sz")}
_GROUPED = re.compile(r"[+-]?\d{1,3}([.,' ]\d{3})+([.,]\d+)?$")
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?$")


class PointFileError(UsageError):
    """A file of points that cannot be used; the message has the file, the line, and what to do."""


class Reading(NamedTuple):
    """One line: its number, the label (may be empty), the place, m, and the sigma of each axis, m, if it is given."""

    line: int
    label: str
    place_m: Vector3
    sigmas_m: Vector3 | None


def parse_points(text: str, name: str, unit: str | None = None) -> tuple[Reading, ...]:
    """The readings of a file; ``unit``: of its lengths, if the header does not name it (mm without either)."""
    rows = [(number, line) for number, line in enumerate(text.splitlines(), 1) if _is_data(line)]
    if not rows:
        raise PointFileError(f"{name}: no points in it; a line is: label, x, y, z, sx, sy, sz")
    separator = _separator([line for _, line in rows])
    cells = [(number, _split(line, separator)) for number, line in rows]
    columns, found_unit = _columns(cells[0][1])
    if columns:
        cells = cells[1:]
    if unit is not None and found_unit is not None and unit != found_unit:
        raise PointFileError(f"{name}: its header says {found_unit}, --unit says {unit}; give one of them")
    scale = UNITS_M[unit or found_unit or "mm"]
    has_decimal_comma = _has_decimal_comma([cell for _, row in cells for cell in row], separator)
    return tuple(_reading(name, number, row, columns, scale, has_decimal_comma) for number, row in cells)


def _is_data(line: str) -> bool:
    return bool(line.strip()) and not line.lstrip().startswith(("#", "//", "%"))


def _separator(lines: Sequence[str]) -> str | None:
    """The separator that stands in every line; None for blanks."""
    for one in ("\t", ";"):
        if all(one in line for line in lines):
            return one
    is_comma = all(line.count(",") >= 2 for line in lines) and not all(len(line.split()) >= 4 for line in lines)
    return "," if is_comma or all(", " in line for line in lines) else None


def _split(line: str, separator: str | None) -> list[str]:
    return [cell.strip().strip('"') for cell in (line.split() if separator is None else line.split(separator))]


def _columns(cells: Sequence[str]) -> tuple[dict[str, int], str | None]:
    """Columns that a header names, and its unit; empty if the line is no header."""
    found: dict[str, int] = {}
    units = set[str]()
    for at, cell in enumerate(cells):
        plain = re.sub(r"[\[\]()_/]", " ", cell.lower()).split()
        if len(plain) > 1 and plain[-1] in UNITS_M:
            units.add(plain.pop())
        text = " ".join(plain)
        for name, words in _NAMES.items():
            if text in words and name not in found:
                found[name] = at
    if not {"x", "y", "z"} <= found.keys():
        return {}, None
    return found, units.pop() if len(units) == 1 else None


def _has_decimal_comma(cells: Sequence[str], separator: str | None) -> bool:
    if separator == ",":
        return False
    with_comma = [cell for cell in cells if re.match(r"[+-]?[\d.' ]+,\d+$", cell)]
    with_point = [cell for cell in cells if re.match(r"[+-]?[\d,' ]+\.\d+$", cell)]
    # "1,234.5" has the comma for thousands, "1.234,5" the point.
    return (
        bool(with_comma)
        and not any(cell.rfind(".") > cell.rfind(",") for cell in with_point if "," in cell)
        and (any(len(cell.rpartition(",")[2]) != 3 for cell in with_comma) or not with_point)
    )


def _number(cell: str, has_decimal_comma: bool) -> float | None:
    text = cell.replace("\u2212", "-")
    if has_decimal_comma:
        text = text.replace(".", "").replace(",", ".")
    elif _GROUPED.match(text):
        text = text.replace(",", "")
    text = re.sub(r"(?<=\d)[' ](?=\d{3})", "", text)
    return float(text) if _NUMBER.match(text) else None


def _reading(
    name: str, line: int, cells: Sequence[str], columns: Mapping[str, int], scale: float, has_decimal_comma: bool
) -> Reading:
    order: Mapping[str, int] = columns or _by_count(name, line, cells, has_decimal_comma)
    values = {}
    for key, at in order.items():
        if key == "label":
            continue
        number = _number(cells[at], has_decimal_comma) if at < len(cells) else None
        if number is None:
            what = repr(cells[at]) if at < len(cells) else "nothing"
            raise PointFileError(f"{name}:{line}: {key} is {what}, which is no number")
        values[key] = number * scale
    label = cells[order["label"]] if "label" in order else ""
    sigmas = None
    if "sigma" in values:
        sigmas = (values["sigma"],) * 3
    elif "sx" in values:
        sigmas = values["sx"], values["sy"], values["sz"]
    if sigmas is not None and not all(one > 0.0 for one in sigmas):
        raise PointFileError(f"{name}:{line}: a sigma is not positive; leave the columns out and give --sigma-um")
    return Reading(line, label, (values["x"], values["y"], values["z"]), sigmas)


def _by_count(name: str, line: int, cells: Sequence[str], has_decimal_comma: bool) -> dict[str, int]:
    has_label = len(cells) not in _WITHOUT_LABEL or _number(cells[0], has_decimal_comma) is None
    order = (_ORDERS if has_label else _WITHOUT_LABEL).get(len(cells))
    if order is None:
        raise PointFileError(f"{name}:{line}: {len(cells)} columns; a line is: label, x, y, z, sx, sy, sz")
    return {key: at for at, key in enumerate(order)}


def labels_of(readings: Sequence[Reading]) -> Iterator[str]:
    """Labels in the order of the file, each once."""
    yield from dict.fromkeys(one.label for one in readings)
