"""Pure but for processes that it forks. In a gap of the samples the localizer knows how wrong it is."""

from pathlib import Path

import pytest

from tests.faults.linking import Measured
from tests.support.cases import slow_case
from tools.gap_campaign import Cell, cells_of, table
from tools.gap_rig import FILTERS, MOTORS, SILENT, WAYS, WORLDS, Drive, Way, run

ROW = pytest.mark.fault("S32")


def wrong(cells: list[Cell]) -> list[str]:
    return [cell.text for cell in cells if cell.is_overconfident or cell.is_inflated]


@ROW
@pytest.mark.parametrize("motors", ["lag", pytest.param("motors", marks=pytest.mark.slow)])
def test_a_few_gaps_of_all_encoders(motors: str, measured: Measured) -> None:
    """Some seeds of the campaign."""
    ways, silent = (Way("leg", "rule"), Way("turn", "ttl")), ("", "enc", "imu+enc+edge")
    drive = Drive("hard", motors)
    cells = cells_of(drive, [run(drive, seed, ways, silent) for seed in range(3)])
    assert len(cells) == len(ways) * len(silent) * 6
    assert not [cell.text for cell in cells if cell.is_overconfident or cell.is_surely_inflated]
    measured("S32", max(cell.excess for cell in cells))
    measured("S32", max(cell.rms_mm for cell in cells), "mm")


@ROW
@pytest.mark.parametrize("world", ["hard", *(slow_case(world) for world in WORLDS if world != "hard")])
def test_a_gap_that_begins_with_a_rest_moves_nothing(world: str) -> None:
    """With the ninth seed it begins in the frame after that in which the robot counts as resting."""
    way = Way("standstill", "ttl")
    found = run(Drive(world, "lag"), 9, [way], ["", "enc"])[way]
    assert found["enc"].position_m == pytest.approx(found[""].position_m, abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("motors", MOTORS)
@pytest.mark.parametrize("world", WORLDS)
def test_every_gap_of_the_campaign(world: str, motors: str, name: str) -> None:
    drive = Drive(world, motors, name)
    cells = cells_of(drive, [run(drive, seed, WAYS, SILENT) for seed in range(200)])
    Path("build").mkdir(exist_ok=True)
    Path("build", f"gaps_{world}_{motors}_{name}.txt").write_text(table(cells))
    assert not wrong(cells)
