"""The true state of a simulation, separate from the robot link: published by ZeroMQ and stored in a file."""

import os
import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from struct import Struct
from typing import Any

import msgspec
import zmq
import zmq.asyncio

from ccatp.core import DeckPose
from ccatp.links.bus import Publisher
from ccatp.links.topics import Message, Misalignment, TruthMessage
from ccatp.sim.plant import Plant
from ccatp.sim.world import TruthRow, World

MAX_REQUEST_BYTES = 4096


class TruthSource(ABC):
    """The true state of a simulated robot."""

    truth_rows = 100  # rows of one message

    @property
    def truth_requests(self) -> Mapping[str, Callable[[], dict[str, object]]]:
        """Functions that give the reply, by request."""
        return {}

    @abstractmethod
    def truth_row(self) -> tuple[Any, ...]:
        """The true state at the newest frame, as in the rows of ``truth_message``."""

    @abstractmethod
    def truth_message(self, rows: list[Any]) -> tuple[str, Message]:
        """Rows of the true state as a topic and its message."""

    @abstractmethod
    def truth_preface(self) -> tuple[str, Message]:
        """Topic and message that a recorder needs before the first rows."""

    @property
    def is_fallen(self) -> bool:
        """Whether the robot has fallen; the row of its fall is published at once."""
        return False

    def describe_fall(self) -> dict[str, object]:
        """Why and where it fell, for a log."""
        return {}


class SurveyTruth(TruthSource):
    """The true state of a robot on a mirror."""

    world: World
    seq: int
    t_s: float
    boots: Sequence[int] = (0,)  # ``seq`` before the first frame of each boot

    @property
    def truth_requests(self) -> Mapping[str, Callable[[], dict[str, object]]]:
        world = self.world
        return {
            "puck": lambda: {"t": self.t_s, "puck": world.puck_world(), "moved_m": world.moved_m()},
            "misalignment": lambda: {"panels": self._panels(), "start": msgspec.structs.astuple(world.start_pose)},
        }

    @property
    def is_fallen(self) -> bool:
        return self.world.is_fallen

    def describe_fall(self) -> dict[str, object]:
        x_m, y_m = self.world.plant.x_m, self.world.plant.y_m
        return {"cause": self.world.fall, "t_s": self.t_s, "x_m": round(x_m, 4), "y_m": round(y_m, 4)}

    def truth_row(self) -> TruthRow:
        return self.world.truth_row(self.seq, self.t_s)

    def truth_message(self, rows: list[TruthRow]) -> tuple[str, TruthMessage]:
        return "truth", TruthMessage(seq=self.seq, t_s=self.t_s, rows=rows, boots=[*self.boots])

    def truth_preface(self) -> tuple[str, Misalignment]:
        return "misalignment", Misalignment(seq=self.seq, t_s=self.t_s, panels=self._panels())

    def _panels(self) -> list[tuple[int, int, float, float, float]]:
        return [(*panel, m.piston_m, m.tip_rad, m.tilt_rad) for panel, m in self.world.misalignments.items()]


class GroundTruthPublisher:
    """Collects a row of the true state per frame, publishes them at ``pub`` and answers requests at ``rep``, if given.

    Replies are JSON. Requests are ``truth_requests`` of the robot and ``b"flush"``, which publishes the pending rows
    and replies ``{"rows": n}``, the number of rows so far. The reply to any other request is ``{"error": text}``.
    """

    def __init__(self, robot: TruthSource, rep: str | None = None, pub: str | None = None) -> None:
        self._robot = robot
        self._rows: list[Any] = []
        self._taken = 0
        self._was_fallen = self._has_sent_preface = False
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._publisher = Publisher(self._context, pub) if pub else None
        self._rep = zmq.asyncio.Context.shadow(self._context).socket(zmq.REP) if rep else None
        if self._rep is not None and rep:
            self._rep.setsockopt(zmq.LINGER, 0)
            self._rep.setsockopt(zmq.MAXMSGSIZE, MAX_REQUEST_BYTES)
            self._rep.bind(rep)
        self.add()

    def add(self) -> None:
        """Take the row of the newest frame; publish when there are ``truth_rows`` rows or the robot has just fallen."""
        robot = self._robot
        self._rows.append(robot.truth_row())
        has_fallen, self._was_fallen = robot.is_fallen is not self._was_fallen, robot.is_fallen
        if has_fallen or len(self._rows) >= robot.truth_rows:
            self.flush()

    def flush(self) -> None:
        """Publish the pending rows."""
        rows, self._rows = self._rows, []
        self._taken += len(rows)
        if not rows or self._publisher is None:
            return
        if not self._has_sent_preface:  # a recorder that has rows then has the preface, too, however the run ends
            self._has_sent_preface = True
            self._publisher.send(*self._robot.truth_preface())
        self._publisher.send(*self._robot.truth_message(rows))

    def answer(self, request: bytes) -> bytes:
        """The reply to a request."""
        known = self._robot.truth_requests
        name = request.decode("ascii", "replace")
        if name == "flush":
            self.flush()
            reply: dict[str, object] = {"rows": self._taken}
        elif name in known:
            reply = known[name]()
        else:
            reply = {"error": f"unknown request; known {'are' if known else 'is'} {', '.join((*known, 'flush'))}"}
        return msgspec.json.encode(reply)

    async def serve(self) -> None:
        """Answer requests until cancelled."""
        while self._rep is not None:
            await self._rep.send(self.answer(await self._rep.recv()))

    def close(self) -> None:
        """Release the sockets."""
        if self._rep is not None:
            self._rep.close()
        if self._publisher is not None:
            self._publisher.close()
        self._context.destroy(linger=0)


ROBOT_FILE = "robot"
PERIOD_FRAMES = 10
_POSE, _CRC = Struct("<3d"), Struct("<I")


class SimPoseFile:
    """Stores the true pose every ``PERIOD_FRAMES`` frames, so that the next run can start where this one ended.

    A real robot, too, stays where it is when its computer stops. The file is created with the first pose.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._fd = path, -1

    def read(self) -> DeckPose | None:
        """The last stored pose, deck frame; ``None`` if there is none or its checksum is wrong."""
        try:
            data = self._path.read_bytes()
        except OSError:
            return None
        body, crc = data[: _POSE.size], data[_POSE.size :]
        if len(crc) != _CRC.size or _CRC.unpack(crc)[0] != zlib.crc32(body):
            return None
        return DeckPose(*_POSE.unpack(body))

    def keep(self, seq: int, plant: Plant) -> None:
        """Store the pose after frame ``seq`` if ``seq`` is a multiple of ``PERIOD_FRAMES``."""
        if seq % PERIOD_FRAMES:
            return
        if self._fd < 0:
            self._fd = os.open(self._path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o600)
        body = _POSE.pack(plant.x_m, plant.y_m, plant.heading_rad)
        os.pwrite(self._fd, body + _CRC.pack(zlib.crc32(body)), 0)

    def close(self) -> None:
        """Close the file."""
        if self._fd >= 0:
            os.close(self._fd)
