"""Pure. What leaves the simulation of a robot among beacons by the truth's own sockets."""

import msgspec

from ccatp.sim.beacon_robot import BeaconRobot
from ccatp.wire.topics import BeaconPlaces, BeaconTruth

BATCH_ROWS = 50


class BeaconTruthLog:
    """Collects a row per frame.

    Requests, answered as JSON: ``b"flush"``: ``{"rows": n}``, the number of rows taken so far (the caller takes the
    pending ones first); anything else: ``{"error"}``.

    Args:
        robot: whose truth it is.
        motes_m: where the motes are, by name.
    """

    def __init__(self, robot: BeaconRobot, motes_m: dict[str, tuple[float, float]]) -> None:
        self._robot, self._motes_m = robot, motes_m
        self._rows: list[tuple[int, float, float, float, float, float | None, float | None, float | None]] = []
        self._taken = 0
        self.add()

    def add(self) -> bool:
        """Add the row of the newest frame; true when the batch should be taken."""
        robot = self._robot
        world = robot.world
        target = world.target_m or (None, None)
        clearance_m = world.clearance_m
        is_bounded = clearance_m < float("inf")
        self._rows.append((robot.seq, robot.t_s, *world.pose, *target, clearance_m if is_bounded else None))
        return len(self._rows) >= BATCH_ROWS

    def batch(self) -> tuple[str, BeaconTruth] | None:
        """The pending rows as a topic and its message, or ``None`` without any."""
        rows, self._rows = self._rows, []
        self._taken += len(rows)
        return ("beacon_truth", BeaconTruth(seq=self._robot.seq, t_s=self._robot.t_s, rows=rows)) if rows else None

    def preface(self) -> tuple[str, BeaconPlaces]:
        """Where radios and motes are."""
        places = {**self._robot.world.beacons_m, **self._motes_m}
        return "beacon_places", BeaconPlaces(seq=self._robot.seq, t_s=self._robot.t_s, places=places)

    def answer(self, request: bytes) -> bytes:
        """The reply to a request."""
        known = {"rows": self._taken} if request == b"flush" else {"error": "unknown request; known is flush"}
        return msgspec.json.encode(known)
