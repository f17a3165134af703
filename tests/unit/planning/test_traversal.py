"""Pure. Thesis table 3.1, literally."""

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import pytest

from ccatp.core import PanelId
from ccatp.mirror.mirror import Mirror
from ccatp.survey.planning.route import ORDERS, panel_order, thesis_order


@pytest.mark.parametrize(
    ("panel", "numbers"),
    [
        (PanelId(3, 5), (1, 2, 3, 6, 5, 4, 7, 8, 9)),  # order 1: odd row, odd column
        (PanelId(3, 6), (7, 8, 9, 6, 5, 4, 1, 2, 3)),  # order 4: odd row, even column
        (PanelId(4, 5), (3, 2, 1, 4, 5, 6, 9, 8, 7)),  # order 2: even row, odd column
        (PanelId(4, 6), (9, 8, 7, 4, 5, 6, 3, 2, 1)),  # order 3: even row, even column
    ],
)
def test_orders_of_table_3_1(panel: PanelId, numbers: tuple[int, ...], thesis: Any) -> None:
    assert panel_order(panel) == numbers
    order = [point.point for point in thesis_order(thesis.mirror) if point.panel == panel]
    assert tuple(order) == numbers


@pytest.mark.parametrize(
    ("panel", "first", "last"),
    [
        (PanelId(3, 5), ("left", "lower"), ("right", "upper")),
        (PanelId(3, 6), ("left", "upper"), ("right", "lower")),
        (PanelId(4, 5), ("right", "lower"), ("left", "upper")),
        (PanelId(4, 6), ("right", "upper"), ("left", "lower")),
    ],
)
def test_where_an_order_begins_and_ends(
    panel: PanelId, first: tuple[str, str], last: tuple[str, str], thesis: Any
) -> None:
    mirror: Mirror = thesis.mirror
    points = [point for point in thesis_order(mirror) if point.panel == panel]
    for point, (side, height) in ((points[0], first), (points[-1], last)):
        x, y = mirror.point_on_deck(point)
        centre = mirror.panels[panel]
        assert (x < centre.x_m - 0.2) == (side == "left")
        assert (y < centre.y_m - 0.2) == (height == "lower")


def test_odd_rows_run_towards_plus_column_and_even_rows_back(world: Any) -> None:
    panels = list(dict.fromkeys(point.panel for point in thesis_order(world.mirror)))
    for row in range(1, world.mirror.rows + 1):
        cols = [panel.col for panel in panels if panel.row == row]
        assert cols == sorted(cols, reverse=row % 2 == 0)
    assert [panel.row for panel in panels] == sorted(panel.row for panel in panels)


def test_within_a_panel_each_point_is_next_to_the_last(world: Any) -> None:
    points = thesis_order(world.mirror)
    for a, b in pairwise(points):
        if a.panel == b.panel:
            (ya, xa), (yb, xb) = divmod(a.point - 1, 3), divmod(b.point - 1, 3)
            assert abs(ya - yb) + abs(xa - xb) == 1


def test_first_panels(load: Callable[[str], Any]) -> None:
    mirror = load("fyst-m1").mirror
    assert thesis_order(mirror, 3) == thesis_order(mirror)[:27]
    assert thesis_order(mirror, 1000) == thesis_order(mirror)


def test_registry(thesis: Any) -> None:
    assert ORDERS["thesis"](thesis.mirror, 1) == thesis_order(thesis.mirror, 1)


def test_negative_number_of_panels(thesis: Any) -> None:
    with pytest.raises(ValueError, match=r"panels = -1: .* 0 \(= all\)"):
        thesis_order(thesis.mirror, -1)
