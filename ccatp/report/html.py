"""Pieces of a page: text that is safe, tables, and figures for a screen, a telephone and paper.

What stands above the sections of every report: what kind of run it was, how it ended, what is missing.

The page around the sections of a report: one HTML file that asks nobody for anything.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from html import escape
from typing import NamedTuple

from ccatp.report.drawing import Drawing, svg_of
from ccatp.report.record import PointOutcome, RunFiles

Cell = str | float | int | None
DASH = "\u2013"
WIDE, NARROW = 880.0, 380.0  # of figures, pixels: on a screen or paper, and on a telephone


def text(value: object) -> str:
    """Anything as text that no browser takes for markup."""
    return escape(str(value), quote=True)


def shown(value: Cell, decimals: int = 2) -> str:
    """A cell: a dash for what is not known, a typographic minus, never a negative zero."""
    if value is None:
        return DASH
    if isinstance(value, float):
        number = f"{value:.{decimals}f}"
        is_zero = not number.strip("-0.")
        return number.replace("-", "" if is_zero else "\u2212")
    return text(value)


def table(head: Sequence[str], rows: Iterable[Sequence[str]], kind: str = "") -> str:
    """A table that scrolls sideways where the page is too narrow; the first cell of a row is its name."""
    top = "".join(f'<th scope="col">{text(name)}</th>' for name in head)
    body = "".join(
        f'<tr><th scope="row">{first}</th>{"".join(f"<td>{cell}</td>" for cell in rest)}</tr>' for first, *rest in rows
    )
    return f'<div class="scroll"><table class="{kind}"><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>'


def facts(pairs: Mapping[str, str]) -> str:
    """Names and values beside each other; values are markup already."""
    return "<dl>" + "".join(f"<div><dt>{text(k)}</dt><dd>{v}</dd></div>" for k, v in pairs.items()) + "</dl>"


def figure(draw: Callable[[float], Drawing], caption: str) -> str:
    """A picture in two layouts, of which the page shows one."""
    wide, narrow = draw(WIDE), draw(NARROW)
    return (
        f'<figure><div class="wide">{svg_of(wide)}</div><div class="narrow">{svg_of(narrow)}</div>'
        f"<figcaption>{caption}</figcaption></figure>"
    )


def beside(pictures: Iterable[tuple[str, Drawing]]) -> str:
    """Pictures beside each other, below each other where the page is too narrow, each with its name."""
    figures = (f"<figure>{svg_of(picture)}<figcaption>{text(name)}</figcaption></figure>" for name, picture in pictures)
    return f'<div class="beside">{"".join(figures)}</div>'


def folded(title: str, inside: str) -> str:
    """What only some readers want, under one line."""
    return f"<details><summary>{text(title)}</summary>{inside}</details>"


def listed(lines: Iterable[str], kind: str = "") -> str:
    """Lines as a list, as text."""
    return f'<ul class="{kind}">{"".join(f"<li>{text(line)}</li>" for line in lines)}</ul>'


def clock(time_s: float) -> str:
    """``3091.4`` as ``51 min 31 s``."""
    minutes, seconds = divmod(round(time_s), 60)
    return f"{minutes} min {seconds:02d} s" if minutes else f"{seconds} s"


def head(
    record: RunFiles, chip: str, title: str, outcome: PointOutcome, warnings: Sequence[str], headline: Mapping[str, str]
) -> str:
    """The head as markup.

    Args:
        chip: of ``chips``.
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
    """What kind of run it was, so that nobody takes a simulation for the telescope."""
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


# Nothing is loaded, run, sent or embedded; what the page shows stands in it.
POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'; form-action 'none'"
STYLE = """
:root{--ink:#1f2933;--quiet:#5f6c7b;--line:#d5dce4;--soft:#f4f6f9;--bad:#c93f3f;--good:#1d7a55;--mid:#a8641a}
*{box-sizing:border-box}
html{-webkit-text-size-adjust:100%}
body{margin:0 auto;max-width:960px;padding:20px 20px 60px;color:var(--ink);background:#fff;
font:15px/1.5 system-ui,"Segoe UI","DejaVu Sans",Helvetica,Arial,sans-serif;overflow-wrap:break-word}
h1{font-size:26px;line-height:1.2;margin:6px 0 2px}
h2{font-size:19px;margin:38px 0 10px;padding-top:10px;border-top:1px solid var(--line)}
h3{font-size:15px;margin:22px 0 6px}
p{margin:6px 0}a{color:#123f6d}.quiet,figcaption{color:var(--quiet);font-size:13.5px}
.chip{display:inline-block;border-radius:4px;padding:1px 9px;margin:0 6px 6px 0;font-size:13px;font-weight:600;
border:1px solid currentColor}
.good{color:var(--good)}.bad{color:var(--bad)}.mid{color:var(--mid)}.sim{background:#fff3cd;color:#6b4e00}
nav{margin:14px 0 0;font-size:14px;display:flex;flex-wrap:wrap;gap:2px 16px}
.box{border-left:4px solid var(--mid);background:#fdf6ec;padding:8px 14px;margin:14px 0}
.box ul{margin:4px 0;padding-left:18px}
dl{display:grid;grid-template-columns:repeat(auto-fill,minmax(210px,1fr));gap:8px;margin:14px 0}
dl div{background:var(--soft);border-radius:6px;padding:8px 12px}
dt{color:var(--quiet);font-size:12.5px}dd{margin:0;font-size:17px;font-variant-numeric:tabular-nums}
dd small{font-size:13px;color:var(--quiet)}
figure{margin:12px 0}figure svg{display:block;width:100%;height:auto;max-width:880px}.narrow{display:none}
.narrow svg{max-width:480px}
.beside{display:flex;flex-wrap:wrap;gap:0 24px}.beside figure{flex:1 1 300px;max-width:440px}
.beside figcaption{text-align:center;font-weight:600}
.scroll{overflow-x:auto;margin:8px 0;background:linear-gradient(to left,#fff 40%,#fff0) right/44px 100% no-repeat local,
linear-gradient(to left,rgb(31 41 51/.35),#fff0) right/16px 100% no-repeat scroll}
table{border-collapse:collapse;font-size:13.5px;font-variant-numeric:tabular-nums}
th,td{padding:3px 9px;text-align:right;white-space:nowrap;border-bottom:1px solid var(--line)}
thead th{position:sticky;top:0;background:#fff;border-bottom:2px solid var(--line);color:var(--quiet);font-weight:600}
tbody th{text-align:left;font-weight:600;position:sticky;left:0;background:#fff}
thead th:first-child{left:0;z-index:1;text-align:left}
table.figures tbody th{white-space:normal;min-width:8em}
table.texts td,table.texts thead th{text-align:left;white-space:normal;vertical-align:top}
table.texts td:last-child{min-width:240px}
table.dense{font-size:12.5px}table.dense th,table.dense td{padding:3px 6px}
td.pass{color:var(--good)}td.fail,td.skipped{color:#fff;background:var(--bad)}td.corrected{background:#fbe3c4}
td.open{color:var(--quiet)}td.far{background:#fbe3c4}
table.log tbody th{font-weight:400;vertical-align:top}
details{margin:10px 0}summary{cursor:pointer;color:#123f6d}
pre{background:var(--soft);padding:12px;overflow-x:auto;font-size:12.5px;line-height:1.4}
footer{margin-top:40px;padding-top:10px;border-top:1px solid var(--line);color:var(--quiet);font-size:13px}
@media (max-width:640px){body{padding:12px 12px 40px;font-size:15px}h1{font-size:22px}.wide{display:none}
.narrow{display:block}dl{grid-template-columns:1fr 1fr}dd{font-size:15px}
.log :is(th,td):nth-child(2){display:none}th,td{padding:3px 6px}}
@media print{@page{margin:14mm}body{max-width:none;padding:0;font-size:10.5pt}nav,details:not([open]){display:none}
h2{break-after:avoid}figure,dl,tr{break-inside:avoid}thead{display:table-header-group}
thead th,tbody th{position:static}.scroll{overflow:visible;background:none}
.wide{display:block!important}.narrow{display:none!important}
figure svg{max-height:235mm}table{font-size:8pt}th,td{padding:1.5px 5px}
*{-webkit-print-color-adjust:exact;print-color-adjust:exact}}
"""


class Section(NamedTuple):
    """A part of the page: its anchor, its heading, and what stands under it, as markup."""

    anchor: str
    title: str
    body: str


def page(title: str, head: str, sections: Sequence[Section], foot: str) -> str:
    """The whole file.

    Args:
        head: what stands above the sections, as markup.
    """
    links = "".join(f'<a href="#{text(section.anchor)}">{text(section.title)}</a>' for section in sections)
    parts = "".join(
        f'<section id="{text(section.anchor)}"><h2>{text(section.title)}</h2>{section.body}</section>'
        for section in sections
    )
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        '<meta name="referrer" content="no-referrer"><link rel="icon" href="data:,">'
        f"<title>{text(title)}</title><style>{STYLE}</style></head><body>"
        f"<header>{head}<nav>{links}</nav></header><main>{parts}</main><footer>{foot}</footer></body></html>\n"
    )
