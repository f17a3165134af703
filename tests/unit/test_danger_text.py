"""Causes of the danger loop as an operator reads them."""

import pytest

from ccatp.core import danger_text


@pytest.mark.parametrize(
    ("cause", "signal", "value", "limit", "text"),
    [
        ("no estimate", "estimate", 0.15, 0.15, "no estimate: limit 0.15 s"),
        ("estimate stale", "estimate", 0.31, 0.15, "estimate stale: 0.31 s (limit 0.15 s)"),
        ("edge samples stale", "edge", 0.2, 0.1, "edge samples stale: 0.2 s (limit 0.1 s)"),
        ("lifted or fallen", "edge", 4.0, 3.0, "lifted or fallen (edge): 4 (limit 3)"),
        ("the left wheel runs away", "left_wheel", 0.5, 0.1, "the left wheel runs away: 0.5 (limit 0.1)"),
        ("emergency: fire", "emergency:fire", 1.0, 0.0, "emergency: fire"),
        ("", "", 0.0, 0.0, ""),
    ],
)
def test_what_where_how_much(cause: str, signal: str, value: float, limit: float, text: str) -> None:
    assert danger_text(cause, signal, value, limit) == text
