"""The parts of the documentation that are made from the code, between markers in its pages: ``make docs``.

A marker is a comment: ``<!-- made: NAME -->``, and ``<!-- made -->`` at its end. A test compares what stands between
them with what the code says now.
"""

import inspect
import re
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import click

import ccatp.onboard.devices.daq
from ccatp.beacons.conditions import GROUP as BEACONS
from ccatp.beacons.mission import RULES
from ccatp.cli import cli
from ccatp.conditions import (
    Action,
    Condition,
    Group,
    all_conditions,
)
from ccatp.conditions.danger import SAMPLE_RATES
from ccatp.config.files import write_durably
from ccatp.config.robot_limits import LIMITS
from ccatp.core import EventCode, Severity
from ccatp.daemon.supervision.supervisor import PROCESSES
from ccatp.links.topics import all_topics
from ccatp.survey.failsafe import ROWS
from tests.contract.broken_servers import TABLES

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
MARKED = re.compile(r"(<!-- made: (\w+) -->\n).*?(<!-- made -->)", re.DOTALL)
ABOUT = {
    Group.EDGES: (
        "The robot stops, backs off along its path, takes a fix, and continues. No operator is "
        "needed unless the edge occurs again at the same place. Code 1."
    ),
    Group.DATA: (
        "Nothing moves on data older than 0.15 s. The wheels are held, and the survey continues as soon "
        "as the data are fresh. If the condition lasts longer than `health.pause_limit_s`, a fix follows; if it lasts "
        "longer than `health.hold_limit_s`, it is a fault."
    ),
    Group.SENSORS: ("A faulty sensor is not used if the other sensors are sufficient. Otherwise the robot is held."),
    Group.WHEELS: (
        "The wheels are held. A fix follows a temporary condition. A condition that recurs more than "
        "`health.retries` times is a fault."
    ),
    Group.FANS: (
        "On an overhanging mirror the fans carry the robot: what is wrong with them sends it home or holds it, with "
        "the fans at full duty; on other mirrors it is only reported. A low battery sends it home on every mirror."
    ),
    Group.SURVEY: "Most of these hold the robot until an operator decides: resume, abort, or stop.",
    BEACONS: (
        "Missions of robots among radio beacons (`system` in the configuration). They have no laser system: a hold, "
        "also one of the conditions above, ends without a fix."
    ),
    Group.STORAGE: "A fix counts once it is on the disk; the survey does not continue without it.",
    Group.OBSERVATORY: (
        "Code 2, latched until it is cleared by its id (`ccatp clear ID`), across restarts of processes and of the "
        "service."
    ),
}


# What ends a reaction that its action describes completely.
ENDS = dict.fromkeys((Action.RETURN, Action.ABORT, Action.EARTHQUAKE), "by an operator") | {
    Action.INFORM: "by itself",
    Action.SLOW: "by itself",
    Action.KEEP_AWAY: "by itself",
    Action.RETREAT: "after a fix",
    Action.WAIT: "after a fix",
}


def table(head: str, rows: Iterable[Iterable[object]]) -> str:
    """A table of Markdown; ``head`` is its first line."""
    lines = [f"| {' | '.join(map(str, row))} |" for row in rows]
    return "\n".join([head, "|" + "---|" * (head.count("|") - 1), *lines])


def alarms() -> str:
    """Every condition: what happens, and what to do."""
    what = "| message | found by | reaction | permitted motion | ends | limit | acts next | meaning | what to do |"
    parts = []
    for group in dict.fromkeys((*Group, *(row.group for row in all_conditions()))):
        rows = [_alarm(row) for row in all_conditions() if row.group == group]
        parts += [f"## {group}\n", *([f"{ABOUT[group]}\n"] if group in ABOUT else []), table(what, rows), ""]
    return "\n".join(parts)


def shown(message: str) -> str:
    """A message with an ellipsis for what varies."""
    return re.sub(r"\{[^{}]*\}", "\u2026", message)


def _alarm(row: Condition) -> tuple[str, ...]:
    limit = f"`{row.limit}`: {row.raised_severity.name.lower()}" if row.limit else ""
    retries = "" if row.retries is None else f"; at the {('first', 'second')[row.retries]} return: fault"
    return (
        shown(row.message),
        row.owner.value,
        row.action.value,
        row.motion.value,
        row.clear.value if row.clear is not None else ENDS[row.action],
        limit + retries,
        f"{row.actor}{f'; people: {row.then}' if row.then else ''}",
        row.meaning,
        row.advice,
    )


def reactions() -> str:
    """Reactions of missions to verdicts, in the order of precedence."""
    rows = [(str(k), row.when, row.action.value, "yes" if row in RULES.rows else "") for k, row in enumerate(ROWS, 1)]
    rows += [("", row.when, row.action.value, "yes") for row in RULES.rows if row not in ROWS]
    return table("| | when | what happens | also among beacons |", rows)


def severities() -> str:
    """The severities, lowest first."""
    rows = [(int(one), f"`{one.name.lower()}`", Action[one.name].value if one else "nothing") for one in Severity]
    return table("| | severity | what happens |", rows)


def topics() -> str:
    """The topic table."""
    rows = []
    for topic in all_topics():
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


def rates() -> str:
    """The sample rates that the daemon needs."""
    rows = [(f"`{name}`", *map("{:g}".format, rate[1:])) for name, rate in SAMPLE_RATES.items()]
    return table("| list | at full speed, samples/s | held below, samples/s |", rows)


def limits() -> str:
    """The limits of a robot."""
    rows = [(f"`{name}`", f"{low:g}", f"{high:g}", unit) for name, ((low, high), unit) in LIMITS.items()]
    return table("| of the `hello` | from | to | unit |", rows)


def codes() -> str:
    """The event codes."""
    return table("| code | |", [(int(code), code.name.lower().replace("_", " ")) for code in EventCode])


def commands() -> str:
    """Every command with its first line of help and its options."""
    return "\n".join(_commands(cli, ("ccatp",)))


def _commands(group: click.Group, path: tuple[str, ...]) -> Iterator[str]:
    context = click.Context(group)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        assert command is not None
        own = (*path, name)
        if not isinstance(command, click.Group) or command.invoke_without_command:
            yield from _command(command, own)
        if isinstance(command, click.Group):
            yield from _commands(command, own)


def _command(command: click.Command, own: tuple[str, ...]) -> Iterator[str]:
    arguments = (p.make_metavar(click.Context(command)) for p in command.params if isinstance(p, click.Argument))
    yield f"## `{' '.join([*own, *arguments])}`\n"
    for paragraph in inspect.cleandoc(command.help or "").split("\n\n"):
        lines = paragraph.strip().removeprefix("\b\n")
        # click wraps a paragraph, but not one that begins with \b: a table.
        yield f"{lines}\n" if lines == paragraph.strip() else f"```text\n{lines}\n```\n"
    for option in command.params:
        if isinstance(option, click.Option) and not option.hidden:
            yield f"* {_option(option)}"
    yield ""


def _option(option: click.Option) -> str:
    names = ", ".join(f"`{name}`" for name in (*option.opts, *option.secondary_opts))
    return f"{names}: {option.help}" if option.help else names


def seeded() -> str:
    kinds = [(kind, rows, [row for row in rows if row.fails]) for kind, rows in TABLES.items()]
    found, all_of_them = sum(len(seen) for *_, seen in kinds), sum(len(rows) for _, rows, _ in kinds)
    counted = table("| kind | seeded | found |", ((kind, len(rows), len(seen)) for kind, rows, seen in kinds))
    faults = (
        (row.name, ", ".join(f"`{name}`" for name in row.fails.split()) or "none")
        for _, rows, _ in kinds
        for row in rows
    )
    share = f"{found} of {all_of_them} seeded faults are found ({100.0 * found / all_of_them:.0f} %)."
    return "\n\n".join([share, counted, table("| one thing is wrong | found by |", faults)])


def daq() -> str:
    about = inspect.cleandoc(ccatp.onboard.devices.daq.__doc__ or "")
    return f"```text\n{about.partition(chr(10))[2].strip()}\n```"


MADE: dict[str, Callable[[], str]] = {
    "alarms": alarms,
    "severities": severities,
    "reactions": reactions,
    "topics": topics,
    "processes": processes,
    "codes": codes,
    "rates": rates,
    "limits": limits,
    "commands": commands,
    "seeded": seeded,
    "daq": daq,
}


def pages() -> dict[Path, str]:
    """The pages with markers, as they should be."""
    found = {}
    for path in sorted(DOCS.rglob("*.md")):
        text = path.read_text(encoding="utf-8")
        made = MARKED.sub(lambda match: f"{match[1]}{MADE[match[2]]().rstrip()}\n{match[3]}", text)
        if MARKED.search(text):
            found[path] = made
    return found


def main() -> None:
    """Write those that differ, each at once: somebody may be reading them."""
    for path, text in pages().items():
        if path.read_text(encoding="utf-8") != text:
            write_durably(path, text.encode())
            print(path.relative_to(ROOT))


if __name__ == "__main__":
    main()
