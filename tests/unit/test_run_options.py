"""What a run is asked to do."""

from datetime import UTC, datetime
from pathlib import Path

import pytest

from ccatp.daemon.run_dir import RunOptions, default_run_dir

NOW = datetime(2026, 3, 4, 5, 6, 7, tzinfo=UTC)


@pytest.mark.parametrize("mirror", ["fyst-m2", "elsewhere/fyst-m2.toml"])
def test_a_run_directory_is_named_by_time_mirror_and_seed(mirror: str) -> None:
    assert default_run_dir(mirror, 3, NOW) == Path("runs/20260304T050607Z-fyst-m2-s3")


@pytest.mark.parametrize(
    ("sim", "realtime", "is_paced"), [(True, False, False), (True, True, True), (False, False, True)]
)
def test_a_real_robot_keeps_the_walls_time(sim: bool, realtime: bool, is_paced: bool) -> None:
    assert RunOptions(sim=sim, realtime=realtime).is_paced is is_paced
