"""The localizers, and which one a configuration asks for."""

from collections.abc import Callable

import numpy as np

from ccatp.config.models import Config
from ccatp.control.motion_checks import ImuGate, WheelMeans, largest_rate_rad_s
from ccatp.core import DeckPose, PanelPose
from ccatp.estimation import state_model, thesis_localizer
from ccatp.estimation.full_state import FullStateLocalizer
from ccatp.estimation.thesis_localizer import FourStateLocalizer
from ccatp.filters import FILTERS, Filter
from ccatp.mirror.mirror import Mirror

FOUR_STATE = ("kf",)
"""Filters for linear models, which get the thesis's four states; all others get the full state."""


Localizer = FourStateLocalizer | FullStateLocalizer
"""Estimates the robot's pose from sensors frames and fixes (thesis chapter 2)."""


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
    is_thesis = name in FOUR_STATE
    # The localizer re-initialises its filter at once; what counts is its size.
    n = thesis_localizer.STATES if is_thesis else state_model.STATES
    filter_ = wrap(FILTERS[name](np.zeros(n), np.eye(n)))
    kind: type[Localizer] = FourStateLocalizer if is_thesis else FullStateLocalizer
    made = kind(filter_, mirror, cfg.robot, cfg.localizer, start)
    made.guard(ImuGate(cfg.health), WheelMeans(cfg.robot), largest_rate_rad_s(cfg.robot))
    return made


def build_with_uncertainty(
    cfg: Config,
    mirror: Mirror,
    pose: DeckPose,
    sigmas: tuple[float, float],
    wrap: Callable[[Filter], Filter] = lambda filter_: filter_,
) -> Localizer:
    """The localizer for ``run.filter`` at a deck ``pose`` seen last, with sigmas of place (m) and heading (rad)."""
    start = {"start_position_sigma_m": sigmas[0], "start_heading_sigma_rad": sigmas[1]}
    uncertain = cfg.model_copy(update={"localizer": cfg.localizer.model_copy(update=start)})
    return build_localizer(uncertain, mirror, wrap, mirror.panel_pose(mirror.nearest_panel(pose.x_m, pose.y_m), pose))
