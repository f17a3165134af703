"""Examples of the documentation: is what a command prints like what a page shows?"""

import re

NUMBER = re.compile(r"(?<![\d.])(-?\d+\.\d+)(?!\d)")
ELLIPSIS = "..."
BLANK_LINE = "<BLANKLINE>"


def is_like(shown: str, printed: str) -> bool:
    """Equal, or with decimals that another processor rounds otherwise: by a tenth, or two units of what is shown.

    ``...`` stands for any text, as in doctest; amounts of white space are equal. Every decimal that is shown is
    compared, also in a text with an ellipsis.
    """
    shown = shown.replace(BLANK_LINE, "")
    found = re.fullmatch(_pattern(shown), " ".join(printed.split()), re.DOTALL)
    numbers = NUMBER.findall(shown)
    return found is not None and all(_is_close(*pair) for pair in zip(numbers, found.groups(), strict=True))


def _pattern(shown: str) -> str:
    """The text as a regular expression, with a group for each decimal."""
    words = re.split(f"({re.escape(ELLIPSIS)})", " ".join(shown.split()))
    return "".join(".*?" if word == ELLIPSIS else _literal(word) for word in words)


def _literal(text: str) -> str:
    parts = NUMBER.split(text)
    texts, numbers = map(re.escape, parts[::2]), (NUMBER.pattern for _ in parts[1::2])
    return "".join(part for pair in zip(texts, [*numbers, ""], strict=True) for part in pair)


def _is_close(shown: str, printed: str) -> bool:
    unit = 10.0 ** -len(shown.partition(".")[2])
    return abs(float(shown) - float(printed)) <= max(0.1 * abs(float(shown)), 2.0 * unit)
