"""What every robot on its own computer is: a robot behind the link whose devices are read and driven in a control loop.

``control`` runs the wheels at the rate of the loop; ``advance_to`` closes the frame that is due. Time is an argument.
"""

from abc import abstractmethod
from typing import Any, TypeVar

from ccatp.links.robot_messages import CommandEcho
from ccatp.onboard.rules import LinkedRobot

SAME_S = 1e-9
LINE_SAMPLES = 24  # of one sensor in a line: a burst after a gap must not exceed the line's limit

Row = TypeVar("Row", bound=tuple[Any, ...])


class ControlledRobot(LinkedRobot):
    """The robot; its hardware has been started.

    Attributes:
        loop_hz: rate of the control loop.
        faults: reason of each present fault, by its name on the link or that of a device.
        late_steps: steps of the control loop that came later than a barrier outside this program waits.
        dropped_samples: samples in no frame: a frame had too many, or they arrived after their frame.
    """

    loop_hz: float

    def __init__(
        self,
        limits: tuple[float, float, float],
        frame_hz: float,
        sample_latency_s: float,
        commands_delay_frames: int = 0,
    ) -> None:
        super().__init__(limits, 1.0 / frame_hz, frame_hz, commands_delay_frames)
        self._sample_latency_s = sample_latency_s
        self.faults: dict[str, str] = {}
        self.late_steps = self.dropped_samples = 0
        self._line = b""

    @abstractmethod
    def control(self, now_s: float) -> None:
        """Read the devices and drive the wheels, at ``now_s`` of the robot's clock."""

    @abstractmethod
    def _close_frame(self, t_s: float) -> None:
        """Make the line of the frame ``seq`` with the samples up to ``t_s``."""

    def advance(self) -> None:
        """Close the next frame with every sample since the last one."""
        self.seq += 1
        self._close_frame(self.seq / self.frame_hz)

    def advance_to(self, now_s: float) -> None:
        """Close the frame that is due at ``now_s``; frames that were missed in a stop of this computer are skipped.

        Its time is ``sample_latency_s`` ago, so that it contains every sample since the last frame.
        """
        t_s = max(now_s - self._sample_latency_s, self.t_s + 0.1 * self.frame_s)
        self.seq = max(self.seq + 1, int(now_s * self.frame_hz + 1e-6))
        self._close_frame(t_s)

    @property
    def delivered_line(self) -> bytes:
        """The newest frame as a line; empty before the first."""
        return self._line

    def _echo(self, t_s: float) -> CommandEcho:
        drive_seq, age_s, permit_age_s, is_held = self.rules.echo(t_s)
        return CommandEcho(drive_seq, round(age_s, 6), round(permit_age_s, 6), is_held)

    def _take_samples(self, samples: list[Row], since_s: float, most: int = LINE_SAMPLES) -> list[Row]:
        """Remove and return the samples of the frame; later ones stay in ``samples``."""
        end = next((k for k, row in enumerate(samples) if row[0] > self.t_s + SAME_S), len(samples))
        due, samples[:] = samples[:end], samples[end:]
        found = [row for row in due if row[0] > since_s + SAME_S or not since_s][-most:]
        self.dropped_samples += end - len(found)
        return found
