"""Servers that break the interface page in one place each: just the checks meant for that place fail."""

import json

import pytest

from ccatp.commissioning.conformance import server_checks
from ccatp.config.models import Config
from ccatp.mirror.mirror import Mirror
from tests.contract.broken_servers import (
    COMMANDS,
    FLOORS,
    IDS,
    KEY,
    MACS,
    MIRROR,
    QUANTITIES,
    REALTIME,
    RULES,
    SESSIONS,
    STEPS,
    STREAMS,
    TABLES,
    UNSEEN,
)
from tests.contract.defects import Defect, checked
from tests.support.scenario import config_of


def judge(
    config: Config, table: list[Defect], *, lockstep: bool, key: bytes | None = None, mirror: Mirror | None = None
) -> None:
    """Each server of a table fails the checks meant for it, and no others."""
    wrong = {}
    for broken in table:
        results = checked(config, broken.runs, lockstep=lockstep, key=key, broken=broken, mirror=mirror)
        seen = {result.check_id: result.detail for result in results if result.outcome == "fail"}
        if set(seen) != set(broken.fails.split()):
            wrong[broken.name] = broken.fails, seen
    assert not wrong, json.dumps(wrong, indent=1)


# Further units, signs, sides and times of one quantity, and breaches of one rule: found by the same check as the first.
FURTHER = {
    "samples of the next frame", "samples with the frame's time", "gravity of a second ago",
    "samples of the frame before", "a clock that jumps back",
    "encoders in degrees", "encoders in rpm", "encoders in turns per second", "encoders of the motor's shaft",
    "encoders of the other sign", "left encoder that is dead", "drives taken for degrees", "diameter for the radius",
    "wheels reversed, encoders too", "gyroscope in degrees", "gyroscope in turns per second", "gyroscope that is dead",
    "accelerometer in g", "accelerometer in mm/s2", "accelerometer that is dead",
    "allows each direction for its own time-to-live", "takes permits at rest only", "clamps each wheel by itself",
}  # fmt: skip
FURTHER_ONES = [broken for broken in (*STREAMS, *QUANTITIES, *RULES) if broken.name in FURTHER]


def first_of(table: list[Defect]) -> list[Defect]:
    return [broken for broken in table if broken.name not in FURTHER]


@pytest.mark.parametrize(
    "table",
    [
        pytest.param(SESSIONS, id="sessions"),
        pytest.param(first_of(STREAMS), id="frames"),
        pytest.param(COMMANDS, id="commands"),
        pytest.param(STEPS, id="steps"),
        pytest.param(first_of(QUANTITIES), id="quantities"),
        pytest.param(FURTHER_ONES, id="further", marks=pytest.mark.slow),
        pytest.param(first_of(RULES), id="rules"),
        pytest.param(UNSEEN, id="unseen"),
    ],
)
def test_in_lockstep(config: Config, table: list[Defect], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server_checks, "FRAMES", 15)  # whatever is wrong with them is wrong with the first
    judge(config, table, lockstep=True)


def test_macs(config: Config) -> None:
    judge(config, MACS, lockstep=True, key=KEY)


def test_at_the_base_of_a_mirror(config: Config, mirror: Mirror) -> None:
    judge(config, MIRROR, lockstep=True, mirror=mirror)


def test_fans_over_an_overhang() -> None:
    judge(config_of("fyst-m2"), FLOORS, lockstep=True)


def test_in_real_time(config: Config) -> None:
    judge(config, REALTIME, lockstep=False)


def test_every_check_has_its_broken_server() -> None:
    seeded = [broken for table in TABLES.values() for broken in table]
    found = {name for broken in seeded for name in broken.fails.split()}
    assert set(IDS) - found == {"mac"}  # a server that refuses the right mac lets no check begin
    assert len(FURTHER_ONES) == len(FURTHER)
    assert sum(bool(broken.fails) for broken in seeded) > 0.95 * len(seeded) > 60
