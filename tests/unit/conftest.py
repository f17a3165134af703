"""Fixtures of the shipped mirrors, loaded once."""

import pytest

from ccatp.mirror.mirror import Mirror
from tests.support.scenario import MIRRORS, World, mirror_of, world_of


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
