"""What the edge rule asks the mirror's map: where the rim is, and which seam is near."""

from typing import Literal, NamedTuple

from ccatp.core import DeckPose, PanelId
from ccatp.mirror.mirror import Mirror

Axis = Literal["x", "y"]
Place = tuple[float, float]


class SeamNear(NamedTuple):
    """An interior seam: ``axis`` is the deck coordinate that is constant along it; ``distance_m`` is signed."""

    axis: Axis
    distance_m: float


class EdgeMap:
    """Queries of the edge rule to the mirror's map, in the deck frame, m."""

    def __init__(self, mirror: Mirror) -> None:
        self._mirror = mirror
        self._rim = mirror.rim
        self.gap_m = mirror.gap_m

    def place(self, pose: DeckPose, offset_m: Place) -> Place:
        """Deck (x, y) of a sensor at ``offset_m`` (robot frame) when the robot is at ``pose``."""
        return self._mirror.body_offset(pose, *offset_m)

    def is_rim_ahead(self, place: Place, direction: Place, reach_m: float, slack_m: float) -> bool:
        """Whether the rim is within ``slack_m`` of the next ``reach_m`` from ``place`` along the unit ``direction``."""
        x, y = place
        if self._rim.signed_distance_m(x, y) > reach_m + slack_m:
            return False
        ahead = x + reach_m * direction[0], y + reach_m * direction[1]
        return self._rim.segment_clearance_m(x, y, *ahead) <= slack_m

    def is_beyond_rim(self, place: Place) -> bool:
        """Whether a place is off the mirror."""
        return self._rim.signed_distance_m(*place) <= 0.0

    def has_edge_near(self, place: Place, slack_m: float) -> bool:
        """Whether a seam or the rim is within ``slack_m`` of a place."""
        return self._rim.signed_distance_m(*place) <= slack_m or self.seam_at(place, slack_m) is not None

    def seam_at(self, place: Place, slack_m: float, not_axis: Axis | None = None) -> SeamNear | None:
        """The nearest interior seam whose gap, widened by ``slack_m`` on both sides, contains a place.

        Seams of ``not_axis`` are left out.
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
