"""The Foxglove message types that fit a survey, as JSON: field names and numbers are those of its schemas.

Only the fields that are used stand here; a viewer takes the others for empty.

The mirror as a 3D scene: panels with their labels, the rim, measured points coloured by their deviation.

JSON schemas in the form that viewers can read.

Foxglove and Lichtblick take a channel's schema for a list of fields: the root and every object have ``properties``,
each of a plain type, arrays hold plain types or objects. References, alternatives and arrays of arrays make them refuse
the channel. So references are put in place, and what cannot be said in these terms stands under ``patternProperties``,
where a validator sees it and a viewer does not look.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import msgspec

from ccatp.core import DeckPose, PanelId, PointId
from ccatp.mirror.mirror import Mirror

STRIP, LOOP, LIST = 0, 1, 2
LEVELS = {"debug": 1, "info": 2, "warning": 3, "error": 4, "fatal": 5}
_NS = 1_000_000_000


class Time(msgspec.Struct, frozen=True):
    """Seconds and nanoseconds."""

    sec: int
    nsec: int


class Vector3(msgspec.Struct, frozen=True):
    """A vector or a point, m."""

    x: float
    y: float
    z: float


class Quaternion(msgspec.Struct, frozen=True):
    """A rotation."""

    x: float
    y: float
    z: float
    w: float


class FoxglovePose(msgspec.Struct, frozen=True):
    """Position and orientation."""

    position: Vector3
    orientation: Quaternion


class Color(msgspec.Struct, frozen=True):
    """Red, green, blue, opacity, each 0 to 1."""

    r: float
    g: float
    b: float
    a: float


class PoseInFrame(msgspec.Struct, frozen=True):
    """``foxglove.PoseInFrame``."""

    timestamp: Time
    frame_id: str
    pose: FoxglovePose


class FrameTransform(msgspec.Struct, frozen=True):
    """``foxglove.FrameTransform``: where the child frame stands in the parent frame."""

    timestamp: Time
    parent_frame_id: str
    child_frame_id: str
    translation: Vector3
    rotation: Quaternion


class LinePrimitive(msgspec.Struct, frozen=True):
    """``foxglove.LinePrimitive``; ``type`` is ``STRIP``, ``LOOP`` or ``LIST``."""

    type: int
    pose: FoxglovePose
    thickness: float
    scale_invariant: bool
    points: Sequence[Vector3]
    color: Color


class Sphere(msgspec.Struct, frozen=True):
    """``foxglove.SpherePrimitive``; ``size`` holds diameters."""

    pose: FoxglovePose
    size: Vector3
    color: Color


class TextPrimitive(msgspec.Struct, frozen=True):
    """``foxglove.TextPrimitive``."""

    pose: FoxglovePose
    billboard: bool
    font_size: float
    scale_invariant: bool
    color: Color
    text: str


class KeyValue(msgspec.Struct, frozen=True):
    """``foxglove.KeyValuePair``."""

    key: str
    value: str


class Entity(msgspec.Struct, frozen=True):
    """``foxglove.SceneEntity``; one replaces the older one of the same ``id``. No lifetime: it stays."""

    timestamp: Time
    frame_id: str
    id: str
    frame_locked: bool
    lifetime: Time = Time(0, 0)
    metadata: Sequence[KeyValue] = ()
    spheres: Sequence[Sphere] = ()
    lines: Sequence[LinePrimitive] = ()
    texts: Sequence[TextPrimitive] = ()


class Deletion(msgspec.Struct, frozen=True):
    """``foxglove.SceneEntityDeletion``; type 0 takes the entity ``id`` away, type 1 all."""

    timestamp: Time
    type: int
    id: str


class SceneUpdate(msgspec.Struct, frozen=True):
    """``foxglove.SceneUpdate``."""

    deletions: Sequence[Deletion]
    entities: Sequence[Entity]


class FoxgloveLog(msgspec.Struct, frozen=True):
    """``foxglove.Log``; ``level`` is one of ``LEVELS``."""

    timestamp: Time
    level: int
    message: str
    name: str
    file: str = ""
    line: int = 0


def time_of(t_s: float) -> Time:
    """Robot time, s, as Foxglove's."""
    return Time(*divmod(round(t_s * _NS), _NS))


DECK = "deck"
NO_TURN = Quaternion(0.0, 0.0, 0.0, 1.0)
NOWHERE = FoxglovePose(Vector3(0.0, 0.0, 0.0), NO_TURN)
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
    outline = Entity(timestamp, DECK, "rim", False, lines=(LinePrimitive(LOOP, NOWHERE, RIM_PIXELS, True, rim, RED),))
    return SceneUpdate((), (*panels, outline))


def point_scene(
    mirror: Mirror, panels: Iterable[PanelId], deviations_m: dict[PointId, float], timestamp: Time
) -> SceneUpdate:
    """The measured points of some panels.

    Args:
        panels: each becomes an entity of its own, which replaces the older one.
        deviations_m: of each measured point from the ideal surface along the normal, m.
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
    outline = LinePrimitive(LOOP, NOWHERE, EDGE_PIXELS, True, _edge(mirror, corners), GREY)
    x, y, z = own.origin
    label = TextPrimitive(
        FoxglovePose(Vector3(x, y, z), NO_TURN), True, LABEL_M, False, DARK, f"{panel.row}-{panel.col}"
    )
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
    return Sphere(
        FoxglovePose(_on_surface(mirror, x, y), NO_TURN), Vector3(POINT_M, POINT_M, POINT_M), colour_of(deviation_m)
    )


def robot_rotation(mirror: Mirror, pose: DeckPose) -> Quaternion:
    """The robot's orientation in the deck frame."""
    return quaternion(mirror.robot_axes(pose))


def quaternion(axes: tuple[Sequence[float], Sequence[float], Sequence[float]]) -> Quaternion:
    """The rotation that takes x, y, z to three right-handed unit vectors (Shepperd 1978: divide by the largest)."""
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


Schema = dict[str, Any]
_PLAIN = ("boolean", "string", "number", "integer")


def plain_schema(schema: Mapping[str, Any], title: str) -> Schema:
    """The same schema for viewers.

    Args:
        schema: as ``msgspec.json.schema`` makes it.
    """
    return {**_resolved(schema, schema.get("$defs", {})), "title": title}


def _resolved(node: Any, definitions: Mapping[str, Any]) -> Any:
    if isinstance(node, list):
        return [_resolved(one, definitions) for one in node]
    if not isinstance(node, Mapping):
        return node
    if "$ref" in node:
        return _resolved(definitions[str(node["$ref"]).rpartition("/")[2]], definitions)
    found = {key: _resolved(value, definitions) for key, value in node.items() if key not in ("$defs", "title")}
    return _split(found) if found.get("type") == "object" and "properties" in found else found


def _split(schema: Schema) -> Schema:
    """Part the properties in those that viewers understand and the others."""
    plain, others = {}, {}
    for name, value in schema["properties"].items():
        if is_plain(value):
            plain[name] = value
        else:
            others[f"^{name}$"] = value
    return {**schema, "properties": plain, **({"patternProperties": others} if others else {})}


def is_plain(schema: Mapping[str, Any]) -> bool:
    """Whether viewers understand a property."""
    kind = schema.get("type")
    if kind == "array":
        items = schema.get("items")
        return isinstance(items, Mapping) and items.get("type") != "array" and is_plain(items)
    return kind in _PLAIN or (kind == "object" and "properties" in schema)
