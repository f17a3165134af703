"""The radios of a vehicle (tags): whose readings are used, and where each of them is on the vehicle."""

from collections import Counter
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from ccatp.beacons.datasets.events import READING_KINDS, Recording
from ccatp.beacons.datasets.tables import RadioDataError, Table
from ccatp.errors import listed

MOST_TAGS = 16  # more names are no tags
TAG = 3  # column of the tag in a table of readings, if it has one
Place = tuple[float, float, float]  # forward_m, left_m, up_m
NOWHERE: Place = (0.0, 0.0, 0.0)
UNPLACED = "no place on the vehicle is given, by an event tag, a table of tag, forward, left, or [tags] of the topics"


class Radios(NamedTuple):
    """The readings that are used, and their radios."""

    tables: dict[str, Table]  # of readings, shape (m, 4): the last column is the index of the radio
    antenna_m: Place  # of the only radio; zero if there are several
    tags_m: Mapping[str, Place]  # of each of several radios, in the order of their indices


def radios_of(recording: Recording, wanted: str, warnings: list[str]) -> Radios:
    """All radios whose place is known, or the ``wanted`` one; the others are named and left out.

    If no place is known, the radio with most readings is used, at the place of the antenna, with a warning. Raises
    RadioDataError: there is no reading of the wanted one, or a place cannot be used.
    """
    readings = {kind: table for kind, table in recording.tables.items() if kind in READING_KINDS}
    named = {kind: _names(table, recording.tags) for kind, table in readings.items()}
    counts = Counter(name for each in named.values() for name in each)
    if wanted and not any(counts):
        raise RadioDataError(recording.file, f"has no column of tags, so none of tag {wanted}")
    if wanted and wanted not in counts:
        raise RadioDataError(recording.file, f"has no reading of tag {wanted}; there are {_listed(counts)}")
    if len(counts) > MOST_TAGS:
        raise RadioDataError(
            recording.file, f"has readings of {len(counts)} tags ({_listed(counts)}): are these the names of tags?"
        )
    places_m, antenna_m = _places(recording), _antenna(recording.tables.get("antenna"))
    placed = [name for name in counts if name in places_m]
    used = [wanted] if wanted else placed or [max(counts, key=lambda name: counts[name], default="")]
    if others := {name: count for name, count in counts.items() if name not in used}:
        kept = f"readings of tag {used[0]} ({counts[used[0]]}) are used, those of the tags {_listed(others)} are not"
        lacking = f"readings of the tags {_listed(others)} are not used: {UNPLACED}"
        warnings.append(lacking if placed and not wanted else kept)
    if (len(counts) > 1 or places_m) and used[0] not in places_m:
        where = "zero" if antenna_m == NOWHERE else "that of the antenna"
        warnings.append(f"the place of tag {used[0]} is taken as {where}: {UNPLACED}")
    elif antenna_m != NOWHERE and used[0] in places_m:
        warnings.append("the place of the antenna is not used: that of the tag is")
    tables = {kind: _of_radios(table, named[kind], used) for kind, table in readings.items()}
    if len(used) > 1:
        return Radios(tables, NOWHERE, {name: places_m[name] for name in used})
    return Radios(tables, places_m.get(used[0], antenna_m), {})


def from_the_vehicle(recording: Recording, warnings: list[str]) -> Recording:
    """The recording with the vehicle's radio as the tag of each reading, and the other one as the beacon.

    Ranges of two ways name their radios in either order, and some are between two beacons. So if names of tags are
    those of beacons, too, the vehicle's radios are those with a place on it, or else the one that is part of most
    readings and was not surveyed.
    """
    readings = {kind: table for kind, table in recording.tables.items() if kind in READING_KINDS}
    ends = {
        kind: [
            (tag, recording.names[int(k)])
            for tag, k in zip(_names(table, recording.tags), table.values[:, 1].tolist(), strict=True)
        ]
        for kind, table in readings.items()
    }
    pairs = [pair for each in ends.values() for pair in each]
    heard = {beacon for _, beacon in pairs}
    # No radio ranges itself: then tags and beacons are counted each from the first on.
    if not {tag for tag, _ in pairs} & heard or any(tag == beacon for tag, beacon in pairs):
        return recording
    surveyed = recording.tables.get("beacon")
    stand = set() if surveyed is None else {recording.names[int(k)] for k in surveyed.values[:, 0].tolist()}
    counts = Counter(name for pair in pairs for name in pair if name and name not in stand)
    own = {*_mounted(recording)} or {name for name, _ in counts.most_common(1)}
    if not {tag for tag, _ in pairs if tag} <= own | heard | stand:
        return recording
    names, tags = (tuple(dict.fromkeys((*first, *recording.names, *recording.tags))) for first in ((), recording.tags))
    tables, turned, left_out = dict(recording.tables), 0, 0
    for kind, table in readings.items():
        rows, kept = table.values.copy(), np.ones(len(table.values), dtype=bool)
        for row, (tag, beacon) in enumerate(ends[kind]):
            if beacon in own and tag not in own and tag and kind != "bearing":  # that is a bearing from the beacon
                rows[row, 1], rows[row, TAG], turned = names.index(tag), tags.index(beacon), turned + 1
            elif beacon in own or (tag and tag not in own):
                kept[row], left_out = False, left_out + 1
            else:
                rows[row, 1] = names.index(beacon)
        tables[kind] = table._replace(values=rows).where(kept)
    if surveyed is not None:
        index = [float(names.index(recording.names[int(k)])) for k in surveyed.values[:, 0].tolist()]
        tables["beacon"] = surveyed._replace(values=np.column_stack([index, surveyed.values[:, 1:]]))
    warnings.append(
        f"tags and beacons have the same names: {listed(sorted(own))} is taken to be on the vehicle; {turned} readings "
        f"have it as the beacon and were turned round, {left_out} without it are not used"
    )
    return recording._replace(tables=tables, names=names, tags=tags)


def _listed(counts: Mapping[str, int]) -> str:
    return listed([f"{name or 'without a name'} ({count})" for name, count in counts.items()])


def _names(table: Table, tags: tuple[str, ...]) -> list[str]:
    if table.values.shape[1] <= TAG:
        return [""] * len(table.values)
    return ["" if np.isnan(k) else tags[int(k)] for k in table.values[:, TAG].tolist()]


def _of_radios(table: Table, names: list[str], used: list[str]) -> Table:
    index = np.array([used.index(name) if name in used else -1 for name in names], dtype=np.float64)
    return table._replace(values=np.column_stack([table.values[:, :TAG], index])).where(index >= 0.0)


def _places(recording: Recording) -> dict[str, Place]:
    """Places of the tags, without those that are not given. Raises RadioDataError: a tag has two."""
    table = recording.tables.get("tag")
    found: dict[str, Place] = {}
    if table is None:
        return found
    for line, (tag, *place) in zip(table.lines.tolist(), table.values.tolist(), strict=True):
        ahead_m, left_m, up_m = np.nan_to_num(place).tolist()
        name, place_m = recording.tags[int(tag)], (ahead_m, left_m, up_m)
        if found.get(name, place_m) != place_m:
            raise RadioDataError(table.file, f"tag {name} has two places", line)
        if np.isfinite(place[:2]).all():
            found[name] = place_m
    return found


def _mounted(recording: Recording) -> list[str]:
    table = recording.tables.get("tag")
    return [] if table is None else [recording.tags[int(tag)] for tag in table.values[:, 0].tolist()]


def _antenna(mounted: Table | None) -> Place:
    if mounted is None:
        return NOWHERE
    if len(mounted.values) > 1 or not np.isfinite(mounted.values[0, :2]).all():
        raise RadioDataError(mounted.file, "more than one antenna, or one at no place", int(mounted.lines[-1]))
    ahead_m, left_m, up_m = np.nan_to_num(mounted.values[0]).tolist()
    return ahead_m, left_m, up_m
