"""Tests of what viewers are told: schemas they can read, Foxglove's own field names."""

from typing import Any

import foxglove.messages as sdk
import msgspec
import pytest

from ccatp.config.load import load_config
from ccatp.core import PanelId, PointId
from ccatp.links.topics import TOPICS
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.report.foxglove import (
    VIEWS,
    colour_of,
    panel_scene,
    plain_schema,
    point_scene,
    recorded_schemas,
    time_of,
    view_schemas,
)

PLAIN = ("boolean", "string", "number", "integer")


@pytest.fixture(scope="module")
def mirror() -> Mirror:
    return build_mirror(load_config().mirror)


def read_like_a_viewer(schema: dict[str, Any], where: str) -> None:
    """The rules of Lichtblick's reader of schemas: whatever it would refuse fails here."""
    assert schema.get("type") == "object", f"{where}: {schema.get('type')}"
    for name, found in schema["properties"].items():
        field = found["items"] if found.get("type") == "array" else found
        kind = field.get("type")
        assert kind in (*PLAIN, "object"), f"{where}.{name}: {kind}"
        if kind == "object":
            read_like_a_viewer(field, f"{where}.{name}")


@pytest.mark.parametrize(("name", "schema"), recorded_schemas(), ids=lambda value: value if value is str else None)
def test_viewers_can_read_every_schema(name: str, schema: dict[str, Any]) -> None:
    read_like_a_viewer(schema, name)
    assert schema["title"].startswith(("ccatp.", "foxglove."))
    assert "$ref" not in msgspec.json.encode(schema).decode()


def test_every_recorded_topic_and_every_view_has_one() -> None:
    names = [name for name, _ in recorded_schemas()]
    assert names == [t.name for t in TOPICS if t.recorded] + [view.name for view in VIEWS]


def test_what_viewers_do_not_understand_stays_in_the_schema() -> None:
    schema = dict(recorded_schemas())["track"]
    assert set(schema["properties"]) == {"seq", "t_s"}
    assert schema["patternProperties"]["^rows$"]["items"]["minItems"] == 8


def test_a_nested_type_stands_in_its_place() -> None:
    class Inner(msgspec.Struct):
        n: int

    class Outer(msgspec.Struct):
        one: Inner
        some: list[Inner]
        maybe: Inner | None

    schema = plain_schema(msgspec.json.schema(Outer), "x.Outer")
    assert schema["title"] == "x.Outer"
    assert schema["properties"]["one"]["properties"] == {"n": {"type": "integer"}}
    assert schema["properties"]["some"]["items"]["properties"] == {"n": {"type": "integer"}}
    assert set(schema["patternProperties"]) == {"^maybe$"}


SDK_TYPES: dict[str, Any] = {
    "timestamp": sdk.Timestamp,
    "lifetime": sdk.Duration,
    "pose": sdk.Pose,
    "position": sdk.Vector3,
    "orientation": sdk.Quaternion,
    "rotation": sdk.Quaternion,
    "translation": sdk.Vector3,
    "size": sdk.Vector3,
    "color": sdk.Color,
    "points": sdk.Point3,
    "entities": sdk.SceneEntity,
    "lines": sdk.LinePrimitive,
    "spheres": sdk.SpherePrimitive,
    "texts": sdk.TextPrimitive,
    "metadata": sdk.KeyValuePair,
    "deletions": sdk.SceneEntityDeletion,
}
NUMBERED = {"LinePrimitive": sdk.LinePrimitiveLineType, "Log": sdk.LogLevel}


def as_sdk(kind: Any, fields: dict[str, Any]) -> Any:
    """Foxglove's own object of a message; a field that it does not know is an error."""

    def value(name: str, found: Any) -> Any:
        if isinstance(found, dict):
            return as_sdk(SDK_TYPES[name], found)
        if isinstance(found, list):
            return [as_sdk(SDK_TYPES[name], one) for one in found]
        if name in ("type", "level"):
            # an enumeration of theirs compares equal to its number
            return next(e for e in _members(NUMBERED[kind.__name__]) if e == found)
        return found

    return kind(**{name: value(name, found) for name, found in fields.items()})


def builtins(message: msgspec.Struct) -> dict[str, Any]:
    found: dict[str, Any] = msgspec.json.decode(msgspec.json.encode(message))
    return found


def _members(enum: Any) -> list[Any]:
    return [member for name in dir(enum) if isinstance(member := getattr(enum, name), enum)]


@pytest.mark.parametrize("view", [view for view in VIEWS if view.schema_name.startswith("foxglove.")], ids=str)
def test_fields_have_foxgloves_names(view: Any) -> None:
    schema = dict(view_schemas())[view.name]
    kind = getattr(sdk, view.schema_name.removeprefix("foxglove."))
    for name in schema["properties"]:
        try:
            kind(**{name: object()})
        except TypeError as error:
            assert "unexpected keyword" not in str(error), name  # of the wrong type it is, but known  # noqa: PT017


def test_the_sdk_takes_the_scene_as_it_is(mirror: Mirror) -> None:
    scene = builtins(panel_scene(mirror, time_of(1.5)))
    as_sdk(sdk.SceneUpdate, scene)
    assert scene["entities"][0]["timestamp"] == {"sec": 1, "nsec": 500_000_000}
    assert len(scene["entities"]) == 78  # 77 panels and the rim
    with pytest.raises(TypeError, match="unexpected keyword"):
        as_sdk(sdk.SceneUpdate, {**scene, "entitys": []})


def test_measured_points_carry_their_deviation(mirror: Mirror) -> None:
    points = {PointId(4, 4, 5): 1e-4, PointId(4, 4, 6): -3e-4, PointId(5, 5, 1): 0.0}
    scene = builtins(point_scene(mirror, [PanelId(4, 4)], points, time_of(0.0)))
    as_sdk(sdk.SceneUpdate, scene)
    (entity,) = scene["entities"]
    assert [fact["value"] for fact in entity["metadata"]] == ["100.0 um", "-300.0 um"]
    x, y = mirror.point_on_deck(PointId(4, 4, 5))
    at = entity["spheres"][0]["pose"]["position"]
    assert (at["x"], at["y"], at["z"]) == pytest.approx(mirror.surface_point(x, y), abs=1e-5)  # rounded


def test_colours_run_from_blue_to_red() -> None:
    low, even, high = colour_of(-1.0), colour_of(0.0), colour_of(1.0)
    assert low[2] > low[0]
    assert high[0] > high[2]
    assert even[0] == pytest.approx(even[1])
    assert colour_of(2e-4) == high
    assert colour_of(1e-4) != high
