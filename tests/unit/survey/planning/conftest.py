"""A mirror that is too small for the robot."""

import pytest

from ccatp.mirror.mirror import build_mirror
from tests.support.scenario import World, config_of


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
