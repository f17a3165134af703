"""The radios of a vehicle that has several: the readings of one of them are used, at the place of that one."""

from collections.abc import Mapping
from pathlib import Path

from ccatp.beacons.datasets.tables import RadioDataError, listed


def chosen_tag(file: Path, counts: Mapping[str, int], wanted: str, warnings: list[str]) -> str:
    """The tag whose readings are used: the wanted one, or the one with most; with a warning if there are others.

    ``counts``: number of readings by tag. Raises RadioDataError: there is no reading of the wanted one.
    """
    if wanted and wanted not in counts:
        raise RadioDataError(file, f"has no reading of tag {wanted}; there are {listed(list(counts)) or 'none'}")
    tag = wanted or max(counts, key=lambda one: counts[one], default="")
    if len(counts) > 1:
        others = listed([f"{one} ({count})" for one, count in counts.items() if one != tag])
        warnings.append(
            f"readings of tag {tag} ({counts[tag]}) are used, those of the tags {others} are not: --tag chooses another"
        )
    return tag
