"""From lengths to a fix."""

import numpy as np
import pytest

from ccatp.config.models import Config
from ccatp.mirror.mirror import build_mirror
from ccatp.mirror.multilateration import TooFewRanges, solve_fix


@pytest.mark.parametrize("count", [0, 1, 3])
def test_too_few_lengths_are_no_fix(config: Config, count: int) -> None:
    mirror = build_mirror(config.mirror)
    collimators = dict(zip(mirror.channels, mirror.collimators_m, strict=True))
    puck = mirror.puck_world(mirror.deck_pose(mirror.base_panel_pose), config.robot.puck_height_m)
    lengths = {c: float(np.linalg.norm(collimators[c] - np.array(puck))) for c in mirror.channels[:count]}
    with pytest.raises(TooFewRanges, match=f"{count} "):
        solve_fix(config.etalon, 0.0, puck, lengths, collimators)
