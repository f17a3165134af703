"""Reads points of other instruments: CSV, and the text exports of laser trackers and photogrammetry.

A line has a label, x, y, z, and one sigma or one for each axis; label and sigmas may be missing. Separators are tabs,
semicolons, commas or blanks; numbers may have a decimal comma and separators of thousands. A header may name columns in
any order, their units, and of how many standard deviations an uncertainty is; the label may be in several columns.
"""

import csv
import re
from collections.abc import Callable, Mapping, Sequence
from math import isfinite
from typing import NamedTuple

from ccatp.core import Vector3
from ccatp.errors import UsageError

UNITS_M = {"mm": 1e-3, "m": 1.0, "um": 1e-6}
_OTHER_UNITS = ("nm", "cm", "km", "in", "inch", "inches", "ft", "feet", "mil", "mils")
_NAMES = {
    "row": ("row", "zeile", "reihe", "ligne", "rangee", "rang\u00e9e", "fila"),
    "col": ("col", "column", "spalte", "colonne", "columna"),
    "panel": ("panel", "panelid", "panelname", "panelnumber", "panelno", "panelnr", "paneel", "panneau"),
    "label": (
        "label", "name", "point", "points", "pt", "pnt", "pointid", "pointname", "pointlabel", "pointnumber", "pointno",
        "pointnr", "ptid", "id", "no", "nr", "num", "number", "target", "targetlabel", "targetid", "targetname",
        "punkt", "punkte", "punktid", "punktname", "punktnummer", "punktnr", "nummer", "nom", "numero", "num\u00e9ro",
        "punto", "nombre", "bezeichnung",
    ),
    "x": ("x",), "y": ("y",), "z": ("z",), **{f"s{axis}": tuple(
        f"{word}{axis}" for word in ("s", "sigma", "u", "std", "stddev", "uncertainty", "uncertaintyu", "u95")
    ) for axis in "xyz"}, "sigma": ("sigma", "s", "std", "stddev", "u", "uncertainty", "u95"),
    "used": ("enabled", "active", "used", "use"),
}  # fmt: skip
_NAMING = ("row", "col", "panel", "label")  # columns that together name a point
# Names of panels and points: ours, as 3/7 or 3/7/4, and the observatory's, as 12281 or 01-012281.
OUR_NAME = re.compile(r"(\d{1,2})[/-](\d{1,2})(?:[/-](\w+))?$")
OBSERVATORY_NAME = re.compile(r"(?:\d\d-\d\d|\d)([12])([1-9])([1-9])\d(?:\D.*)?$")
# Of how many standard deviations an uncertainty is: "(1.0 sigma)", "k=2".
_COVERAGE = re.compile(r"(?:(\d+(?:\.\d+)?)[ -]*(?:sigma|\u03c3)|\bk ?= ?(\d+(?:\.\d+)?))")
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
    """Where a value stands in a line, its unit by the header, and of how many standard deviations it is."""

    at: int
    unit: str | None = None
    coverage: float | None = None


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
            if key not in (*_NAMING, "used") and column.at < len(self.cells)
        ]


def parse_points(text: str, name: str, unit: str | None = None) -> tuple[Reading, ...]:
    """The readings of a file; ``unit``: of its lengths, if the header does not name it (mm without either)."""
    lines = [(number, line) for number, line in enumerate(text.splitlines(), 1) if _is_data(line)]
    if not lines:
        raise PointFileError(f"{name}: no points in it; a line is: {_FORM}")
    separator = _separator([line for _, line in lines])
    cells = [(number, _split(line, separator)) for number, line in lines]
    header: Mapping[str, _Column] = _header(f"{name}:{cells[0][0]}", cells[0][1])
    if header:
        cells = cells[1:]
        if not cells:
            raise PointFileError(f"{name}: a header and no points; a line is: {_FORM}")
    header = _with_names(f"{name}:{lines[0][0]}", header, cells, _split(lines[0][1], separator))
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
    """The separator that stands in most lines; None for blanks. A line without it is refused when it is read."""

    def most(have: Callable[[str], bool]) -> bool:
        return 2 * sum(map(have, lines)) > len(lines)

    if most(lambda line: "\t" in line):
        return "\t"
    if most(lambda line: ";" in line):
        return ";"
    is_comma = most(lambda line: line.count(",") >= 2) and not most(lambda line: len(line.split()) >= 4)
    return "," if is_comma or most(lambda line: ", " in line) else None


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
        text = cell.lower().replace("\u00b5", "u").replace("\u03bc", "u")
        coverage = _COVERAGE.search(text)
        words = re.sub(r"[^\w]|_", " ", text if coverage is None else text.replace(coverage[0], " ")).split()
        unit = words.pop() if len(words) > 1 and words[-1] in (*UNITS_M, *_OTHER_UNITS) else None
        key = next((key for key, names in _NAMES.items() if "".join(words) in names), None)
        if key is None or (key == "label" and key in found):
            continue
        if unit in _OTHER_UNITS:
            raise PointFileError(f"{where}: {cell!r} is in {unit}; export it in one of {', '.join(UNITS_M)}")
        if key in found:
            raise PointFileError(f"{where}: two columns are {key}; leave the other values of the points out")
        found[key] = _Column(at, unit, _coverage(where, cell, coverage) if key in (*_SIGMAS, "sigma") else None)
    if set(_PLACE) <= found.keys():
        if 0 < len(found.keys() & set(_SIGMAS)) < len(_SIGMAS):
            raise PointFileError(f"{where}: not all of sx, sy, sz; give the three, or one column sigma")
        if len({found[key].coverage for key in _SIGMAS if key in found}) > 1:
            raise PointFileError(
                f"{where}: {cells[found['sx'].at]!r} and the two others are not of as many sigmas; name it for each, "
                "as in Ux (2 sigma)"
            )
        if ("row" in found) != ("col" in found):
            raise PointFileError(f"{where}: of row and col one is missing; give both, or a label as 3/7/4")
        return found
    if not any(_is_number(cell) for cell in cells):
        raise PointFileError(
            f"{where}: neither a point nor a header with the columns x, y and z; put # before a line that is neither"
        )
    return {}


def _coverage(where: str, cell: str, named: re.Match[str] | None) -> float:
    """Of how many standard deviations an uncertainty is. ``PointFileError``: expanded ones (U) that do not say it."""
    if named is not None:
        factor = float(named[1] or named[2])
        if factor <= 0.0:
            raise PointFileError(f"{where}: {cell!r}: an uncertainty of {factor:g} sigma is none")
        return factor
    if "95" in cell:
        return 2.0  # as instruments state it
    if cell.lstrip().startswith(("U", "uncertainty")):
        raise PointFileError(
            f"{where}: {cell!r} does not say of how many sigmas it is; name it as in Ux (1 sigma) or Ux (2 sigma)"
        )
    return 1.0


def _is_name(cell: str) -> bool:
    return OUR_NAME.match(cell) is not None or OBSERVATORY_NAME.match(cell) is not None


def _with_names(
    where: str, header: Mapping[str, _Column], cells: Sequence[tuple[int, Sequence[str]]], words: Sequence[str]
) -> Mapping[str, _Column]:
    """The header with the column of the names, if no word names it: names must not be lost.

    ``PointFileError``: several columns have names, and no word says which one counts.
    """
    if not header or header.keys() & {"row", "panel"}:
        return header
    taken = {column.at for key, column in header.items() if key != "label"}
    found = [
        at
        for at in range(max(len(some) for _, some in cells))
        if at not in taken and all(at < len(some) and _is_name(some[at]) for _, some in cells)
    ]
    if not found or ("label" in header and header["label"].at in found):
        return header
    if len(found) > 1:
        which = " and ".join(repr(words[at] if at < len(words) else "") for at in found)
        raise PointFileError(f"{where}: columns {which} have names of panels; call the one that counts label")
    return {**header, "label": _Column(found[0])}


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
    if order is None and not any(map(_is_number, cells[-3:])):
        raise PointFileError(f"{name}:{line}: {' '.join(cells)[:40]!r} is no point; put # before such a line")
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
    value = float(text.replace(".", "").replace(",", ".") if has_decimal_comma else text.replace(",", ""))
    return value if isfinite(value) else None


def _reading(name: str, row: _Row, unit: str, has_decimal_comma: bool) -> Reading:
    where, values = f"{name}:{row.line}", {}
    for key, column in row.columns.items():
        cell = row.cells[column.at] if column.at < len(row.cells) else ""
        if key == "used" and cell.lower() not in _YES:
            raise PointFileError(f"{where}: is marked {cell!r}: put # before a line that is not to be used")
        if key in (*_NAMING, "used"):
            continue
        number = _number(_plain(cell), has_decimal_comma)
        if number is None:
            what = repr(cell) if cell else "nothing"
            raise PointFileError(f"{where}: {key} is {what}, which is no number; put # before a line that is no point")
        values[key] = number * UNITS_M[column.unit or unit] / (column.coverage or 1.0)
    sigmas = None
    if "sigma" in values:
        sigmas = (values["sigma"],) * 3
    elif "sx" in values:
        sigmas = values["sx"], values["sy"], values["sz"]
    if sigmas is not None:
        _check_sigmas(where, sigmas)
    return Reading(row.line, _label(where, row), (values["x"], values["y"], values["z"]), sigmas)


def _label(where: str, row: _Row) -> str:
    """The label of a line, of all columns that name its point: ``3/7/4`` of row, column and point, or of 3/7 and 4."""
    row_no, col_no, panel, label = (
        row.cells[column.at] if (column := row.columns.get(key)) is not None and column.at < len(row.cells) else ""
        for key in _NAMING
    )
    first = f"{row_no}/{col_no}" if row_no or col_no else panel
    if not first or first == label:
        return label
    if _is_name(label) and _is_name(first):
        if not re.match(re.escape(first.replace("-", "/")) + r"(\D|$)", label.replace("-", "/")):
            raise PointFileError(f"{where}: {first} and {label} name two panels; leave one of the columns out")
        return label
    # A bare number is no name of a panel: 5/3 of panel 5 and point 3 would be that of row 5, column 3.
    return f"{first}/{label}".rstrip("/") if _is_name(first) else f"{first} {label}".rstrip()


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
