"""The tests of this folder take each shipped mirror in turn."""

import pytest

from ccatp.mirror.mirror import Mirror
from tests.support.scenario import World


@pytest.fixture
def mirror(world: World) -> Mirror:
    """Each shipped mirror in turn."""
    return world.mirror
