"""The localizer: what the others may ask it, and which one a configuration asks for."""

from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np

from ccatp.config.models import Config
from ccatp.control.motion_checks import ImuGate, WheelMeans, largest_rate_rad_s
from ccatp.core import DeckPose, EdgeSample, Fix, FloatArray, GravitySample, ImuSample, PanelPose, WheelSample
from ccatp.estimation import measurements
from ccatp.estimation import state_model as survey_model
from ccatp.estimation.full_state import FullStateLocalizer
from ccatp.estimation.thesis_localizer import FourStateLocalizer
from ccatp.filters import FILTERS, Filter, Innovation
from ccatp.mirror.mirror import Mirror

FOUR_STATE = ("kf",)
"""Filters for linear models, which get the thesis's four states; all others get the full state."""


class Localizer(Protocol):
    """Estimates the robot's pose from sensors frames and fixes (thesis chapter 2)."""

    counts: dict[str, int]
    """What was refused or used, by name."""
    hold_cause: str
    """Why the mission should hold, or empty."""
    is_frozen: bool
    """The filter has diverged; the pose stands still until the next fix."""
    notices: list[str]
    """What an operator should read; whoever reads them empties the list."""

    @property
    def innovation(self) -> Innovation | None:
        """Of the last update that says how well the filter fits, or None."""

    @property
    def pose(self) -> PanelPose:
        """Estimated pose in the frame of the panel under the robot."""

    @property
    def deck_pose(self) -> DeckPose:
        """The same in the deck frame."""

    @property
    def t_s(self) -> float:
        """Robot time to which the pose belongs, s."""

    @property
    def speed_m_s(self) -> float:
        """Estimated forward speed."""

    @property
    def rate_rad_s(self) -> float:
        """Estimated angular rate."""

    @property
    def position_sigma_m(self) -> float:
        """Standard deviation of the position along its worst direction."""

    @property
    def heading_sigma_rad(self) -> float:
        """Standard deviation of the heading."""

    @property
    def pose_covariance(self) -> FloatArray:
        """Covariance of (x, y, heading), shape (3, 3), m and rad."""

    @property
    def creep(self) -> tuple[float, float]:
        """Estimated drift per metre of travel, in the plane of ``pose``."""

    @property
    def hold_requested(self) -> bool:
        """Whether the mission should hold."""

    def clear_hold(self) -> None:
        """Forget the cause for a hold."""

    def step(
        self,
        t_s: float,
        imu: Sequence[ImuSample],
        encoders: Sequence[WheelSample],
        edges: Sequence[EdgeSample],
        gravity: GravitySample | None = None,
    ) -> None:
        """Take one sensors frame."""

    def rest(self) -> None:
        """The mission takes the robot to be at rest."""

    def doubt(self, way_m: float, turn_rad: float) -> None:
        """The pose may be wrong by this much: it stays, its certainty goes."""

    def fuse_fix(self, fix: Fix) -> float:
        """Fuse a position of the puck; returns how far the pose jumped, m. Raises ``FixRefused``."""


def build_localizer(
    cfg: Config,
    mirror: Mirror,
    wrap: Callable[[Filter], Filter] = lambda filter_: filter_,
    start: PanelPose | None = None,
) -> Localizer:
    """The localizer for ``run.filter``, the robot at base or at ``start``; ``wrap`` is put around the filter.

    ``start`` is as well known as ``localizer.start_..._sigma`` says.
    """
    name = cfg.run.filter
    start = mirror.base_panel_pose if start is None else start
    # The localizer re-initialises its filter at once; what counts is its size.
    made: FourStateLocalizer | FullStateLocalizer
    if name in FOUR_STATE:
        n = measurements.STATES
        made = FourStateLocalizer(wrap(FILTERS[name](np.zeros(n), np.eye(n))), mirror, cfg.robot, cfg.localizer, start)
    else:
        n = survey_model.STATES
        made = FullStateLocalizer(wrap(FILTERS[name](np.zeros(n), np.eye(n))), mirror, cfg.robot, cfg.localizer, start)
    made.guard(ImuGate(cfg.health), WheelMeans(cfg.robot), largest_rate_rad_s(cfg.robot))
    return made


def build_doubting(
    cfg: Config,
    mirror: Mirror,
    pose: DeckPose,
    sigmas: tuple[float, float],
    wrap: Callable[[Filter], Filter] = lambda filter_: filter_,
) -> Localizer:
    """The localizer for ``run.filter`` at a deck ``pose`` seen last, with sigmas of place (m) and heading (rad)."""
    start = {"start_position_sigma_m": sigmas[0], "start_heading_sigma_rad": sigmas[1]}
    doubting = cfg.model_copy(update={"localizer": cfg.localizer.model_copy(update=start)})
    return build_localizer(doubting, mirror, wrap, mirror.panel_pose(mirror.nearest_panel(pose.x_m, pose.y_m), pose))
