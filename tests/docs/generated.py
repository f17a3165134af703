"""The parts of the documentation that are made from the code, between markers in its pages: ``make docs``.

A marker is a comment: ``<!-- made: NAME -->``, and ``<!-- made -->`` at its end. A test compares what stands between
them with what the code says now.
"""

import inspect
import re
import tomllib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import click

from ccatp.cli import cli
from ccatp.core import EventCode, Severity
from ccatp.daemon.supervisor import PROCESSES
from ccatp.links.topics import TOPICS
from tests.docs.alarm_scan import ROOT, causes

DOCS = ROOT / "docs"
MARKED = re.compile(r"(<!-- made: (\w+) -->\n).*?(<!-- made -->)", re.DOTALL)
REACTIONS = {
    "none": "nothing",
    "inform": "reported",
    "slow": "half the speed",
    "pause": "pause: wheels held, goes on by itself",
    "hold": "hold: wheels held, a fix, then on by itself",
    "return": "home",
    "fault": "fault: held until an operator resumes",
    "back off": "back off",
}


def table(head: str, rows: Iterable[Iterable[object]]) -> str:
    """A table of Markdown; ``head`` is its first line."""
    lines = [f"| {' | '.join(map(str, row))} |" for row in rows]
    return "\n".join([head, "|" + "---|" * (head.count("|") - 1), *lines])


def alarms() -> str:
    """Every cause with what it means."""
    known, rank = causes(), list(REACTIONS)
    catalogue = tomllib.loads((DOCS / "alarms.toml").read_text(encoding="utf-8"))["group"]
    parts = []
    for group in catalogue:
        rows = []
        for text, row in group["alarms"].items():
            reactions = sorted(known[text].reactions, key=rank.index) if text in known else []
            rows.append((text, ", or ".join(REACTIONS[name] for name in reactions), row["means"], row["do"]))
        about = [f"{group['about']}\n"] if group["about"] else []
        what = "| it says | what happens | what it means | what to do |"
        parts += [f"## {group['title']}\n", *about, table(what, rows), ""]
    return "\n".join(parts)


def severities() -> str:
    """The severities, least first."""
    names = [(severity, severity.name.lower()) for severity in Severity]
    return table("| | severity | what happens |", [(int(one), f"`{name}`", REACTIONS[name]) for one, name in names])


def topics() -> str:
    """The topic table."""
    rows = []
    for topic in TOPICS:
        rate = f"{topic.rate_hz:g}" if topic.rate_hz else "event"
        stale = f"{topic.stale_after_s:g}" if topic.stale_after_s else "\u2013"
        summary = (topic.message.__doc__ or "").strip().splitlines()[0]
        rows.append((f"`{topic.name}`", topic.publisher, rate, stale, "yes" if topic.recorded else "no", summary))
    return table("| topic | from | rate, Hz | stale after, s | recorded | message |", rows)


def processes() -> str:
    """The process table."""
    rows = []
    for process in PROCESSES:
        runs = "with `--sim`" if process.is_simulator else "always"
        dies = "restarted" if process.is_replaceable else "the run ends, held"
        rows.append((process.name, f"`{process.module}`", runs, dies))
    return table("| process | module | runs | when it dies |", rows)


def codes() -> str:
    """The event codes."""
    return table("| code | |", [(int(code), code.name.lower().replace("_", " ")) for code in EventCode])


def commands() -> str:
    """Every command with its first line of help and its options."""
    return "\n".join(_commands(cli, ("ccatp",)))


def _commands(group: click.Group, path: tuple[str, ...]) -> Iterator[str]:
    for name, command in sorted(group.commands.items()):
        own = (*path, name)
        if isinstance(command, click.Group):
            yield from _commands(command, own)
            continue
        usage = " ".join(
            [*own, *(p.make_metavar(click.Context(command)) for p in command.params if isinstance(p, click.Argument))]
        )
        yield f"## `{usage}`\n"
        paragraphs = inspect.cleandoc(command.help or "").replace("\b", "").strip()
        yield f"{paragraphs}\n"
        for option in command.params:
            if isinstance(option, click.Option) and not option.hidden:
                yield f"* {_option(option)}"
        yield ""


def _option(option: click.Option) -> str:
    names = ", ".join(f"`{name}`" for name in (*option.opts, *option.secondary_opts))
    return f"{names}: {option.help}" if option.help else names


MADE: dict[str, Callable[[], str]] = {
    "alarms": alarms,
    "severities": severities,
    "topics": topics,
    "processes": processes,
    "codes": codes,
    "commands": commands,
}


def pages() -> dict[Path, str]:
    """The pages with markers, as they should be."""
    found = {}
    for path in sorted(DOCS.glob("*.md")):
        text = path.read_text(encoding="utf-8")
        made = MARKED.sub(lambda match: f"{match[1]}{MADE[match[2]]().rstrip()}\n{match[3]}", text)
        if MARKED.search(text):
            found[path] = made
    return found


def main() -> None:
    """Write them."""
    for path, text in pages().items():
        if path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")
            print(path.relative_to(ROOT))


if __name__ == "__main__":
    main()
