"""Pure. JSON schemas in the form that viewers can read.

Foxglove and Lichtblick take a channel's schema for a list of fields: the root and every object have ``properties``,
each of a plain type, arrays hold plain types or objects. References, alternatives and arrays of arrays make them refuse
the channel. So references are put in place, and what cannot be said in these terms stands under ``patternProperties``,
where a validator sees it and a viewer does not look.
"""

from collections.abc import Mapping
from typing import Any

Schema = dict[str, Any]
_PLAIN = ("boolean", "string", "number", "integer")


def plain_schema(schema: Mapping[str, Any], title: str) -> Schema:
    """The same schema for viewers.

    Args:
        schema: as ``msgspec.json.schema`` makes it.
        title: its name.
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
