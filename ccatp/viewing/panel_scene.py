"""Pure. The mirror as a 3D scene: panels with their labels, the rim, measured points coloured by their deviation."""

from collections.abc import Iterable, Sequence

from ccatp.mirror.mirror import Mirror
from ccatp.samples import DeckPose, PanelId, PointId
from ccatp.viewing.foxglove import (
    LOOP,
    Color,
    Entity,
    KeyValue,
    Line,
    Pose,
    Quaternion,
    SceneUpdate,
    Sphere,
    Text,
    Time,
    Vector3,
)

DECK = "deck"
NO_TURN = Quaternion(0.0, 0.0, 0.0, 1.0)
NOWHERE = Pose(Vector3(0.0, 0.0, 0.0), NO_TURN)
GREY, DARK, RED = Color(0.62, 0.68, 0.74, 1.0), Color(0.25, 0.3, 0.36, 1.0), Color(0.84, 0.27, 0.27, 1.0)
LOW, EVEN, HIGH = (0.07, 0.25, 0.65), (0.95, 0.95, 0.9), (0.75, 0.1, 0.1)
FULL_SCALE_M = 2e-4  # deviations beyond it have the colour of the scale's end
POINT_M, LABEL_M = 0.04, 0.12
EDGE_PIXELS, RIM_PIXELS = 1.5, 3.0
# A panel's edge is a curve on the surface; eight chords of 90 mm stay within tenths of a millimetre of it.
CHORDS = 8


def panel_scene(mirror: Mirror, timestamp: Time) -> SceneUpdate:
    """Every panel's outline and label, and the rim, deck frame."""
    panels = [_panel_entity(mirror, panel, timestamp) for panel in mirror.panels]
    rim = [_on_surface(mirror, float(x), float(y)) for x, y in mirror.rim.vertices]
    outline = Entity(timestamp, DECK, "rim", False, lines=(Line(LOOP, NOWHERE, RIM_PIXELS, True, rim, RED),))
    return SceneUpdate((), (*panels, outline))


def point_scene(
    mirror: Mirror, panels: Iterable[PanelId], deviations_m: dict[PointId, float], timestamp: Time
) -> SceneUpdate:
    """The measured points of some panels.

    Args:
        mirror: where they lie.
        panels: each becomes an entity of its own, which replaces the older one.
        deviations_m: of each measured point from the ideal surface along the normal, m.
        timestamp: of the entities.
    """
    entities = []
    for panel in panels:
        measured = [point for point in mirror.point_ids(panel) if point in deviations_m]
        spheres = tuple(_sphere(mirror, point, deviations_m[point]) for point in measured)
        facts = tuple(KeyValue(f"point {p.point}", f"{1e6 * deviations_m[p]:.1f} um") for p in measured)
        entities.append(
            Entity(timestamp, DECK, f"points {panel.row}-{panel.col}", False, metadata=facts, spheres=spheres)
        )
    return SceneUpdate((), entities)


def colour_of(deviation_m: float) -> Color:
    """From blue (low) by way of white to red (high)."""
    share = max(-1.0, min(1.0, deviation_m / FULL_SCALE_M))
    end = HIGH if share > 0.0 else LOW
    r, g, b = (even + abs(share) * (most - even) for even, most in zip(EVEN, end, strict=True))
    return Color(r, g, b, 1.0)


def _panel_entity(mirror: Mirror, panel: PanelId, timestamp: Time) -> Entity:
    own = mirror.panel(panel)
    corners = [
        (own.x_m + sx * own.half_x_m, own.y_m + sy * own.half_y_m) for sx, sy in ((-1, -1), (1, -1), (1, 1), (-1, 1))
    ]
    outline = Line(LOOP, NOWHERE, EDGE_PIXELS, True, _edge(mirror, corners), GREY)
    x, y, z = own.origin
    label = Text(Pose(Vector3(x, y, z), NO_TURN), True, LABEL_M, False, DARK, f"{panel.row}-{panel.col}")
    return Entity(timestamp, DECK, f"panel {panel.row}-{panel.col}", False, lines=(outline,), texts=(label,))


def _edge(mirror: Mirror, corners: Sequence[tuple[float, float]]) -> list[Vector3]:
    points = []
    for (ax, ay), (bx, by) in zip(corners, [*corners[1:], corners[0]], strict=True):
        for i in range(CHORDS):
            share = i / CHORDS
            points.append(_on_surface(mirror, ax + share * (bx - ax), ay + share * (by - ay)))
    return points


def _on_surface(mirror: Mirror, x_m: float, y_m: float) -> Vector3:
    return Vector3(*(round(c, 5) for c in mirror.surface_point(x_m, y_m)))


def _sphere(mirror: Mirror, point: PointId, deviation_m: float) -> Sphere:
    x, y = mirror.point_on_deck(point)
    return Sphere(Pose(_on_surface(mirror, x, y), NO_TURN), Vector3(POINT_M, POINT_M, POINT_M), colour_of(deviation_m))


def robot_rotation(mirror: Mirror, pose: DeckPose) -> Quaternion:
    """The robot's orientation in the deck frame."""
    return quaternion(mirror.robot_axes(pose))


def quaternion(axes: tuple[Sequence[float], Sequence[float], Sequence[float]]) -> Quaternion:
    """The rotation that takes x, y, z to three right-handed unit vectors (Shepperd 1978: divide by the largest).

    Args:
        axes: where x, y and z come to lie.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = axes
    trace = xx + yy + zz
    squares = (trace, 2.0 * xx - trace, 2.0 * yy - trace, 2.0 * zz - trace)
    most = max(range(4), key=squares.__getitem__)
    double = (1.0 + squares[most]) ** 0.5  # at least 1: the four squares sum up to 4 times 1
    k = 0.5 / double
    if most == 0:
        return Quaternion(k * (yz - zy), k * (zx - xz), k * (xy - yx), 0.5 * double)
    if most == 1:
        return Quaternion(0.5 * double, k * (yx + xy), k * (zx + xz), k * (yz - zy))
    if most == 2:
        return Quaternion(k * (yx + xy), 0.5 * double, k * (zy + yz), k * (zx - xz))
    return Quaternion(k * (zx + xz), k * (zy + yz), 0.5 * double, k * (xy - yx))
