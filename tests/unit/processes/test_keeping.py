"""What a main loop leaves in force for the one that follows."""

import pytest
from msgspec.structs import replace

from ccatp.config.models import Config
from ccatp.core import EventCode
from ccatp.daemon.checkpoints import in_force_of
from ccatp.mirror.mirror import build_mirror
from ccatp.survey.state import MissionState
from tests.support.mission_story import ABORT, FREE, Story, from_first_leg

QUAKE = replace(
    FREE, code=EventCode.ABORTED, cause="emergency: earthquake", forward=False, reverse=False, turn=False, raised=1,
    is_shaking=True,
)  # fmt: skip


@pytest.fixture
def driving(config: Config) -> Story:
    cfg = from_first_leg(config)
    story = Story(cfg, build_mirror(cfg.mirror))
    story.until_state(MissionState.DRIVING)
    return story


def test_a_pause_and_an_abort(driving: Story) -> None:
    mission = driving.mission
    assert in_force_of(mission) == ("", "")
    driving.frame(ABORT)
    assert in_force_of(mission) == ("fire", "")
    assert mission.pause("operator") is None
    assert in_force_of(mission) == ("fire", "operator")


@pytest.mark.fault("O1")
def test_an_earthquake_is_kept_by_the_danger_loop(driving: Story) -> None:
    """Who takes over is held by the next verdict, and goes home when it is over; nobody has to resume."""
    driving.frame(QUAKE)
    assert driving.mission.is_paused
    assert in_force_of(driving.mission) == ("emergency: earthquake", "")


def test_what_was_stopped_on_its_way_home_goes_home_when_it_goes_on(driving: Story) -> None:
    assert driving.mission.abort("operator") is None
    assert driving.mission.stop() is None
    assert in_force_of(driving.mission) == ("operator", "")


def test_what_is_at_base_has_nothing_in_force(driving: Story) -> None:
    driving.until_state(MissionState.DONE, ABORT)
    assert in_force_of(driving.mission) == ("", "")
