"""Builds the localizer of a configuration."""

from ccatp.config.models import FOUR_STATE, Config
from ccatp.core import DeckPose, PanelPose
from ccatp.estimation.full_state import FullStateLocalizer
from ccatp.estimation.localizer_base import FilterWrap, unwrapped
from ccatp.estimation.thesis_localizer import FourStateLocalizer
from ccatp.mirror.mirror import Mirror

Localizer = FourStateLocalizer | FullStateLocalizer
"""Estimates the robot's pose from sensors frames and fixes (thesis chapter 2)."""


def build_localizer(
    cfg: Config,
    mirror: Mirror,
    wrap: FilterWrap = unwrapped,
    start: PanelPose | None = None,
) -> Localizer:
    """The localizer for ``run.filter`` with the robot at base or at ``start``; ``wrap`` wraps the filter.

    The standard deviations of the start are ``localizer.start_..._sigma``.
    """
    kind: type[Localizer] = FourStateLocalizer if cfg.run.filter in FOUR_STATE else FullStateLocalizer
    return kind(cfg, mirror, start or mirror.base_panel_pose, wrap)


def build_with_uncertainty(
    cfg: Config,
    mirror: Mirror,
    pose: DeckPose,
    sigmas: tuple[float, float],
    wrap: FilterWrap = unwrapped,
) -> Localizer:
    """The localizer for ``run.filter`` at a deck ``pose``; ``sigmas``: of position (m) and heading (rad)."""
    start = {"start_position_sigma_m": sigmas[0], "start_heading_sigma_rad": sigmas[1]}
    uncertain = cfg.model_copy(update={"localizer": cfg.localizer.model_copy(update=start)})
    return build_localizer(uncertain, mirror, wrap, mirror.panel_pose(mirror.nearest_panel(pose.x_m, pose.y_m), pose))
