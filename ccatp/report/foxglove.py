"""Message types of Foxglove, the mirror as a 3D scene, and JSON schemas that viewers can read.

Field names and numbers are those of Foxglove's schemas; fields that are not used are left out, viewers take them as
empty.

Foxglove and Lichtblick read a channel's schema as a list of fields: the root and every object have ``properties``, each
of a plain type, and arrays hold plain types or objects. They refuse a channel with references, alternatives or arrays
of arrays. Therefore references are resolved, and other properties stand under ``patternProperties``, which validators
use and viewers ignore.
"""

from collections.abc import Iterable, Mapping, Sequence
from types import GenericAlias
from typing import Any

import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from ccatp.core import DeckPose, PanelId, PointId
from ccatp.mirror.mirror import Mirror

LOOP = 1  # of LinePrimitive.type
LEVELS = {"debug": 1, "info": 2, "warning": 3, "error": 4, "fatal": 5}
_NS = 1_000_000_000


def _message(title: str, /, **fields: Any) -> Any:
    return msgspec.defstruct(title, [(name, *_field(kind)) for name, kind in fields.items()], frozen=True)


def _field(kind: Any) -> tuple[Any, ...]:
    if isinstance(kind, tuple):
        return *_field(kind[0]), kind[1]
    return (GenericAlias(list, tuple(kind)) if isinstance(kind, list) else kind,)


# Lengths in m, colours 0 to 1. A field is a type, an array of a type, or one of these and its default.
Time = _message("Time", sec=int, nsec=int)
Vector = _message("Vector3", x=float, y=float, z=float)
Quaternion = _message("Quaternion", x=float, y=float, z=float, w=float)
Pose = _message("Pose", position=Vector, orientation=Quaternion)
Color = _message("Color", r=float, g=float, b=float, a=float)
KeyValuePair = _message("KeyValuePair", key=str, value=str)
PoseInFrame = _message("PoseInFrame", timestamp=Time, frame_id=str, pose=Pose)
FrameTransform = _message(
    "FrameTransform",
    timestamp=Time, parent_frame_id=str, child_frame_id=str, translation=Vector, rotation=Quaternion,
)  # fmt: skip
LinePrimitive = _message(
    "LinePrimitive",
    type=int, pose=Pose, thickness=float, scale_invariant=bool, points=[Vector], color=Color,
)  # fmt: skip
SpherePrimitive = _message("SpherePrimitive", pose=Pose, size=Vector, color=Color)
TextPrimitive = _message(
    "TextPrimitive", pose=Pose, billboard=bool, font_size=float, scale_invariant=bool, color=Color, text=str
)
# An entity replaces the older one of the same id, and stays for ever with a lifetime of 0.
SceneEntity = _message(
    "SceneEntity",
    timestamp=Time, frame_id=str, id=str, frame_locked=bool, lifetime=(Time, Time(0, 0)),
    metadata=([KeyValuePair], ()), spheres=([SpherePrimitive], ()), lines=([LinePrimitive], ()),
    texts=([TextPrimitive], ()),
)  # fmt: skip
SceneEntityDeletion = _message("SceneEntityDeletion", timestamp=Time, type=int, id=str)
SceneUpdate = _message("SceneUpdate", deletions=[SceneEntityDeletion], entities=[SceneEntity])
Log = _message("Log", timestamp=Time, level=int, message=str, name=str, file=(str, ""), line=(int, 0))


def time_of(t_s: float) -> Any:
    """Robot time, s, as a ``Time``."""
    return Time(*divmod(round(t_s * _NS), _NS))


DECK = "deck"
UPRIGHT = Quaternion(0.0, 0.0, 0.0, 1.0)
ORIGIN = Pose(Vector(0.0, 0.0, 0.0), UPRIGHT)
GREY, DARK, RED = Color(0.62, 0.68, 0.74, 1.0), Color(0.25, 0.3, 0.36, 1.0), Color(0.84, 0.27, 0.27, 1.0)
LOW, EVEN, HIGH = (0.07, 0.25, 0.65), (0.95, 0.95, 0.9), (0.75, 0.1, 0.1)
FULL_SCALE_M = 2e-4  # deviations beyond it have the colour of the scale's end
POINT_M, LABEL_M = 0.04, 0.12
EDGE_PIXELS, RIM_PIXELS = 1.5, 3.0
# A panel's edge is a curve on the surface; eight chords of 90 mm stay within tenths of a millimetre of it.
CHORDS = 8


def panel_scene(mirror: Mirror, timestamp: Any) -> Any:
    """Every panel's outline and label, and the rim, deck frame."""
    panels = [_panel_entity(mirror, panel, timestamp) for panel in mirror.panels]
    rim = [_on_surface(mirror, float(x), float(y)) for x, y in mirror.rim.vertices]
    outline = SceneEntity(
        timestamp, DECK, "rim", False, lines=(LinePrimitive(LOOP, ORIGIN, RIM_PIXELS, True, rim, RED),)
    )
    return SceneUpdate((), (*panels, outline))


def point_scene(mirror: Mirror, panels: Iterable[PanelId], deviations_m: dict[PointId, float], timestamp: Any) -> Any:
    """The measured points of some panels, an entity for each.

    Args:
        deviations_m: of each measured point from the ideal surface along the normal, m.
    """
    entities = []
    for panel in panels:
        measured = [point for point in mirror.point_ids(panel) if point in deviations_m]
        spheres = tuple(_sphere(mirror, point, deviations_m[point]) for point in measured)
        facts = tuple(KeyValuePair(f"point {p.point}", f"{1e6 * deviations_m[p]:.1f} um") for p in measured)
        entities.append(
            SceneEntity(timestamp, DECK, f"points {panel.row}-{panel.col}", False, metadata=facts, spheres=spheres)
        )
    return SceneUpdate((), entities)


def colour_of(deviation_m: float) -> tuple[float, float, float]:
    """Red, green and blue, 0 to 1, from blue (low) by way of white to red (high)."""
    share = max(-1.0, min(1.0, deviation_m / FULL_SCALE_M))
    end = HIGH if share > 0.0 else LOW
    r, g, b = (even + abs(share) * (most - even) for even, most in zip(EVEN, end, strict=True))
    return r, g, b


def _panel_entity(mirror: Mirror, panel: PanelId, timestamp: Any) -> Any:
    own = mirror.panel(panel)
    corners = [
        (own.x_m + sx * own.half_x_m, own.y_m + sy * own.half_y_m) for sx, sy in ((-1, -1), (1, -1), (1, 1), (-1, 1))
    ]
    outline = LinePrimitive(LOOP, ORIGIN, EDGE_PIXELS, True, _edge(mirror, corners), GREY)
    x, y, z = own.origin
    label = TextPrimitive(Pose(Vector(x, y, z), UPRIGHT), True, LABEL_M, False, DARK, f"{panel.row}-{panel.col}")
    return SceneEntity(timestamp, DECK, f"panel {panel.row}-{panel.col}", False, lines=(outline,), texts=(label,))


def _edge(mirror: Mirror, corners: Sequence[tuple[float, float]]) -> list[Any]:
    points = []
    for (ax, ay), (bx, by) in zip(corners, [*corners[1:], corners[0]], strict=True):
        for i in range(CHORDS):
            share = i / CHORDS
            points.append(_on_surface(mirror, ax + share * (bx - ax), ay + share * (by - ay)))
    return points


def _on_surface(mirror: Mirror, x_m: float, y_m: float) -> Any:
    return Vector(*(round(c, 5) for c in mirror.surface_point(x_m, y_m)))


def _sphere(mirror: Mirror, point: PointId, deviation_m: float) -> Any:
    x, y = mirror.point_on_deck(point)
    return SpherePrimitive(
        Pose(_on_surface(mirror, x, y), UPRIGHT), Vector(POINT_M, POINT_M, POINT_M), Color(*colour_of(deviation_m), 1.0)
    )


def robot_rotation(mirror: Mirror, pose: DeckPose) -> Any:
    """The robot's orientation in the deck frame."""
    return quaternion(mirror.robot_axes(pose))


def quaternion(axes: tuple[Sequence[float], Sequence[float], Sequence[float]]) -> Any:
    """The rotation that takes x, y, z to three right-handed unit vectors."""
    return Quaternion(*Rotation.from_matrix(np.array(axes).T).as_quat().tolist())


Schema = dict[str, Any]
_PLAIN = ("boolean", "string", "number", "integer")


def plain_schema(schema: Mapping[str, Any], title: str) -> Schema:
    """A schema of ``msgspec.json.schema`` in the form for viewers."""
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
    plain = {name: value for name, value in schema["properties"].items() if _is_plain(value)}
    others = {f"^{name}$": value for name, value in schema["properties"].items() if name not in plain}
    return {**schema, "properties": plain, **({"patternProperties": others} if others else {})}


def _is_plain(schema: Mapping[str, Any]) -> bool:
    kind = schema.get("type")
    if kind == "array":
        items = schema.get("items")
        return isinstance(items, Mapping) and items.get("type") != "array" and _is_plain(items)
    return kind in _PLAIN or (kind == "object" and "properties" in schema)
