"""Pure. What stands above the sections of every report: what kind of run it was, how it ended, what is missing."""

from collections.abc import Mapping, Sequence

from ccatp.reporting.html import facts, listed, text
from ccatp.reporting.record import Outcome, RunFiles


def head(
    record: RunFiles, chip: str, title: str, outcome: Outcome, warnings: Sequence[str], headline: Mapping[str, str]
) -> str:
    """The head as markup.

    Args:
        record: the run.
        chip: of ``chips``.
        title: the heading.
        outcome: how it ended.
        warnings: one line each.
        headline: figures by name, as markup.
    """
    began = next((line.wall[:19].replace("T", " ") + " UTC" for line in record.log if line.wall), "")
    cause = f": {text(outcome.cause)}" if outcome.cause else ""
    return (
        f"{chip}<h1>{text(title)}</h1>"
        f'<p class="quiet">{text(record.name)}{f", begun {text(began)}" if began else ""}</p>'
        f'<p><strong class="{"good" if outcome.is_good else "bad"}">{text(outcome.text)}</strong>{cause}</p>'
        f"{gaps(record, warnings)}{facts(headline)}"
    )


def chips(is_simulation: bool | None, simulated: str) -> str:
    """What kind of run it was, so that nobody takes a simulation for the telescope.

    Args:
        is_simulation: None where no recording tells.
        simulated: which simulation it was.
    """
    if is_simulation:
        return f'<span class="chip sim">SIMULATION, {text(simulated)}</span>'
    known = "real robot" if is_simulation is False else "robot or simulation: no recording tells"
    return f'<span class="chip">{known}</span>'


def gaps(record: RunFiles, warnings: Sequence[str]) -> str:
    """What is missing or damaged, as boxes; empty where all is there."""
    return "".join(
        f'<div class="box"><strong>{title}</strong>{listed(lines)}</div>'
        for title, lines in (("Not in this run", record.missing), ("Warnings", warnings))
        if lines
    )


def foot(record: RunFiles) -> str:
    """The last line of a report, as markup."""
    return f"Made by <code>ccatp report</code> from {text(record.name)}; this file needs nothing else."
