"""The first look of the documentation: its commands print what it shows, and its run holds what the layouts plot."""

import doctest
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import pytest

from ccatp.daemon.streaming import streamed_schemas
from ccatp.records.recorder import iter_messages
from tests.docs.generated import DOCS, ROOT
from tests.docs.test_docs import blocks

EXAMPLE = re.compile(r"^\$ (.*)\n((?:(?!\$ ).*\n)*)", re.MULTILINE)
SHOWN = doctest.OutputChecker()
FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


NUMBER = re.compile(r"-?\d+\.\d+")


def is_like(shown: str, printed: str) -> bool:
    """Equal, or with decimals that another processor rounds otherwise: by a tenth, or two units of what is shown."""
    if SHOWN.check_output(shown, printed, FLAGS):
        return True
    numbers, found = NUMBER.findall(shown), NUMBER.findall(printed)
    return SHOWN.check_output(NUMBER.sub("...", shown), printed, FLAGS) and (
        len(numbers) != len(found)  # some are left out by an ellipsis
        or all(
            abs(float(a) - float(b)) <= max(0.1 * abs(float(a)), 2.0 * 10.0 ** -len(a.partition(".")[2]))
            for a, b in zip(numbers, found, strict=True)
        )
    )


def test_decimals_may_be_those_of_another_processor_and_nothing_else_may() -> None:
    assert is_like("mean 0.048 p99 1.634\n", "mean 0.049 p99 1.590\n")
    assert not is_like("mean 0.048 p99 1.634\n", "mean 0.048 p99 1.134\n")
    assert not is_like("mean 0.048\n", "median 0.048\n")
    assert not is_like("9 of 9 points, 0.048\n", "8 of 9 points, 0.048\n")


@pytest.fixture(scope="module")
def looked(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[str]]:
    """The directory in which the commands ran, and what they printed otherwise than the page shows."""
    folder = tmp_path_factory.mktemp("first_look")
    path = os.pathsep.join((str(Path(sys.executable).parent), os.environ["PATH"]))
    env = {**os.environ, "PATH": path, "HOME": str(folder)}
    unlike = []
    for command, shown in EXAMPLE.findall("".join(blocks(DOCS / "first_look.md", "console"))):
        done = subprocess.run(
            command, shell=True, cwd=folder, env=env, capture_output=True, text=True, timeout=300, check=False
        )
        if done.returncode or not is_like(shown, done.stdout):
            unlike.append(f"$ {command}\n{done.stdout}{done.stderr}")
    return folder, unlike


def test_the_commands_print_what_the_page_shows(looked: tuple[Path, list[str]]) -> None:
    assert looked[1] == []


@pytest.fixture(scope="module")
def recorded(looked: tuple[Path, list[str]]) -> dict[str, set[str]]:
    """Names of the fields of the recorded messages, by topic."""
    fields: dict[str, set[str]] = {}
    for topic, _, payload in iter_messages(looked[0] / "runs" / "first" / "telemetry.mcap"):
        fields.setdefault(topic, set()).update(json.loads(payload))
    return fields


def named_in(node: Any) -> Iterator[tuple[str, str]]:
    """Topic and field of whatever a layout of Foxglove shows; no field where it shows whole messages."""
    if isinstance(node, list):
        for one in node:
            yield from named_in(one)
    for key, value in node.items() if isinstance(node, dict) else ():
        if key == "topics":
            yield from ((topic, "") for topic in value)
        elif key == "topicToRender":
            yield value, ""
        elif key == "value":
            topic, _, field = value.partition(".")
            yield topic, field
        else:
            yield from named_in(value)


def panels_of(node: Any) -> list[str]:
    return [node] if isinstance(node, str) else [*panels_of(node["first"]), *panels_of(node["second"])]


def is_there(topic: str, field: str, recorded: dict[str, set[str]]) -> bool:
    is_recorded = topic in recorded and (not field or field in recorded[topic])
    return is_recorded and topic in dict(streamed_schemas())


def test_what_foxgloves_layout_shows_is_recorded_and_streamed(recorded: dict[str, set[str]]) -> None:
    layout = json.loads((ROOT / "packaging" / "foxglove" / "ccatp.json").read_text(encoding="utf-8"))
    assert sorted(panels_of(layout["layout"])) == sorted(layout["configById"])
    shown = list(named_in(layout["configById"]))
    assert len(shown) > 15
    assert [one for one in shown if not is_there(*one, recorded)] == []


def test_what_plotjugglers_layout_plots_is_recorded_and_streamed(recorded: dict[str, set[str]]) -> None:
    root = ET.parse(ROOT / "packaging" / "plotjuggler" / "ccatp.xml").getroot()
    curves = [str(curve.get("name")) for curve in root.iter("curve")]
    assert len(curves) > 15
    series = [one.rpartition("/") for one in curves]
    assert [topic + field for topic, _, field in series if not is_there(topic, field, recorded)] == []
    for splitter in root.iter("DockSplitter"):
        assert splitter.get("count") == str(len(splitter)) == str(len(str(splitter.get("sizes")).split(";")))
