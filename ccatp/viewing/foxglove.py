"""Pure. The Foxglove message types that fit a survey, as JSON: field names and numbers are those of its schemas.

Only the fields that are used stand here; a viewer takes the others for empty.
"""

from collections.abc import Sequence

import msgspec

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


class Pose(msgspec.Struct, frozen=True):
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
    pose: Pose


class FrameTransform(msgspec.Struct, frozen=True):
    """``foxglove.FrameTransform``: where the child frame stands in the parent frame."""

    timestamp: Time
    parent_frame_id: str
    child_frame_id: str
    translation: Vector3
    rotation: Quaternion


class Line(msgspec.Struct, frozen=True):
    """``foxglove.LinePrimitive``; ``type`` is ``STRIP``, ``LOOP`` or ``LIST``."""

    type: int
    pose: Pose
    thickness: float
    scale_invariant: bool
    points: Sequence[Vector3]
    color: Color


class Sphere(msgspec.Struct, frozen=True):
    """``foxglove.SpherePrimitive``; ``size`` holds diameters."""

    pose: Pose
    size: Vector3
    color: Color


class Text(msgspec.Struct, frozen=True):
    """``foxglove.TextPrimitive``."""

    pose: Pose
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
    lines: Sequence[Line] = ()
    texts: Sequence[Text] = ()


class Deletion(msgspec.Struct, frozen=True):
    """``foxglove.SceneEntityDeletion``; type 0 takes the entity ``id`` away, type 1 all."""

    timestamp: Time
    type: int
    id: str


class SceneUpdate(msgspec.Struct, frozen=True):
    """``foxglove.SceneUpdate``."""

    deletions: Sequence[Deletion]
    entities: Sequence[Entity]


class Log(msgspec.Struct, frozen=True):
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
