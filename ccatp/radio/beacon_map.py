"""Pure. Where beacons stand in the state: their columns, the error of each that wanders, joining and leaving."""

from collections.abc import Iterator
from dataclasses import dataclass
from math import exp

import numpy as np

from ccatp.filters.base import FloatArray
from ccatp.filters.ekf_slam import BlockId, Columns, EkfSlam, columns_of
from ccatp.radio.motion import POSE
from ccatp.radio.readings import BeaconId
from ccatp.radio.slam_settings import Wander

_NONE = np.empty(0, dtype=np.intp)


WANDER = "wander"
"""First part of the name of a block that holds a wandering error."""


def is_place(block: BlockId) -> bool:
    """Whether a block of the state begins with x_m and y_m."""
    return not (isinstance(block, tuple) and block[0] == WANDER)


@dataclass(slots=True)
class Entry:
    """A beacon on the map.

    Attributes:
        columns: pose, calibration, beacon and its wandering error, shape (k,).
        size: of the beacon's block.
        wander: column of the wandering error; -1: none.
        way_m, time_s: of the vehicle when the wandering error was last looked at.
        fresh: variance of what is new in the wandering error, in sigmas squared.
        refused: readings in a row that were not believed.
        on_trial: readings that must still agree with the one it joined by; 0: it is believed in.
    """

    columns: Columns
    size: int
    wander: int = -1
    way_m: float = 0.0
    time_s: float = 0.0
    fresh: float = 1.0
    refused: int = 0
    on_trial: int = 0


class BeaconMap:
    """The beacons' blocks of an ``EkfSlam``.

    Args:
        engine: the state.
        shared: where its calibration stands.
    """

    def __init__(self, engine: EkfSlam, shared: slice) -> None:
        self._engine, self._shared = engine, shared
        self._entries: dict[BeaconId, Entry] = {}

    def __contains__(self, beacon: BeaconId) -> bool:
        return beacon in self._entries

    def __iter__(self) -> Iterator[BeaconId]:
        return iter(self._entries)

    def __getitem__(self, beacon: BeaconId) -> Entry:
        return self._entries[beacon]

    def get(self, beacon: BeaconId) -> Entry | None:
        """A beacon; None where it is not on the map."""
        return self._entries.get(beacon)

    def join(self, beacon: BeaconId, mean: FloatArray, covariance: FloatArray) -> Entry:
        """A beacon that is correlated with nothing yet: mean (b,), covariance (b, b)."""
        self._append(beacon, mean, covariance)
        self._entries[beacon] = Entry(_NONE, mean.size)
        self.renumber()
        return self._entries[beacon]

    def leave(self, beacon: BeaconId) -> None:
        """Forget a beacon.

        Raises:
            BlockError: it is not on the map.
        """
        self._engine.remove(beacon)
        if (WANDER, beacon) in self._engine:
            self._engine.remove((WANDER, beacon))
        del self._entries[beacon]
        self.renumber()

    def renumber(self) -> None:
        """Find the columns anew, after a block has gone."""
        engine = self._engine
        for beacon, entry in self._entries.items():
            parts: list[slice] = [slice(0, POSE), self._shared, engine.block(beacon)]
            if (WANDER, beacon) in engine:
                parts.append(engine.block((WANDER, beacon)))
                entry.wander = parts[-1].start
            entry.columns = columns_of(*parts)

    def wander_to(self, beacon: BeaconId, model: Wander, way_m: float, time_s: float) -> None:
        """Bring a beacon's wandering error, in sigmas, to now: w <- phi w, variance <- phi^2 variance + 1 - phi^2."""
        entry = self._entries[beacon]
        if entry.wander < 0:
            self._append((WANDER, beacon), np.zeros(1), np.eye(1))
            self.renumber()
        else:
            phi = exp(-(way_m - entry.way_m) / model.length_m - max(time_s - entry.time_s, 0.0) / model.time_s)
            entry.fresh = 1.0 - phi * phi
            self._engine.relax(entry.wander, phi, entry.fresh)
        entry.way_m, entry.time_s = way_m, time_s

    def _append(self, block: object, mean: FloatArray, covariance: FloatArray) -> None:
        b = mean.size
        self._engine.augment(block, mean, _NONE, np.zeros((b, 0)), np.eye(b), covariance)
