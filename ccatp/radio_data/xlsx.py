"""Edge. Sheets of an .xlsx workbook as rows of text, by the standard library alone (ECMA-376 part 1)."""

import re
import zipfile
from pathlib import Path
from xml.etree import ElementTree as ET

from ccatp.radio_data.errors import RadioDataError

_MAIN = "{http://schemas.openxmlformats.org/spreadsheetml/2006/main}"
_RELATION = "{http://schemas.openxmlformats.org/officeDocument/2006/relationships}id"
_LARGEST_PART = 50_000_000  # bytes: a table that people measured is smaller, a bomb is not
_CELL = re.compile(r"([A-Z]{1,3})\d+")

Sheets = dict[str, list[list[str]]]


def read_workbook(file: Path) -> Sheets:
    """Rows of cells by name of the sheet, in the workbook's order; empty cells are empty text.

    Raises:
        RadioDataError: it is missing or no workbook.
    """
    try:
        with zipfile.ZipFile(file) as archive:
            shared = _shared_text(file, archive)
            targets = {r.get("Id"): r.get("Target") or "" for r in _part(file, archive, "xl/_rels/workbook.xml.rels")}
            sheets: Sheets = {}
            for sheet in _part(file, archive, "xl/workbook.xml").iter(f"{_MAIN}sheet"):
                part = "xl/" + targets.get(sheet.get(_RELATION), "").removeprefix("/xl/")
                sheets[sheet.get("name") or part] = _rows(_part(file, archive, part), shared)
    except FileNotFoundError as error:
        raise RadioDataError(file, "no such file") from error
    except (OSError, zipfile.BadZipFile) as error:
        raise RadioDataError(file, f"is no .xlsx workbook: {error}; save it as one, or as CSV") from error
    return sheets


def _part(file: Path, archive: zipfile.ZipFile, name: str) -> ET.Element:
    try:
        size = archive.getinfo(name).file_size
        if size > _LARGEST_PART:
            raise RadioDataError(file, f"{name} in it has {size} bytes; save the sheet as CSV")
        data = archive.read(name)
        if b"<!DOCTYPE" in data or b"<!ENTITY" in data:
            raise RadioDataError(file, f"{name} in it defines entities, which no workbook does; save it anew")
        return ET.fromstring(data)  # noqa: S314 - no entity gets here, and the size is limited
    except (KeyError, ET.ParseError) as error:
        raise RadioDataError(file, f"is no .xlsx workbook: {name} is missing or damaged; save it anew") from error


def _shared_text(file: Path, archive: zipfile.ZipFile) -> list[str]:
    name = "xl/sharedStrings.xml"
    if name not in archive.namelist():
        return []
    items = _part(file, archive, name).findall(f"{_MAIN}si")
    return ["".join(text.text or "" for text in item.iter(f"{_MAIN}t")) for item in items]


def _rows(sheet: ET.Element, shared: list[str]) -> list[list[str]]:
    rows = []
    for row in sheet.iter(f"{_MAIN}row"):
        cells: list[str] = []
        for cell in row.findall(f"{_MAIN}c"):
            place = _CELL.fullmatch(cell.get("r") or "")
            column = _column(place[1]) if place else len(cells)
            cells += [""] * (column + 1 - len(cells))
            cells[column] = _text(cell, shared)
        rows.append(cells)
    return rows


def _text(cell: ET.Element, shared: list[str]) -> str:
    value = cell.findtext(f"{_MAIN}v")
    if cell.get("t") == "inlineStr":
        return "".join(text.text or "" for text in cell.iter(f"{_MAIN}t"))
    if value is None:
        return ""
    if cell.get("t") == "s":
        return shared[int(value)] if value.isdecimal() and int(value) < len(shared) else ""
    return value


def _column(letters: str) -> int:
    """``A`` is 0, ``AA`` is 26."""
    number = 0
    for letter in letters:
        number = 26 * number + ord(letter) - ord("A") + 1
    return number - 1
