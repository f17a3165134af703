"""The files of packaging/: what they name exists, in the program and beside them."""

import json
import os
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import pytest
import yaml
from markdown_it import MarkdownIt
from markdown_it.token import Token

from ccatp.cli import cli
from ccatp.config.load import load_config
from tests.unit.dashboard.test_view import ALL, metrics_of

PACKAGING = Path(__file__).parents[2] / "packaging"
COMPOSE: dict[str, Any] = yaml.safe_load((PACKAGING / "compose.yaml").read_text())
METRIC = re.compile(r"\bccatp_\w+")


def tokens_of(tokens: list[Token]) -> Iterator[Token]:
    for token in tokens:
        yield token
        yield from tokens_of(token.children or [])


def test_links_of_the_readme_work_on_a_package_index_and_lead_to_files_that_are_there() -> None:
    root = PACKAGING.parent
    source = tomllib.loads((root / "pyproject.toml").read_text())["project"]["urls"]["Source"]
    pages, files = f"{source}/blob/main/", source.replace("//github.com", "//raw.githubusercontent.com") + "/main/"
    tokens = list(tokens_of(MarkdownIt("commonmark").parse((root / "README.md").read_text(encoding="utf-8"))))
    links = [str(token.attrs["href"]) for token in tokens if token.type == "link_open"]
    pictures = [str(token.attrs["src"]) for token in tokens if token.type == "image"]
    assert len(links) > 20
    assert pictures
    assert [link for link in links if not link.startswith(pages)] == []
    assert [picture for picture in pictures if not picture.startswith(files)] == []
    places = [*(link.removeprefix(pages) for link in links), *(picture.removeprefix(files) for picture in pictures)]
    assert [place for place in places if not (root / place).is_file()] == []
    # a link without a definition is a text in brackets
    assert [token.content for token in tokens if token.type == "text" and re.search(r"\[.*\]", token.content)] == []


def exported() -> set[str]:
    """Names of all metrics, with a process that is there."""
    return set(metrics_of(ALL | {"pids": {"main": os.getpid()}}, 1))


def queries() -> dict[str, str]:
    rules = yaml.safe_load((PACKAGING / "prometheus" / "alerts.yml").read_text())["groups"][0]["rules"]
    panels = json.loads((PACKAGING / "grafana" / "ccatp.json").read_text())["panels"]
    found = {rule["alert"]: rule["expr"] for rule in rules}
    return found | {
        f"{panel['title']} {target['refId']}": target["expr"] for panel in panels for target in panel["targets"]
    }


@pytest.mark.parametrize("name", queries())
def test_every_query_names_metrics_that_there_are(name: str) -> None:
    names = set(METRIC.findall(queries()[name]))
    assert names
    assert names <= exported()


def test_panels_do_not_overlap() -> None:
    cells: set[tuple[int, int]] = set()
    for panel in json.loads((PACKAGING / "grafana" / "ccatp.json").read_text())["panels"]:
        at = panel["gridPos"]
        own = {(x, y) for x in range(at["x"], at["x"] + at["w"]) for y in range(at["y"], at["y"] + at["h"])}
        assert not own & cells
        assert max(x for x, _ in own) < 24
        cells |= own


@pytest.mark.parametrize("name", [name for name, service in COMPOSE["services"].items() if "command" in service])
def test_the_commands_of_the_containers_are_commands(name: str) -> None:
    arguments: list[str] = COMPOSE["services"][name]["command"]
    command: Any = cli
    while arguments and arguments[0] in getattr(command, "commands", {}):
        command, arguments = command.commands[arguments[0]], arguments[1:]
    known = {option for parameter in command.params for option in parameter.opts}
    given = [argument for argument in arguments if argument.startswith("--")]
    assert given
    assert set(given) <= known


def test_what_the_containers_mount_is_there_and_their_configuration_loads() -> None:
    for service in COMPOSE["services"].values():
        for volume in service.get("volumes", ()):
            source = volume.partition(":")[0]
            assert source in COMPOSE["volumes"] or (PACKAGING / source).exists()
    cfg = load_config(PACKAGING / "compose.toml")
    names = set(COMPOSE["services"])
    assert {cfg.robot.host, cfg.etalon.host, *cfg.dashboard.host_names} == {"robot", "laser", "daemon"} < names
    assert cfg.dashboard.token_file.removeprefix("/run/secrets/") in COMPOSE["secrets"]
    assert re.findall(r"target\w*: *\[?\"?(.*?)\"", (PACKAGING / "prometheus" / "prometheus.yml").read_text()) == [
        f"daemon:{cfg.dashboard.port}"
    ]


def test_the_daemons_health_is_a_command() -> None:
    program, *command = COMPOSE["services"]["daemon"]["healthcheck"]["test"][1:]
    assert program == "ccatp"
    assert cli.resolve_command(click.Context(cli), command)[1] is not None


def test_the_image_copies_files_that_are_there() -> None:
    lines = (PACKAGING / "Containerfile").read_text().splitlines()
    copied = [name for line in lines if line.startswith("COPY") for name in line.split()[1:-1]]
    assert copied
    assert [name for name in copied if not (PACKAGING.parent / name).exists()] == []
    kept = (PACKAGING / "Containerfile.dockerignore").read_text().splitlines()
    assert {line[1:] for line in kept if line.startswith("!")} == set(copied)  # the builder gets nothing else
