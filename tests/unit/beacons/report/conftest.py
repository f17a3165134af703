"""Figures are drawn as in the tests of the other reports."""

from tests.support.pages import drawn, undrawn

__all__ = ["drawn", "undrawn"]
