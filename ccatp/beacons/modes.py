"""The modes that only a mission among beacons has, and the phases in which it works."""

from enum import StrEnum

from ccatp.survey.engagement import Kind, Phase
from ccatp.survey.events import IDLE, RETURNING


class BeaconMode(StrEnum):
    """Mode of a mission among beacons, besides those of every mission."""

    MAPPING = "mapping"  # stands while motes map themselves
    VISITING = "visiting"  # on the way to a waypoint
    FOLLOWING = "following"  # behind the target


MAPPING, VISITING, FOLLOWING = BeaconMode


class Deciding(Phase, frozen=True, tag=True):
    """It may work; the next frame shows what is to be done."""

    kind, shown = Kind.WORK, IDLE


class Working(Phase, frozen=True, tag=True):
    """At a task."""

    task: BeaconMode

    kind = Kind.WORK

    @property
    def mode(self) -> StrEnum:
        """That of the task."""
        return self.task


class Returning(Phase, frozen=True, tag=True):
    """On the way to its start."""

    kind, shown = Kind.HOME, RETURNING
