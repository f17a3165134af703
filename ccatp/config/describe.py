"""What the keys of a configuration mean: JSON schema, a file to begin with, and what differs between two of them.

The comments in the shipped files are the only place where a key is described; here they are read.
"""

import re
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from ccatp.config.files import read_toml
from ccatp.config.load import DEFAULT_FILE, available, load_config, load_mission
from ccatp.config.messages import format_value
from ccatp.config.mission import CommonConfig
from ccatp.config.models import FOUR_STATE, Config
from ccatp.config.package import configs_dir
from ccatp.missions import kind_of

# A file that describes every key, and the section that it is.
_DESCRIBED = {DEFAULT_FILE: "", "mirrors/fyst-m1.toml": "mirror", "worlds/hard.toml": "world"}
_LINE = re.compile(r"(?:\[(?P<section>[^]=]+)\]|(?P<key>[\w-]+) = (?P<value>[^#]*))\s*(?:# *(?P<comment>.*))?")
# Suffix of a key and its unit, the longest first.
UNITS = {
    "_rad_s_sqrt_s": "rad/s/sqrt(s)", "_m_s2_sqrt_s": "m/s2/sqrt(s)", "_rad2_s3": "rad2/s3", "_rad_s2": "rad/s2",
    "_rad_s": "rad/s", "_rad_m2": "rad/m2", "_rad": "rad", "_m2_s5": "m2/s5", "_m_s2": "m/s2", "_m_s": "m/s",
    "_1_s2": "1/s2", "_1_m": "1/m", "_hz": "Hz", "_mm": "mm", "_m": "m", "_s": "s", "_duty": "share, 0 to 1",
}  # fmt: skip
_HEAD = """\
# Configuration of ccatp. A key that is not in the file has the value shown here. Uncomment those that differ at your
# telescope; UNVERIFIED marks what has to be measured or confirmed there. ccatp config check FILE looks for mistakes.
"""


def comments(text: str, section: str = "") -> dict[str, str]:
    """Comment of each dotted key and section of a shipped file; a file that is itself the section ``section``."""
    found, at = {section: ""} if section else {}, section
    for line in text.splitlines():
        if matched := _LINE.fullmatch(line):
            if matched["section"]:
                at = ".".join(filter(None, (section, matched["section"])))
            key = ".".join(filter(None, (at, matched["key"])))
            found[key] = (matched["comment"] or "").strip()
    return found


def json_schema() -> dict[str, Any]:
    """JSON schema of a configuration file. Nothing is required: what one leaves out comes from the default file.

    Each key has its ``description``, and its ``unit`` where it has one.
    """
    schema = Config.model_json_schema()
    definitions = schema["$defs"]
    for model in (schema, *definitions.values()):
        model.pop("required", None)
    known: dict[str, str] = {}
    for name, section in _DESCRIBED.items():
        known |= comments(read_toml(configs_dir() / name), section)

    def describe(node: dict[str, Any], key: str) -> None:
        model = definitions.get(str(node.get("$ref")).removeprefix("#/$defs/"), node)
        for name, value in model.get("properties", {}).items():
            here = f"{key}.{name}".strip(".")
            if text := known.get(here):
                value.setdefault("description", text)
            if unit := next((unit for suffix, unit in UNITS.items() if name.endswith(suffix)), ""):
                value["unit"] = unit
            describe(value, here)
        if isinstance(others := model.get("additionalProperties"), dict):
            inside = f"{key}."
            for name in {one.removeprefix(inside).partition(".")[0] for one in known if one.startswith(inside)}:
                describe(others, inside + name)

    describe(schema, "")
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema, "title": "ccatp configuration"}


def template() -> str:
    """A configuration in which every key is commented out, with its default value and what it means."""
    lines = read_toml(configs_dir() / DEFAULT_FILE).splitlines()
    body = lines[next(i for i, line in enumerate(lines) if line.startswith("[")) :]
    return _HEAD + "\n" + "".join(f"# {line}\n" if re.match(r"[\w-]+ = ", line) else f"{line}\n" for line in body)


def shipped_config(cfg: Config) -> Config:
    """The shipped configuration of the same mirror and world, where these are shipped."""
    names = {"mirror": cfg.mirror.name, "world": cfg.world.name}
    shipped = {f"run.{kind}": name for kind, name in names.items() if name in available(kind)}
    return load_config(None, shipped).model_copy(update={"run": load_config().run})


def differences(cfg: CommonConfig, other: CommonConfig | None = None) -> list[tuple[str, object, object]]:
    """Dotted key, value in ``other``, and value in ``cfg``; None where there is none.

    Without ``other`` the shipped configuration that is nearest, as of the same mirror and world.
    """
    if other is None:
        kind = kind_of(cfg)
        shipped: Callable[[Any], CommonConfig] | None = None if kind.shipped is None else kind.shipped.get()
        other = load_mission(None, {"system": cfg.system}) if shipped is None else shipped(cfg)
    before, after = dict(leaves(other.model_dump(mode="json"))), dict(leaves(cfg.model_dump(mode="json")))
    keys = dict.fromkeys((*before, *after))
    return [(key, before.get(key), after.get(key)) for key in keys if before.get(key) != after.get(key)]


def keys_without_effect(cfg: Config, _is_sim: bool) -> list[str]:
    """A line for each key of a survey that differs from the default and is for another filter than ``run.filter``."""
    unused, filters = ("full_state", "ekf and ukf") if cfg.run.filter in FOUR_STATE else ("four_state", "kf")
    shipped = load_config().localizer.model_dump(mode="json")[unused]
    own = cfg.localizer.model_dump(mode="json")[unused]
    changed = dict(leaves(own)).items() - dict(leaves(shipped)).items()
    return [
        f"localizer.{unused}.{key} = {format_value(value)} has no effect with run.filter = {cfg.run.filter}; it is for "
        f"{filters}"
        for key, value in sorted(changed)
    ]


def leaves(tree: Mapping[str, Any], at: str = "") -> Iterator[tuple[str, object]]:
    """Dotted key and value of each leaf of a tree."""
    for name, value in tree.items():
        if isinstance(value, Mapping):
            yield from leaves(value, f"{at}{name}.")
        else:
            yield at + name, value
