"""Reads points of other instruments: CSV, and the text exports of laser trackers and photogrammetry.

A line has a label, x, y, z, and one sigma or one for each axis; label and sigmas may be missing. Separators are tabs,
semicolons, commas or blanks; numbers may have a decimal comma and separators of thousands. A header may name columns in
any order, and their units.
"""

import csv
import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from ccatp.core import Vector3
from ccatp.errors import UsageError

UNITS_M = {"mm": 1e-3, "m": 1.0, "um": 1e-6}
_OTHER_UNITS = ("nm", "cm", "km", "in", "inch", "inches", "ft", "feet", "mil", "mils")
_NAMES = {
    "label": ("label", "name", "point", "id", "target", "target label", "point name", "point id"),
    "x": ("x",), "y": ("y",), "z": ("z",),
    "sx": ("sx", "sigma x", "sigmax", "ux", "std x", "stdx"), "sy": ("sy", "sigma y", "sigmay", "uy", "std y", "stdy"),
    "sz": ("sz", "sigma z", "sigmaz", "uz", "std z", "stdz"), "sigma": ("sigma", "s", "std", "u"),
    "used": ("enabled", "active", "used", "use"),
}  # fmt: skip
_PLACE, _SIGMAS = ("x", "y", "z"), ("sx", "sy", "sz")
_ORDERS = {4: ("label", *_PLACE), 5: ("label", *_PLACE, "sigma"), 7: ("label", *_PLACE, *_SIGMAS)}
_WITH_ZERO = 8  # columns of a photogrammetric export: as with seven, and a 0
_WITHOUT_LABEL = {3: _PLACE, 6: (*_PLACE, *_SIGMAS)}
_FORM = "label, x, y, z, sx, sy, sz"
_YES = ("1", "checked", "on", "true", "x", "yes")
# Numbers with a decimal point, and with a decimal comma; "1,234" and "1.234" are both.
_BY_POINT = re.compile(r"[+-]?(\d{1,3}(,\d{3})+|\d+)?(\.\d*)?([eE][+-]?\d+)?$")
_BY_COMMA = re.compile(r"[+-]?(\d{1,3}(\.\d{3})+|\d+)?(,\d*)?([eE][+-]?\d+)?$")
_GAPS = re.compile("(?<=\\d)['\u2019 \u00a0\u2009\u202f](?=\\d{3})")  # between thousands
_LEAST_SIGMA_M, _MOST_SIGMA_M = 1e-7, 1e-3


class PointFileError(UsageError):
    """A file of points that cannot be used; the message has the file, the line, and what to do."""


class Reading(NamedTuple):
    """One line: its number, the label (may be empty), the place, m, and the sigma of each axis, m, if it is given."""

    line: int
    label: str
    place_m: Vector3
    sigmas_m: Vector3 | None


class _Column(NamedTuple):
    """Where a value stands in a line, and the unit that the header gives it."""

    at: int
    unit: str | None = None


class _Row(NamedTuple):
    """The cells of a line, and which values they are."""

    line: int
    cells: Sequence[str]
    columns: Mapping[str, _Column]

    @property
    def numbers(self) -> list[str]:
        """The cells that should be numbers."""
        return [
            _plain(self.cells[column.at])
            for key, column in self.columns.items()
            if key not in ("label", "used") and column.at < len(self.cells)
        ]


def parse_points(text: str, name: str, unit: str | None = None) -> tuple[Reading, ...]:
    """The readings of a file; ``unit``: of its lengths, if the header does not name it (mm without either)."""
    lines = [(number, line) for number, line in enumerate(text.splitlines(), 1) if _is_data(line)]
    if not lines:
        raise PointFileError(f"{name}: no points in it; a line is: {_FORM}")
    separator = _separator([line for _, line in lines])
    cells = [(number, _split(line, separator)) for number, line in lines]
    header = _header(f"{name}:{cells[0][0]}", cells[0][1])
    if header:
        cells = cells[1:]
        if not cells:
            raise PointFileError(f"{name}: a header and no points; a line is: {_FORM}")
    unit = _unit(name, header, unit)
    rows = [_Row(number, some, header or _by_count(name, number, some)) for number, some in cells]
    if separator == "," and len(cells[0][1]) > 4 and not any("." in one for row in rows for one in row.numbers):
        raise PointFileError(
            f"{name}:{rows[0].line}: no number has a decimal point; where commas separate the columns, a decimal comma "
            "takes quotes"
        )
    has_decimal_comma = _has_decimal_comma(name, rows)
    return tuple(_reading(name, row, unit, has_decimal_comma) for row in rows)


def _is_data(line: str) -> bool:
    return bool(line.strip(" \t,;\ufeff")) and not line.lstrip().startswith(("#", "//", "%"))


def _separator(lines: Sequence[str]) -> str | None:
    """The separator that stands in every line; None for blanks."""
    for one in ("\t", ";"):
        if all(one in line for line in lines):
            return one
    is_comma = all(line.count(",") >= 2 for line in lines) and not all(len(line.split()) >= 4 for line in lines)
    return "," if is_comma or all(", " in line for line in lines) else None


def _split(line: str, separator: str | None) -> list[str]:
    """The cells of a line, without quotes and without empty ones at its end."""
    text = " ".join(line.split()) if separator is None else line
    cells = next(csv.reader([text], delimiter=separator or " ", skipinitialspace=True))
    cells = [cell.strip() for cell in cells]
    while cells and not cells[-1]:
        cells.pop()
    return cells


def _header(where: str, cells: Sequence[str]) -> dict[str, _Column]:
    """Columns that a header names; empty if the line is a point."""
    found: dict[str, _Column] = {}
    for at, cell in enumerate(cells):
        words = re.sub(r"[\[\]()_/]", " ", cell.lower()).replace("\u00b5", "u").replace("\u03bc", "u").split()
        unit = words.pop() if len(words) > 1 and words[-1] in (*UNITS_M, *_OTHER_UNITS) else None
        key = next((key for key, names in _NAMES.items() if " ".join(words) in names), None)
        if key is None or (key == "label" and key in found):
            continue
        if unit in _OTHER_UNITS:
            raise PointFileError(f"{where}: {cell!r} is in {unit}; export it in one of {', '.join(UNITS_M)}")
        if key in found:
            raise PointFileError(f"{where}: two columns are {key}; leave the other values of the points out")
        found[key] = _Column(at, unit)
    if set(_PLACE) <= found.keys():
        if 0 < len(found.keys() & set(_SIGMAS)) < len(_SIGMAS):
            raise PointFileError(f"{where}: not all of sx, sy, sz; give the three, or one column sigma")
        return found
    if not any(_is_number(cell) for cell in cells):
        raise PointFileError(
            f"{where}: neither a point nor a header with the columns x, y and z; put # before a line that is neither"
        )
    return {}


def _unit(name: str, header: Mapping[str, _Column], unit: str | None) -> str:
    """The unit of columns whose unit the header does not name: that of the coordinates."""
    named = {header[axis].unit for axis in _PLACE if axis in header} - {None}
    if len(named) > 1:
        raise PointFileError(f"{name}: its header has x, y and z in mixed units; export them in one")
    (found,) = named or {None}
    if unit is not None and found not in (None, unit):
        raise PointFileError(f"{name}: its header says {found}, --unit says {unit}; give one of them")
    return unit or found or "mm"


def _by_count(name: str, line: int, cells: Sequence[str]) -> dict[str, _Column]:
    has_label = len(cells) not in _WITHOUT_LABEL or not _is_number(cells[0])
    count = len(cells)
    if count == _WITH_ZERO and _number(_plain(cells[-1]), has_decimal_comma="," in cells[-1]) == 0.0:
        count -= 1
    order = (_ORDERS if has_label else _WITHOUT_LABEL).get(count)
    if order is None:
        raise PointFileError(
            f"{name}:{line}: {len(cells)} columns; a line is: {_FORM}; of more columns a first line has to name these"
        )
    return {key: _Column(at) for at, key in enumerate(order)}


def _has_decimal_comma(name: str, rows: Sequence[_Row]) -> bool:
    """Whether numbers have decimal commas. ``PointFileError``: some have, and others have decimal points."""
    numbers = [(row.line, one) for row in rows for one in row.numbers]
    commas = [(line, one) for line, one in numbers if _BY_COMMA.match(one) and not _BY_POINT.match(one)]
    points = [(line, one) for line, one in numbers if _BY_POINT.match(one) and not _BY_COMMA.match(one)]
    if not commas and not points:
        commas = [(line, one) for line, one in numbers if "," in one]
        points = [(line, one) for line, one in numbers if "." in one]
    if commas and points:
        (first, comma), (second, point) = commas[0], points[0]
        raise PointFileError(
            f"{name}:{first}: {comma} has a decimal comma, {point} in line {second} a decimal point; write all alike"
        )
    return bool(commas)


def _plain(cell: str) -> str:
    return _GAPS.sub("", cell.replace("\u2212", "-"))


def _is_number(cell: str) -> bool:
    return any(_number(_plain(cell), has_decimal_comma) is not None for has_decimal_comma in (False, True))


def _number(text: str, has_decimal_comma: bool) -> float | None:
    """The value of a plain cell; None if it is no number."""
    if not any(sign.isdigit() for sign in text) or not (_BY_COMMA if has_decimal_comma else _BY_POINT).match(text):
        return None
    return float(text.replace(".", "").replace(",", ".") if has_decimal_comma else text.replace(",", ""))


def _reading(name: str, row: _Row, unit: str, has_decimal_comma: bool) -> Reading:
    where, values = f"{name}:{row.line}", {}
    for key, column in row.columns.items():
        cell = row.cells[column.at] if column.at < len(row.cells) else ""
        if key == "used" and cell.lower() not in _YES:
            raise PointFileError(f"{where}: is marked {cell!r}: put # before a line that is not to be used")
        if key in ("label", "used"):
            continue
        number = _number(_plain(cell), has_decimal_comma)
        if number is None:
            what = repr(cell) if cell else "nothing"
            raise PointFileError(f"{where}: {key} is {what}, which is no number; put # before a line that is no point")
        values[key] = number * UNITS_M[column.unit or unit]
    label = row.columns.get("label")
    sigmas = None
    if "sigma" in values:
        sigmas = (values["sigma"],) * 3
    elif "sx" in values:
        sigmas = values["sx"], values["sy"], values["sz"]
    if sigmas is not None:
        _check_sigmas(where, sigmas)
    text = "" if label is None or label.at >= len(row.cells) else row.cells[label.at]
    return Reading(row.line, text, (values["x"], values["y"], values["z"]), sigmas)


def _check_sigmas(where: str, sigmas: Vector3) -> None:
    if not all(one > 0.0 for one in sigmas):
        raise PointFileError(
            f"{where}: a sigma is not positive; name the columns in a header, or leave them out and give --sigma-um"
        )
    for one in sigmas:
        if not is_of_coordinate(one):
            raise PointFileError(
                f"{where}: a sigma of {1e6 * one:.3g} um is none of a coordinate; name the columns and their units in "
                "a header, as in label,x_mm,y_mm,z_mm,sx_um,sy_um,sz_um"
            )


def is_of_coordinate(sigma_m: float) -> bool:
    """Whether an instrument may measure so; otherwise the number has another unit, or is something else."""
    return _LEAST_SIGMA_M <= sigma_m <= _MOST_SIGMA_M
