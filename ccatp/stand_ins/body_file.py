"""Edge. Where the simulated robot stands while nobody simulates it: a real one stays where it is when its host dies."""

import os
import zlib
from pathlib import Path
from struct import Struct

from ccatp.samples import DeckPose
from ccatp.sim.robot import Robot

FILE = "robot"
PERIOD_FRAMES = 10
_POSE, _CRC = Struct("<3d"), Struct("<I")


class BodyFile:
    """Keeps the true pose, ten times a second of its time.

    Args:
        path: the file; made with the first pose.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._fd = path, -1

    def read(self) -> DeckPose | None:
        """The pose that was kept last, deck frame; ``None`` without a sound one."""
        try:
            data = self._path.read_bytes()
        except OSError:
            return None
        body, crc = data[: _POSE.size], data[_POSE.size :]
        if len(crc) != _CRC.size or _CRC.unpack(crc)[0] != zlib.crc32(body):
            return None
        return DeckPose(*_POSE.unpack(body))

    def keep(self, robot: Robot) -> None:
        """A frame has been driven."""
        if robot.seq % PERIOD_FRAMES:
            return
        if self._fd < 0:
            self._fd = os.open(self._path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o600)
        plant = robot.world.plant
        body = _POSE.pack(plant.x_m, plant.y_m, plant.heading_rad)
        os.pwrite(self._fd, body + _CRC.pack(zlib.crc32(body)), 0)

    def close(self) -> None:
        """Close the file."""
        if self._fd >= 0:
            os.close(self._fd)
