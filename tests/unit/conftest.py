"""Fixtures of mirrors: those that are shipped, loaded once, and one that is too small for the robot."""

import pytest

from ccatp.mirror.mirror import Mirror, build_mirror
from tests.support.scenario import MIRRORS, World, config_of, mirror_of, world_of


@pytest.fixture
def m1() -> Mirror:
    """M1 of the telescope as built."""
    return mirror_of("fyst-m1")


@pytest.fixture
def m2() -> Mirror:
    """M2 of the telescope as built."""
    return mirror_of("fyst-m2")


@pytest.fixture
def thesis() -> World:
    """M1 in the layout of the thesis."""
    return world_of("thesis-m1")


@pytest.fixture(params=MIRRORS)
def world(request: pytest.FixtureRequest) -> World:
    """Each shipped mirror in turn, with its configuration."""
    return world_of(request.param)


@pytest.fixture
def small() -> World:
    """A single panel of 250 mm: nowhere 132 mm from the rim."""
    cfg = config_of()
    panels = cfg.mirror.panels.model_copy(
        update={
            "count": 1, "cols": 1, "panels_per_row": (1,), "size_x_mm": 250.0, "size_y_mm": 250.0, "pitch_x_mm": 251.2,
            "pitch_y_mm": 251.2, "points_x_mm": (-20.0, 0.0, 20.0), "points_y_mm": (-20.0, 0.0, 20.0),
        }
    )  # fmt: skip
    base = cfg.mirror.base.model_copy(update={"row": 1, "col": 1, "x_mm": 0.0, "y_mm": 0.0})
    return World(cfg, build_mirror(cfg.mirror.model_copy(update={"panels": panels, "base": base})))
