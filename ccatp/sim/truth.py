"""Pure. What leaves the simulation by the truth's own sockets: rows in batches, and answers to requests."""

import msgspec

from ccatp.sim.robot import Robot
from ccatp.sim.world import TruthRow
from ccatp.wire.topics import Misalignment, Truth

BATCH_ROWS = 100


class TruthLog:
    """Collects a row per frame.

    Requests, answered as JSON (SI; puck in the world frame, start pose in the deck frame):

    * ``b"puck"``: ``{"t", "puck": [x, y, z], "moved_m"}``, ``moved_m`` the furthest within the last measuring time;
    * ``b"misalignment"``: ``{"panels": [[row, col, piston_m, tip_rad, tilt_rad], ...], "start": [x, y, heading]}``;
    * ``b"flush"``: ``{"rows": n}``, the number of rows taken so far (the caller takes the pending ones first);
    * anything else: ``{"error"}``.

    Args:
        robot: whose truth it is.
    """

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._rows: list[TruthRow] = []
        self._taken = 0
        self._is_fallen = False
        self.add()

    def add(self) -> bool:
        """Add the row of the newest frame; true when the batch should be taken: it is full, or the robot fell."""
        robot = self._robot
        world = robot.world
        self._rows.append(world.truth_row(robot.seq, robot.t_s))
        has_changed = world.is_fallen is not self._is_fallen
        self._is_fallen = world.is_fallen
        return has_changed or len(self._rows) >= BATCH_ROWS

    def take(self) -> Truth | None:
        """The pending rows as a message of the topic table, or ``None`` without any."""
        rows, self._rows = self._rows, []
        self._taken += len(rows)
        return Truth(seq=self._robot.seq, t_s=self._robot.t_s, rows=rows) if rows else None

    def batch(self) -> tuple[str, Truth] | None:
        """The same with its topic."""
        rows = self.take()
        return None if rows is None else ("truth", rows)

    def preface(self) -> tuple[str, Misalignment]:
        """How the panels lie, with its topic."""
        return "misalignment", self.misalignment()

    def misalignment(self) -> Misalignment:
        """How the panels lie, as a message of the topic table."""
        return Misalignment(seq=self._robot.seq, t_s=self._robot.t_s, panels=self._panels())

    def _panels(self) -> list[tuple[int, int, float, float, float]]:
        found = self._robot.world.misalignments.items()
        return [(*panel, m.piston_m, m.tip_rad, m.tilt_rad) for panel, m in found]

    def answer(self, request: bytes) -> bytes:
        """The reply to a request."""
        world = self._robot.world
        reply: dict[str, object]
        if request == b"puck":
            reply = {"t": self._robot.t_s, "puck": world.puck_world(), "moved_m": world.moved_m()}
        elif request == b"flush":
            reply = {"rows": self._taken}
        elif request == b"misalignment":
            start = world.start_pose
            reply = {"panels": self._panels(), "start": (start.x_m, start.y_m, start.heading_rad)}
        else:
            reply = {"error": "unknown request; known are puck, misalignment, flush"}
        return msgspec.json.encode(reply)
