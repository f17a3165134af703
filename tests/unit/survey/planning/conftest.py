"""Pure but for reading the shipped configuration, once for all tests of this room."""

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import pytest

from ccatp.config.load import load_config
from ccatp.config.models import Config
from ccatp.mirror.mirror import Mirror, build_mirror

NAMES = ("fyst-m1", "fyst-m2", "thesis-m1", "thesis-m2")


class World(NamedTuple):
    """A shipped configuration and its mirror."""

    cfg: Config
    mirror: Mirror


@cache
def _load(name: str) -> World:
    cfg = load_config(overrides={"run.mirror": name})
    return World(cfg, build_mirror(cfg.mirror))


@pytest.fixture
def load() -> Callable[[str], World]:
    """Loads a shipped mirror by name."""
    return _load


@pytest.fixture(params=NAMES)
def world(request: pytest.FixtureRequest) -> World:
    """Each shipped mirror in turn."""
    return _load(request.param)


@pytest.fixture
def thesis() -> World:
    """M1 in the layout of the thesis."""
    return _load("thesis-m1")


@pytest.fixture
def small() -> World:
    """A single panel of 250 mm: nowhere 132 mm from the rim."""
    cfg = load_config(overrides={"run.mirror": "fyst-m1"})
    panels = cfg.mirror.panels.model_copy(
        update={
            "count": 1,
            "cols": 1,
            "panels_per_row": (1,),
            "size_x_mm": 250.0,
            "size_y_mm": 250.0,
            "pitch_x_mm": 251.2,
            "pitch_y_mm": 251.2,
            "points_x_mm": (-20.0, 0.0, 20.0),
            "points_y_mm": (-20.0, 0.0, 20.0),
        }
    )
    base = cfg.mirror.base.model_copy(update={"row": 1, "col": 1, "x_mm": 0.0, "y_mm": 0.0})
    return World(cfg, build_mirror(cfg.mirror.model_copy(update={"panels": panels, "base": base})))
