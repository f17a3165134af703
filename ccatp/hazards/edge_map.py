"""Pure. What the map says about a place where an edge sensor went off: rim ahead, seam, or neither."""

from typing import Literal, NamedTuple, Protocol

from ccatp.mirror.panels import Panel
from ccatp.samples import DeckPose, PanelId

Axis = Literal["x", "y"]


class RimMap(Protocol):
    """The outline of a mirror."""

    def signed_distance_m(self, x: float, y: float) -> float:
        """Distance to the rim, > 0 inside."""

    def segment_clearance_m(self, x0: float, y0: float, x1: float, y1: float) -> float:
        """Least signed distance along a segment."""


class MirrorMap(Protocol):
    """The part of a mirror that the danger rules look at."""

    @property
    def gap_m(self) -> float:
        """Width of a seam."""

    @property
    def panels(self) -> dict[PanelId, Panel]:
        """All panels."""

    @property
    def rim(self) -> RimMap:
        """The outline."""

    @property
    def overhang(self) -> bool:
        """The robot hangs and needs its fans."""

    @property
    def base_pose(self) -> DeckPose:
        """Where the robot starts and returns to."""

    @property
    def nearest_panel(self) -> "NearestPanel":
        """The panel whose cell is nearest to a deck point."""

    def body_offset(self, p: DeckPose, ox: float, oy: float) -> tuple[float, float]:
        """Deck place of a point of the robot."""


class NearestPanel(Protocol):
    """Call signature of ``MirrorMap.nearest_panel``."""

    def __call__(self, x: float, y: float) -> PanelId:
        """The panel nearest to the deck point."""


class SeamNear(NamedTuple):
    """An interior seam near a place: the deck coordinate that is constant along it, and the signed distance, m."""

    axis: Axis
    distance_m: float


class EdgeMap:
    """Look-ups of the edge rule in the deck plane, metres."""

    def __init__(self, mirror: MirrorMap) -> None:
        """Keep the mirror."""
        self._mirror = mirror
        self._rim = mirror.rim
        self.gap_m = mirror.gap_m

    def place(self, pose: tuple[float, float, float], offset_m: tuple[float, float]) -> tuple[float, float]:
        """Deck (x, y) of a sensor at ``offset_m`` (robot frame) of a robot at ``pose`` (x, y, heading)."""
        return self._mirror.body_offset(DeckPose(*pose), *offset_m)

    def is_rim_ahead(
        self, place: tuple[float, float], direction: tuple[float, float], reach_m: float, slack_m: float
    ) -> bool:
        """Whether a sensor at ``place`` that moves along the unit vector ``direction`` meets the rim.

        Args:
            place: deck (x, y), m.
            direction: unit vector in the deck plane.
            reach_m: how far ahead to look.
            slack_m: uncertainty of the place in every direction.
        """
        x, y = place
        if self._rim.signed_distance_m(x, y) > reach_m + slack_m:
            return False
        ahead = x + reach_m * direction[0], y + reach_m * direction[1]
        return self._rim.segment_clearance_m(x, y, *ahead) <= slack_m

    def is_beyond_rim(self, place: tuple[float, float]) -> bool:
        """Whether a place is off the mirror."""
        return self._rim.signed_distance_m(*place) <= 0.0

    def has_edge_near(self, place: tuple[float, float], slack_m: float) -> bool:
        """Whether a panel may end within ``slack_m`` of a place: at a seam or at the rim."""
        return self._rim.signed_distance_m(*place) <= slack_m or self.seam_at(place, slack_m) is not None

    def seam_at(self, place: tuple[float, float], slack_m: float, not_axis: Axis | None = None) -> SeamNear | None:
        """The nearest interior seam whose gap, widened by ``slack_m`` on both sides, holds the place.

        Args:
            place: deck (x, y), m.
            slack_m: uncertainty of the place across the seam.
            not_axis: leave out the seams along which this coordinate is constant.
        """
        x, y = place
        panel = self._mirror.panels[self._mirror.nearest_panel(x, y)]
        half_gap = 0.5 * self.gap_m
        row, col = panel.id
        panels = self._mirror.panels
        found: SeamNear | None = None
        # x grows with the column, y with the row: the seam lies half a gap beyond the panel's own edge.
        dx, dy = x - panel.x_m, y - panel.y_m
        to_x = SeamNear("x", dx - (panel.half_x_m + half_gap) * (1 if dx > 0.0 else -1))
        to_y = SeamNear("y", dy - (panel.half_y_m + half_gap) * (1 if dy > 0.0 else -1))
        across_x = PanelId(row, col + (1 if dx > 0.0 else -1))
        across_y = PanelId(row + (1 if dy > 0.0 else -1), col)
        for seam, neighbour in ((to_x, across_x), (to_y, across_y)):
            is_there = seam.axis != not_axis and neighbour in panels and abs(seam.distance_m) <= half_gap + slack_m
            if is_there and (found is None or abs(seam.distance_m) < abs(found.distance_m)):
                found = seam
        return found
