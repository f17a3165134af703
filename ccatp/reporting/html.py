"""Pure. Pieces of a page: text that is safe, tables, and figures for a screen, a telephone and paper."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from html import escape

from ccatp.drawing.shapes import Picture
from ccatp.drawing.svg import svg_of

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
    """A table that scrolls sideways where the page is too narrow; the first cell of a row is its name.

    Args:
        head: names of the columns.
        rows: cells, as markup already.
        kind: class of the table.
    """
    top = "".join(f'<th scope="col">{text(name)}</th>' for name in head)
    body = "".join(
        f'<tr><th scope="row">{first}</th>{"".join(f"<td>{cell}</td>" for cell in rest)}</tr>' for first, *rest in rows
    )
    return f'<div class="scroll"><table class="{kind}"><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>'


def facts(pairs: Mapping[str, str]) -> str:
    """Names and values beside each other; values are markup already."""
    return "<dl>" + "".join(f"<div><dt>{text(k)}</dt><dd>{v}</dd></div>" for k, v in pairs.items()) + "</dl>"


def figure(draw: Callable[[float], Picture], caption: str) -> str:
    """A picture in two layouts, of which the page shows one.

    Args:
        draw: draws it in a width, in pixels.
        caption: markup already.
    """
    wide, narrow = draw(WIDE), draw(NARROW)
    return (
        f'<figure><div class="wide">{svg_of(wide)}</div><div class="narrow">{svg_of(narrow)}</div>'
        f"<figcaption>{caption}</figcaption></figure>"
    )


def beside(pictures: Iterable[tuple[str, Picture]]) -> str:
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
