"""Pure. In which order the measurement points are visited: the thesis's, table 3.1 and fig. 3.2, and a faster one."""

from collections.abc import Callable

from ccatp.config.models import LimitsConfig
from ccatp.mirror.mirror import Mirror
from ccatp.planning.serpentine import fastest_serpentine
from ccatp.samples import PanelId, PointId

# Mirror, number of panels (0 = all): a resumed mission and its summary find the same order from nothing else.
Order = Callable[[Mirror, int], list[PointId]]

# By these, those of the thesis's robot (its speed) and of the stand-in (the rest, UNVERIFIED), turns are weighed
# against ways. Not by the configured ones: a survey goes on in the order in which it began, whatever its limits are.
NOMINAL_LIMITS = LimitsConfig(v_max_m_s=0.1, a_max_m_s2=0.2, omega_max_rad_s=1.0, alpha_max_rad_s2=2.0)

# Points 1 to 9 are numbered row by row from the panel's lower left (thesis fig. 2.2). Each order is a serpentine over
# the three rows of points; it begins on the side on which the robot enters the panel.
PANEL_ORDERS: dict[int, tuple[int, ...]] = {
    1: (1, 2, 3, 6, 5, 4, 7, 8, 9),  # lower left to upper right
    2: (3, 2, 1, 4, 5, 6, 9, 8, 7),  # lower right to upper left
    3: (9, 8, 7, 4, 5, 6, 3, 2, 1),  # upper right to lower left
    4: (7, 8, 9, 6, 5, 4, 1, 2, 3),  # upper left to lower right
}

# Thesis table 3.1, keyed by (row mod 2, column mod 2), both counted from 1 over the mirror's whole grid.
ORDER_BY_PARITY: dict[tuple[int, int], int] = {(1, 1): 1, (1, 0): 4, (0, 1): 2, (0, 0): 3}


def panel_order(panel: PanelId) -> tuple[int, ...]:
    """Numbers of the nine points of a panel in the order of thesis table 3.1."""
    return PANEL_ORDERS[ORDER_BY_PARITY[panel.row % 2, panel.col % 2]]


def thesis_order(mirror: Mirror, panels: int = 0) -> list[PointId]:
    """Points of the mirror in the order of the thesis: panel by panel, odd rows towards +column, even rows back.

    Args:
        mirror: the mirror.
        panels: take the first so many panels only; 0 = all.

    Returns:
        Nine points per panel, each exactly once.

    Raises:
        ValueError: if ``panels`` is negative.
    """
    if panels < 0:
        raise ValueError(f"panels = {panels}: a survey takes 0 (= all) or more panels")
    serpentine = sorted(mirror.panels, key=lambda p: (p.row, p.col if p.row % 2 else -p.col))
    chosen = serpentine[:panels] if panels else serpentine
    return [PointId(panel.row, panel.col, number) for panel in chosen for number in panel_order(panel)]


def optimised_order(mirror: Mirror, panels: int = 0, limits: LimitsConfig = NOMINAL_LIMITS) -> list[PointId]:
    """The same points in whole lines across the panels, see ``fastest_serpentine``.

    Args:
        mirror: the mirror.
        panels: take the points of the first so many panels of the thesis's order only; 0 = all.
        limits: motion limits by which turns are weighed against ways.

    Returns:
        Nine points per panel, each exactly once.

    Raises:
        ValueError: if ``panels`` is negative.
    """
    return fastest_serpentine(mirror, thesis_order(mirror, panels), limits)


def no_points(mirror: Mirror, panels: int = 0) -> list[PointId]:
    """None: a drive that consists of its calibration alone."""
    del mirror, panels
    return []


ORDERS: dict[str, Order] = {"thesis": thesis_order, "optimised": optimised_order, "calibration": no_points}
