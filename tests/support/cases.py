"""Cases of parametrized tests."""

from typing import Any

import pytest


def slow_case(*values: object) -> Any:
    """A further case of what another case shows: run by the slow tests."""
    return pytest.param(*values, marks=pytest.mark.slow)
