"""The registry of the kinds of missions: every part exists, and no other file names what is of one kind alone."""

import re
from collections.abc import Callable
from dataclasses import fields
from itertools import chain
from pathlib import Path

import pytest

from ccatp.beacons.kind import BEACONS
from ccatp.missions import BUILT_IN, MissionKind, Part, all_kinds, built_in, find_kind, kind_of
from ccatp.onboard.kinds import BUILT_IN as ROBOTS
from ccatp.studies import STUDIES, find_study
from ccatp.survey.kind import SURVEY
from tests.support.scenario import config_of, radio_config_of

PACKAGE = Path(__file__).parents[2] / "ccatp"
OF_THE_SLICE = re.compile(r"radio|beacon|\bmotes?\b|cricket|zigbee", re.IGNORECASE)


def parts_of(kind: MissionKind) -> list[Part]:
    values = (getattr(kind, field.name) for field in fields(kind))
    return [
        one for one in chain.from_iterable(v if isinstance(v, tuple) else (v,) for v in values) if isinstance(one, Part)
    ]


@pytest.mark.parametrize("kind", built_in(), ids=lambda kind: kind.title)
def test_every_part_of_a_kind_exists(kind: MissionKind) -> None:
    parts = parts_of(kind)
    assert len(parts) > 10
    for part in parts:
        assert part.get() is not None, part.place
    for name in kind.studies:
        find_study(name)
        assert name in STUDIES


def test_each_system_is_of_one_kind() -> None:
    systems = [system for kind in all_kinds() for system in kind.systems]
    assert len(systems) == len(set(systems))
    assert [find_kind(system) for system in ("survey", "zigbee", "follow", "cricket")] == [SURVEY, *[BEACONS] * 3]
    assert find_kind("sqare") is find_kind(["survey"]) is None


@pytest.mark.parametrize("make", [config_of, radio_config_of])
def test_a_configuration_knows_its_kind(make: Callable[[], object]) -> None:
    assert kind_of(make()) is (SURVEY if make is config_of else BEACONS)


def test_only_the_registry_names_the_indoor_robots() -> None:
    named = {}
    for path in (one for suffix in ("py", "js", "html", "css", "txt", "md") for one in PACKAGE.rglob(f"*.{suffix}")):
        name = path.relative_to(PACKAGE)
        text = path.read_text(encoding="utf-8").replace('type: "radio"', "")  # a button of HTML
        if name.parts[0] != "beacons" and (found := OF_THE_SLICE.findall(text)):
            named[str(name)] = len(found)
    assert named == {"missions.py": 2, "onboard/kinds.py": 3}  # module and name, in one line; there the kind as well
    assert sum("beacons" in place for place in BUILT_IN) == 1
    assert [name for name, place in ROBOTS.items() if "beacons" in place] == ["beacons"]
