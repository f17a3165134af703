"""Pure. What the processes said. Lines that differ in their numbers alone are gathered, so that none hides another."""

import re
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from ccatp.reporting.findings import Findings
from ccatp.reporting.html import folded, shown, table, text
from ccatp.reporting.page import Section
from ccatp.run_files.state_log import LogLine

_FEW = 40
_CLASSES = {"error": "bad", "critical": "bad", "warning": "mid"}
_CALM = ("info", "debug")
# What no reader may miss, at whatever level it was said.
_GRAVE = re.compile(r"(?i)\banew\b|\babort|emergenc|was killed|\bdied\b|link lost|returning to base|interrupted")
# The name of a point or an address is one token; a number may have a fraction.
_TOKEN = re.compile(r"\d+(?:[-/:.]\d+){2,}|\d+(?:\.\d+)?(?:e[+-]?\d+)?")


class Gathered(NamedTuple):
    """Lines of one kind: what they say, how often, and the first and the last of them."""

    text: str
    lines: tuple[LogLine, ...]

    @property
    def rank(self) -> int:
        """0 errors, 1 what no reader may miss, 2 warnings, 3 the rest."""
        first = self.lines[0]
        if _CLASSES.get(first.level) == "bad":
            return 0
        return 1 if _GRAVE.search(first.text) else 3 if first.level in _CALM else 2


def events_section(found: Findings) -> Section | None:
    """What the processes said."""
    lines = found.record.log
    return Section("events", "Events", events_body(lines)) if lines else None


def events_body(lines: Sequence[LogLine]) -> str:
    """Lines of a log: all of few, of many the kinds that matter, the gravest and then the rarest first."""
    whole = table(["robot, s", "UTC", "process", "what"], map(_event, lines), "texts log")
    if len(lines) <= _FEW:
        return whole
    kinds = sorted((kind for kind in gathered(lines) if kind.rank < 3), key=lambda kind: (kind.rank, len(kind.lines)))
    always = sum(kind.rank < 2 for kind in kinds)
    told = kinds[: max(always, _FEW)]
    some = table(["first", "last", "times", "process", "what"], map(_kind, told), "texts log") if told else ""
    some = some or "<p>No warnings, no errors.</p>"
    if len(told) < len(kinds):
        some += f"<p>and {len(kinds) - len(told)} more kinds of warnings.</p>"
    return some + folded(f"All {len(lines)} lines", whole)


def gathered(lines: Iterable[LogLine]) -> list[Gathered]:
    """Lines by process, level and text but for its numbers, in the order of their first."""
    kinds: dict[tuple[str, ...], list[LogLine]] = {}
    for line in lines:
        kinds.setdefault((line.process, line.level, *_TOKEN.split(line.text)), []).append(line)
    return [Gathered(_common(alike), tuple(alike)) for alike in kinds.values()]


def _common(lines: Sequence[LogLine]) -> str:
    """The text, each number that varies as the span of its values: the worst of them is one of its ends."""
    first = lines[0].text
    columns = zip(*(_TOKEN.findall(line.text) for line in lines), strict=True)
    spans = iter([_span(values) for values in columns])
    return _TOKEN.sub(lambda _: next(spans), first)


def _span(values: Sequence[str]) -> str:
    found = list(dict.fromkeys(values))
    if len(found) == 1:
        return found[0]
    try:
        return f"{min(found, key=float)} to {max(found, key=float)}"
    except ValueError:
        return f"{found[0]} and {len(found) - 1} other{'s' if len(found) > 2 else ''}"


def _event(line: LogLine) -> list[str]:
    wall = line.wall[11:19] or shown(None)
    return [shown(line.t_s), text(wall), text(line.process), _marked(line.level, line.text)]


def _kind(kind: Gathered) -> list[str]:
    first, last = kind.lines[0], kind.lines[-1]
    times = [_when(first), _when(last), text(len(kind.lines))]
    return [*times, text(first.process), _marked(first.level, kind.text)]


def _when(line: LogLine) -> str:
    """Robot time where it is known."""
    return f"{shown(line.t_s)} s" if line.t_s is not None else text(line.wall[11:19]) or shown(None)


def _marked(level: str, words: str) -> str:
    kind = _CLASSES.get(level)
    return (f'<strong class="{kind}">{text(level)}</strong> ' if kind else "") + text(words)
