"""A drive off the rim is stopped by the danger loop, on every side of every mirror, in lockstep and in real time."""

from itertools import product
from pathlib import Path

import pytest

from tests.processes.rim_drive import OUTWARD, RimCase, drive_off

MIRRORS = ("fyst-m1", "fyst-m2", "thesis-m1", "thesis-m2")
SPEEDS = (0.02, 0.05, 0.1, 0.15)
QUARTER = 0.7853981633974483
# A wrong pose is tried in lockstep only: what it changes is the rule, not the timing.
ALL = [
    RimCase(mirror, side, speed, angle, is_realtime, is_pose_right)
    for mirror, side, speed, angle, (is_realtime, is_pose_right) in product(
        MIRRORS, OUTWARD, SPEEDS, (0.0, QUARTER), ((False, True), (False, False), (True, True))
    )
]
FEW = [
    RimCase("fyst-m1", "right", 0.15, 0.0, False),
    RimCase("fyst-m2", "top", 0.15, QUARTER, False),
    RimCase("thesis-m1", "left", 0.02, QUARTER, False, is_pose_right=False),
    RimCase("thesis-m2", "bottom", 0.1, 0.0, True),
    RimCase("fyst-m1", "bottom", 0.15, QUARTER, True, is_pose_right=False),
]


async def check(case: RimCase, tmp_path: Path, runtime_dir: Path) -> None:
    result = await drive_off(case, tmp_path, runtime_dir)
    print(
        f"{case}: overrun {1e3 * result.overrun_m:.1f} mm, after declaration {1e3 * result.after_declaration_m:.1f} mm"
    )
    assert not result.has_fallen
    assert result.declared
    # Invariant I5: at most 20 mm further once the edge is declared.
    assert result.after_declaration_m <= 0.020
    # The centre of mass is 90 mm behind the front sensors: less than half of that may hang over.
    assert result.overrun_m <= 0.045


@pytest.mark.parametrize("case", FEW, ids=str)
async def test_a_drive_off_the_rim_is_stopped(case: RimCase, tmp_path: Path, runtime_dir: Path) -> None:
    await check(case, tmp_path, runtime_dir)


@pytest.mark.slow
@pytest.mark.parametrize("case", ALL, ids=str)
async def test_every_drive_off_the_rim_is_stopped(case: RimCase, tmp_path: Path, runtime_dir: Path) -> None:
    await check(case, tmp_path, runtime_dir)
