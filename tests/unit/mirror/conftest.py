"""Pure but for reading the shipped mirrors, once for all tests of this room."""

import tomllib
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from ccatp.config.models import MirrorConfig
from ccatp.mirror.mirror import Mirror, build_mirror

FOLDER = Path(__file__).parents[3] / "configs" / "mirrors"
NAMES = ("fyst-m1", "fyst-m2", "thesis-m1", "thesis-m2")


@cache
def _load(name: str) -> Mirror:
    return build_mirror(MirrorConfig.model_validate(tomllib.loads((FOLDER / f"{name}.toml").read_text())))


@pytest.fixture(params=NAMES)
def mirror(request: pytest.FixtureRequest) -> Mirror:
    """Each shipped mirror in turn."""
    return _load(request.param)


@pytest.fixture
def m1() -> Mirror:
    """M1 of the telescope as built."""
    return _load("fyst-m1")


@pytest.fixture
def m2() -> Mirror:
    """M2 of the telescope as built."""
    return _load("fyst-m2")


@pytest.fixture
def raw() -> dict[str, Any]:
    """The file of the default mirror, fresh for each test, to be broken by it."""
    return tomllib.loads((FOLDER / "fyst-m1.toml").read_text())
