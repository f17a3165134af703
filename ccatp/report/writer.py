"""Writes the report of a run, and the comparison of two: a page, and figures where asked for."""

from pathlib import Path
from typing import Any, NamedTuple

from ccatp.errors import CcatpError, ExitStatus
from ccatp.report.beacon_page import beacon_data, beacon_drawings, beacon_page
from ccatp.report.beacon_record import read_beacon_record
from ccatp.report.compare import RunPair, compare_drawings, compare_page, pair_of
from ccatp.report.findings import findings_of
from ccatp.report.html import Draw
from ccatp.report.plots import WIDE, PictureError, save_figure
from ccatp.report.record import is_beacon_run, read_record
from ccatp.report.run_page import run_data, run_drawings, run_page

_DPI = 192.0  # of PNG files: two pixels for each of the page
REPORT, COMPARISON = "report.html", "compare.html"


class ReportError(CcatpError):
    """A report that cannot be written."""

    exit_status = ExitStatus.USAGE


class Report(NamedTuple):
    """A report that was written."""

    path: Path
    data: dict[str, Any]
    warnings: tuple[str, ...]


def report_run(run_dir: Path, out: Path | None = None, figures: Path | None = None) -> Report:
    """Write the report of a run.

    Args:
        out: the page; ``report.html`` in the run directory if not given.
        figures: a directory for the figures as SVG, PNG and PDF; none are written if not given.

    Raises:
        RunReadError: no run there.
        ConfigError: its configuration cannot be used.
        ReportError: the page cannot be written.
        PictureError: a figure cannot be written.
    """
    path = out or run_dir / REPORT
    if is_beacon_run(run_dir):
        record = read_beacon_record(run_dir)
        markup, data, pictures = beacon_page(record), beacon_data(record), beacon_drawings(record)
        warnings = record.warnings
    else:
        found = findings_of(read_record(run_dir))
        markup, data, pictures = run_page(found), run_data(found), run_drawings(found)
        warnings = found.record.warnings
    write_page(markup, path)
    if figures is not None:
        write_pictures(pictures, figures)
    return Report(path, data, warnings)


def compare_runs(run_a: Path, run_b: Path, out: Path, figures: Path | None = None) -> RunPair:
    """Write two runs beside each other.

    Args:
        figures: a directory for the figures; none are written if not given.

    Raises:
        CcatpError: as ``report_run``.
    """
    pair = pair_of(findings_of(read_record(run_a)), findings_of(read_record(run_b)))
    write_page(compare_page(pair), out)
    if figures is not None:
        write_pictures(compare_drawings(pair), figures)
    return pair


def write_page(markup: str, path: Path) -> None:
    """Write a page, complete or not at all.

    Raises:
        ReportError: it cannot be written.
    """
    new = path.with_name(path.name + ".new")
    try:
        new.write_text(markup, encoding="utf-8")
        new.replace(path)
    except OSError as error:
        raise ReportError(f"{path}: cannot be written: {error.strerror or error}") from error


def write_pictures(drawings: dict[str, Draw], folder: Path) -> None:
    """Write figures as SVG, PNG and PDF.

    Raises:
        PictureError: one cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise PictureError(f"{folder}: cannot be made: {error.strerror or error}") from error
    for name, draw in drawings.items():
        picture = draw(WIDE)
        for suffix in (".svg", ".png", ".pdf"):
            save_figure(picture, folder / f"{name}{suffix}", _DPI)
