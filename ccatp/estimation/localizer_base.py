"""What every localizer does with a frame: order of time, holds, divergence, the panel under the robot."""

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Sequence
from math import atan2, cos, sin, sqrt
from typing import Generic, TypeVar

from ccatp.control.motion_checks import ImuGate, WheelMeans
from ccatp.core import EdgeSample, GravitySample, ImuSample, PanelId, PanelPose, WheelSample
from ccatp.estimation.sample_validation import BACKWARD_LIMIT, FrameKind, FrameTimeCheck, SampleValidator
from ccatp.estimation.state_model import Slope
from ccatp.filters.base import FilterDiverged
from ccatp.mirror.mirror import Mirror

Taken = TypeVar("Taken")


class LocalizerBase(ABC, Generic[Taken]):
    """Admits frames in order of time, and asks to hold when time or the filter go wrong.

    ``hold_cause`` stays until ``clear_hold``; ``is_frozen``: the filter has diverged, and the pose stands still until
    the next fix; ``notices`` for the operator are removed by their reader. Samples older than ``history_s`` are
    refused.
    """

    def __init__(self, history_s: float) -> None:
        self.counts: dict[str, int] = Counter()
        self.hold_cause = ""
        self.is_frozen = False
        self.notices: list[str] = []
        self._clock = FrameTimeCheck()
        self._intake = SampleValidator(history_s, self.counts)
        self._guard: tuple[ImuGate, WheelMeans] | None = None

    def guard(self, gate: ImuGate, means: WheelMeans, largest_rate_rad_s: float) -> None:
        """From now on leave out inertial samples that the gate does not believe, and wheels faster than any is."""
        self._guard = gate, means
        self._intake.largest_rate_rad_s = largest_rate_rad_s

    @property
    def t_s(self) -> float:
        """Robot time to which the pose belongs: that of the last frame used; -inf before the first."""
        return self._clock.t_s

    @property
    def hold_requested(self) -> bool:
        """Whether the mission should hold."""
        return bool(self.hold_cause)

    def clear_hold(self) -> None:
        """Forget the cause for a hold; one that persists comes back."""
        self.hold_cause = ""

    def step(
        self,
        t_s: float,
        imu: Sequence[ImuSample],
        encoders: Sequence[WheelSample],
        edges: Sequence[EdgeSample],
        gravity: GravitySample | None = None,
    ) -> None:
        """Take one sensors frame of robot time ``t_s``, to which the pose belongs afterwards.

        Any number of samples of each kind, each with its own time, oldest first. Unusable ones are dropped and counted;
        a frame that is not newer than the last one changes nothing. ``gravity``: its direction in the robot frame,
        where it was read.
        """
        last_s, kind = self._clock.t_s, self._clock.admit(t_s)
        dt_s = t_s - last_s if kind is FrameKind.NEXT else 0.0
        if kind is FrameKind.RESYNC:
            if self._guard is not None:
                self._guard[0].reset()
            self._resync(t_s, last_s)
        elif kind is not FrameKind.NEXT:
            self.counts[f"{kind.value}_frames"] += 1
            if self._clock.stale_run >= BACKWARD_LIMIT:
                self._request_hold("time stamps of the frames run backward")
            return
        if self._guard is not None:
            gate, means = self._guard
            means.take(encoders, dt_s)
            believed = gate.admit(imu, means.yaw_rad_s) if imu else imu
            if len(believed) != len(imu):
                self.counts["imu_doubted"] += len(imu)
            imu = believed
        taken = self._take(t_s, imu, encoders)
        if self._intake.backward_source:
            self._request_hold(f"time stamps of the {self._intake.backward_source} run backward")
            self._intake.backward_source = ""
        if self.is_frozen:
            return
        try:
            self._use(t_s, dt_s, taken, edges, gravity)
        except FilterDiverged as error:
            self._freeze(error)

    def _freeze(self, error: FilterDiverged) -> None:
        self.is_frozen = True
        self.counts["diverged"] += 1
        self._request_hold(f"filter: {error}")

    def _request_hold(self, cause: str) -> None:
        self.hold_cause = self.hold_cause or cause

    @abstractmethod
    def _resync(self, t_s: float, last_s: float) -> None:
        """Go on in a new time base that begins at ``t_s``; ``last_s`` is the end of the old one, -inf at the start."""

    @abstractmethod
    def _take(self, t_s: float, imu: Sequence[ImuSample], encoders: Sequence[WheelSample]) -> Taken: ...

    @abstractmethod
    def _use(
        self, t_s: float, dt_s: float, taken: Taken, edges: Sequence[EdgeSample], gravity: GravitySample | None
    ) -> None:
        """Bring the filter to ``t_s``, ``dt_s`` after the last frame (0 in a new time base). May diverge."""


_NEAR_BORDER = 0.95  # part of a panel's half size beyond which the cell under the robot is looked up


class PanelFrame:
    """The panel under the robot, and poses in its frame."""

    def __init__(self, mirror: Mirror, panel: PanelId) -> None:
        self._mirror = mirror
        self.at = mirror.panel(panel)

    def hand_over(self, x: float, y: float) -> None:
        """The robot is at this deck point."""
        at = self.at
        if abs(x - at.x_m) > _NEAR_BORDER * at.half_x_m or abs(y - at.y_m) > _NEAR_BORDER * at.half_y_m:
            panel = self._mirror.panel_at(x, y)
            if panel is not None:
                self.at = self._mirror.panel(panel)

    def pose(self, deck: tuple[float, float, float], height_m: float, slope: Slope) -> PanelPose:
        """A deck pose (x, y, heading) on a surface of this height and slope, as ``Mirror.panel_pose``."""
        x, y, psi = deck
        fx, fy = slope[0], slope[1]
        s2 = 1.0 + fx * fx
        s, norm = sqrt(s2), sqrt(s2 + fy * fy)
        c, d = cos(psi), sin(psi)
        hx, hy = c / s - d * fx * fy / (norm * s), d * s / norm
        along, across, _ = self.at.rotate_from_deck((hx, hy, fx * hx + fy * hy))
        panel_x, panel_y, _ = self.at.from_deck((x, y, height_m))
        return PanelPose(self.at.id, panel_x, panel_y, atan2(across, along))
