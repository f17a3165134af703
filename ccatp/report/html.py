"""Common parts of all pages: templates, numbers as text, figures in two layouts, files, log lines."""

import json
import os
import re
from base64 import b64encode
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from functools import cache, partial
from hashlib import sha256
from itertools import chain, zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from ccatp.records.state_log import LogLine
from ccatp.report.plots import NARROW, WIDE, save_figure, svg_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DASH = "\u2013"
MICRO = 1e6
SCRIPT = (Path(__file__).parent / "templates" / "zoom.js").read_text(encoding="utf-8")
# The page contains all its data: it loads, sends and embeds nothing, and runs only this script.
POLICY = (
    f"default-src 'none'; script-src 'sha256-{b64encode(sha256(SCRIPT.encode()).digest()).decode()}'; "
    "style-src 'unsafe-inline'; img-src data:; base-uri 'none'; form-action 'none'"
)
_FEW_LINES = 40  # a larger number of notable lines is shown by kinds
_KINDS, _LINES_AT_AN_END = 100, 200
_MOST_ROWS = 100  # of a list whose length a damaged run determines
_BEGIN = "run started"  # more than once: the run was resumed
_STATISTICS = ("gate statistics", "reading statistics")
_OVER = LogLine("", None, "info", "", "The mission is over: the processes close their connections and end.")
_CALM = ("info", "debug")
# Lines that are always shown, independent of their log level.
_GRAVE = re.compile(
    r"(?i)\banew\b|restarted|\babort|emergenc|was killed|\bdied\b|link lost|returning to base|interrupted"
)
# The name of a point or an address is one token; a number may have a fraction.
_TOKEN = re.compile(r"\d+(?:[-/:.]\d+){2,}|\d+(?:\.\d+)?(?:e[+-]?\d+)?")

_DPI = 192.0  # of PNG files: two pixels for each of the page
Draw = Callable[[float], "Figure"]


def page_figures(drawings: Mapping[str, Draw]) -> dict[str, tuple[Markup, Markup]]:
    """Each figure in two layouts, for a screen and for a phone; the page shows one of them."""

    def layout(width_px: float) -> list[str]:
        return [inline(draw(width_px)) for draw in drawings.values()]

    wide, narrow = beside(partial(layout, WIDE), partial(layout, NARROW))
    # matplotlib and ElementTree escape every text in the figures.
    pairs = zip(drawings, wide, narrow, strict=True)
    return {name: (Markup(one), Markup(other)) for name, one, other in pairs}  # noqa: S704


def beside(first: Callable[[], list[str]], second: Callable[[], list[str]]) -> tuple[list[str], list[str]]:
    """The results of both; a process with a single thread computes the second in a fork, on another core."""
    if not _has_single_thread():
        return first(), second()
    reader, writer = os.pipe()
    if (pid := os.fork()) == 0:
        os.close(reader)
        with suppress(BaseException):  # the parent computes it again, and reports what fails
            with os.fdopen(writer, "w", encoding="utf-8") as out:
                json.dump(second(), out)
            os._exit(0)
        os._exit(1)
    os.close(writer)
    try:
        with os.fdopen(reader, encoding="utf-8") as found:
            own, text = first(), found.read()
    finally:
        _, status = os.waitpid(pid, 0)
    others: list[str] = second() if status else json.loads(text)
    return own, others


def _has_single_thread() -> bool:
    """Whether this process can be forked: a lock that another thread holds would be held in the fork for ever."""
    tasks = Path("/proc/self/task")
    return tasks.is_dir() and len(list(tasks.iterdir())) == 1


def inline(figure: "Figure") -> Markup:
    """A figure as an element of the page."""
    return Markup(svg_of(figure))  # noqa: S704 - matplotlib and ElementTree escape every text in it


class RunReport(NamedTuple):
    """The report of a run: page, output of ``ccatp report --json``, figures by file name, warnings.

    ``write_tables``: writes its tables into a directory; ``None``: this kind of mission has none.
    """

    markup: str
    data: dict[str, Any]
    drawings: dict[str, Draw]
    warnings: tuple[str, ...]
    write_tables: Callable[[Path], None] | None = None


def render(template: str, **values: Any) -> str:
    """The page as one HTML file without external resources; a template of another package: ``package:name``."""
    package, _, name = template.rpartition(":")
    return environment(package).get_template(name).render(values)


@cache
def environment(package: str = "") -> Environment:
    """The templates of a package and of this one, every text escaped, with the filters of this module."""
    packages = dict.fromkeys((package or "ccatp.report", "ccatp.report"))
    found = Environment(
        loader=ChoiceLoader([PackageLoader(name) for name in packages]), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    found.filters.update(num=number_text, um=micro_text, clock=clock_text)
    found.globals.update(dash=DASH, policy=POLICY, script=Markup(SCRIPT), most=_MOST_ROWS)  # noqa: S704 - a file of ours
    return found


def number_text(value: float | str | None, decimals: int = 2) -> str:
    """A number as text: a dash if it is not known, a typographic minus, no negative zero."""
    if value is None:
        return DASH
    if not isinstance(value, float):
        return str(value)
    number = f"{value:.{decimals}f}"
    return number.replace("-", "\u2212" if number.strip("-0.") else "")


def micro_text(value: float, decimals: int = 1) -> str:
    """A length in m as micrometres, an angle in rad as microradians."""
    return number_text(float(value) * MICRO, decimals)


def clock_text(time_s: float) -> str:
    """``3091.4`` as ``51 min 31 s``."""
    minutes, seconds = divmod(round(time_s), 60)
    return f"{minutes} min {seconds:02d} s" if minutes else f"{seconds} s"


# -- files ------------------------------------------------------------------------------------------------------------


def write_pictures(drawings: dict[str, Draw], folder: Path) -> None:
    """Write figures as SVG, PNG and PDF into a folder that ``check_drawing`` has made; PictureError: one cannot be."""
    for name, draw in drawings.items():
        picture = draw(WIDE)
        for suffix in (".svg", ".png", ".pdf"):
            save_figure(picture, folder / f"{name}{suffix}", _DPI)


# -- lines of the log -------------------------------------------------------------------------------------------------


class Gathered(NamedTuple):
    """Lines that differ only in their numbers, and their common text."""

    text: str
    lines: tuple[LogLine, ...]
    rank: int  # 0 errors, 1 lines that are always shown, 2 warnings, 3 the rest


class Events(NamedTuple):
    """The parts of a log that the page shows."""

    total: int
    notable: Sequence[LogLine]  # warnings, errors, and lines that are always shown
    kinds: Sequence[Gathered]  # in place of many notable lines; the most severe, then the rarest first
    kinds_left_out: int
    first: Sequence[LogLine]  # at both ends
    last: Sequence[LogLine]
    left_out: int


def events_of(lines: Sequence[LogLine]) -> Events:
    """The parts of a log that the page shows; their number is limited."""
    found = [kind for kind in gathered(lines) if kind.rank < 3]
    notable = {id(line) for kind in found for line in kind.lines}
    kinds = sorted(found, key=lambda kind: (kind.rank, len(kind.lines))) if len(notable) > _FEW_LINES else []
    all_lines = [*lines]
    if (end := _end_of(lines)) is not None:
        all_lines.insert(end, _OVER)
    first, others = all_lines[:_LINES_AT_AN_END], all_lines[_LINES_AT_AN_END:]
    last = others[-_LINES_AT_AN_END:]
    return Events(
        total=len(lines),
        notable=[] if kinds else [line for line in lines if id(line) in notable],
        kinds=kinds[:_KINDS],
        kinds_left_out=len(kinds[_KINDS:]),
        first=first,
        last=last,
        left_out=len(lines) - sum(line is not _OVER for line in (*first, *last)),
    )


def _end_of(lines: Sequence[LogLine]) -> int | None:
    """Index of main's line that its mission is over; connections that close after it are not lost."""
    own = [at for at, line in enumerate(lines) if line.process == "main" and line.text.startswith(_STATISTICS)]
    return own[-1] if own and lines[-1].text.startswith("run finished") else None


def gathered(lines: Iterable[LogLine]) -> list[Gathered]:
    """Lines grouped by process, level and text without numbers, in the order of the first line of each group.

    In the common text the range of the values replaces each number that varies.
    """
    kinds: dict[tuple[str, ...], list[LogLine]] = {}
    for line in lines:
        kinds.setdefault((line.process, line.level, *_TOKEN.split(line.text)), []).append(line)
    found = []
    for alike in kinds.values():
        first = alike[0]
        columns = zip(*(_TOKEN.findall(line.text) for line in alike), strict=True)
        parts = zip_longest(_TOKEN.split(first.text), map(_span, columns), fillvalue="")
        text = "".join(chain.from_iterable(parts))
        rank = 0 if first.level in ("error", "critical") else 3 if first.level in _CALM else 2
        is_grave = _GRAVE.search(first.text) or (first.text.startswith(_BEGIN) and len(alike) > 1)
        found.append(Gathered(text, tuple(alike), 1 if rank and is_grave else rank))
    return found


def _span(values: Sequence[str]) -> str:
    found = list(dict.fromkeys(values))
    if len(found) == 1:
        return found[0]
    try:
        return f"{min(found, key=float)} to {max(found, key=float)}"
    except ValueError:
        return f"{found[0]} and {len(found) - 1} other{'s' if len(found) > 2 else ''}"
