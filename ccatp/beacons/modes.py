"""The modes that only a mission among beacons has."""

from enum import StrEnum


class BeaconMode(StrEnum):
    """Mode of a mission among beacons, besides those of every mission."""

    MAPPING = "mapping"  # stands while motes map themselves
    VISITING = "visiting"  # on the way to a waypoint
    FOLLOWING = "following"  # behind the target


MAPPING, VISITING, FOLLOWING = BeaconMode
