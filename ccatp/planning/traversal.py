"""Pure. The order in which the measurement points are visited, thesis table 3.1 and fig. 3.2."""

from collections.abc import Callable

from ccatp.mirror.mirror import Mirror
from ccatp.samples import PanelId, PointId

Order = Callable[[Mirror, int], list[PointId]]

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


ORDERS: dict[str, Order] = {"thesis": thesis_order}
