"""The package as a whole: errors and their exit status, no code made of data, packaging/, fixtures of the tests."""

import ast
import json
import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import click
import msgspec
import pytest
import yaml
from markdown_it import MarkdownIt
from markdown_it.token import Token

import ccatp
from ccatp.cli import cli
from ccatp.conditions import danger_text
from ccatp.config import package
from ccatp.config.load import load_config
from ccatp.core import Verdict
from ccatp.errors import CcatpError, ConfigError, ExitStatus
from ccatp.links.topics import Alarm, DisplayState, FixMessage, Heartbeat, Message, MissionStatus
from ccatp.mirror.mirror import build_mirror
from ccatp.report.dashboard.survey_view import SurveyView, ground
from ccatp.report.dashboard.view import LOOPS
from ccatp.survey.engagement import Engagement
from ccatp.survey.turn import turn_of
from tests.unit.report.dashboard.test_view import metrics_of
from tests.unit.report.dashboard.test_views import LINE


@pytest.mark.parametrize("is_installed", [True, False])
def test_a_child_does_not_take_the_package_of_the_working_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_installed: bool
) -> None:
    other = tmp_path / "ccatp"
    other.mkdir()
    (other / "__init__.py").write_text("raise SystemExit('the wrong one')\n", encoding="utf-8")
    above = str(package.ROOT.parent)
    monkeypatch.setattr(sys, "path", ["", above] if is_installed else [above])
    environment = package.child_environment({**os.environ, "PYTHONPATH": above} if is_installed else os.environ)
    command = [sys.executable, "-m", "ccatp", "--version"]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.stderr == ""
    assert done.stdout.startswith(f"ccatp {ccatp.__version__}")


def test_the_paths_of_the_parent_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "path", [str(package.ROOT.parent)])
    found = package.child_environment({"PYTHONPATH": "/one", "HOME": "/home"})
    assert found["PYTHONPATH"] == os.pathsep.join((str(package.ROOT.parent), "/one"))
    assert found["HOME"] == "/home"


def test_a_message_is_one_line_and_that_of_the_first_problem() -> None:
    assert str(CcatpError("two\n lines ")) == "two lines"
    assert CcatpError("x").exit_status is ExitStatus.HELD
    error = ConfigError("a: b", "c:\nd")
    assert str(error) == "a: b (and 1 more: ccatp config check)"
    assert error.problems == ["a: b", "c: d"]


@pytest.mark.parametrize(
    ("condition", "cause", "signal", "value", "limit", "text"),
    [
        ("no_estimate", "no estimate", "estimate", 0.15, 0.15, "no estimate: limit 0.15 s"),
        ("estimate_stale", "estimate stale", "estimate", 0.31, 0.15, "estimate stale: 0.31 s (limit 0.15 s)"),
        ("edge_stale", "edge samples stale", "edge", 0.2, 0.1, "edge samples stale: 0.2 s (limit 0.1 s)"),
        ("all_off", "lifted or fallen", "edge", 4.0, 3.0, "lifted or fallen (edge): 4 (limit 3)"),
        ("wheel_runs_away", "left wheel fast", "left_wheel", 0.5, 0.1, "left wheel fast: 0.5 m/s (limit 0.1 m/s)"),
        ("emergency", "emergency: fire", "emergency:fire", 1.0, 0.0, "emergency: fire"),
        ("", "", "", 0.0, 0.0, ""),
        ("of_another_version", "it burns", "estimate", 2.0, 1.0, "it burns (estimate): 2 (limit 1)"),
    ],
)
def test_what_where_how_much(condition: str, cause: str, signal: str, value: float, limit: float, text: str) -> None:
    assert danger_text(condition, cause, signal, value, limit) == text


# -- nothing that is read, from a file or from a peer, may become code -------------------------------------------------

PACKAGE = Path(ccatp.__file__).parent
MODULES = {"pickle", "cPickle", "_pickle", "marshal", "shelve", "dill", "cloudpickle", "joblib", "yaml"}
CALLS = {"eval", "exec", "compile", "__import__"}
SWITCHES = {"allow_pickle", "shell"}
METHODS = {"send_pyobj", "recv_pyobj", "read_pickle", "to_pickle"}
# Studies hand jobs to processes of their own machine, or to a dask cluster that the user names: both pickle.
POOLS = {"multiprocessing", "ProcessPoolExecutor", "distributed", "dask"}
WITH_POOLS = {"studies/engine.py", "studies/calibrator.py"}  # pickles pass between this package's own processes only


def is_false(value: ast.expr) -> bool:
    return isinstance(value, ast.Constant) and value.value is False


def faults(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (a.name for a in node.names if a.name.split(".")[0] in MODULES | POOLS)
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = (node.module.split(".")[0], *(alias.name for alias in node.names))
            yield from (name for name in names if name in MODULES | POOLS)
        elif isinstance(node, ast.Call):
            name = node.func.id if isinstance(node.func, ast.Name) else ""
            method = node.func.attr if isinstance(node.func, ast.Attribute) else ""
            if name in CALLS:
                yield f"{name}()"
            if method in METHODS:
                yield f".{method}()"
            yield from (k.arg for k in node.keywords if k.arg in SWITCHES and not is_false(k.value))


def test_no_module_makes_code_of_data() -> None:
    found = {}
    words = re.compile(rf"\b({'|'.join(MODULES | POOLS | CALLS | SWITCHES | METHODS)})\b")
    for path in PACKAGE.rglob("*.py"):
        text, name = path.read_text(encoding="utf-8"), path.relative_to(PACKAGE).as_posix()
        if not words.search(text):
            continue  # to parse every module takes seconds
        names = set(faults(ast.parse(text)))
        if name in WITH_POOLS:
            names = {fault for fault in names if fault.split(".")[0] not in POOLS}
        if names:
            found[name] = names
    assert found == {}


# -- the files of packaging/ -------------------------------------------------------------------------------------------

PACKAGING = Path(__file__).parents[2] / "packaging"
COMPOSE: dict[str, Any] = yaml.safe_load((PACKAGING / "compose.yaml").read_text())
METRIC = re.compile(r"\bccatp_\w+")


def tokens_of(tokens: list[Token]) -> Iterator[Token]:
    for token in tokens:
        yield token
        yield from tokens_of(token.children or [])


def links_and_pictures(readme: str) -> tuple[list[Token], list[str], list[str]]:
    tokens = list(tokens_of(MarkdownIt("commonmark").parse(readme)))
    links = [str(token.attrs["href"]) for token in tokens if token.type == "link_open"]
    return tokens, links, [str(token.attrs["src"]) for token in tokens if token.type == "image"]


def test_links_of_the_readme_lead_to_files_that_are_there_and_are_absolute_on_a_package_index() -> None:
    root = PACKAGING.parent
    project = tomllib.loads((root / "pyproject.toml").read_text())
    source = project["project"]["urls"]["Source"]
    readme = (root / "README.md").read_text(encoding="utf-8")
    tokens, links, pictures = links_and_pictures(readme)
    assert len(links) > 20
    assert pictures
    assert [place for place in (*links, *pictures) if not (root / place).is_file()] == []
    published = readme
    for rule in project["tool"]["hatch"]["metadata"]["hooks"]["fancy-pypi-readme"]["substitutions"]:
        published = re.sub(rule["pattern"], rule["replacement"], published)
    _, absolute, drawn = links_and_pictures(published)
    assert absolute == [f"{source}/blob/main/{link}" for link in links]
    assert drawn == [f"{source.replace('//github.com', '//raw.githubusercontent.com')}/main/{one}" for one in pictures]
    # a link without a definition is a text in brackets
    assert [token.content for token in tokens if token.type == "text" and re.search(r"\[.*\]", token.content)] == []


@cache
def exported() -> frozenset[str]:
    """Names of all metrics that the messages of a run lead to, with a process that is there."""
    cfg = load_config()
    mirror = build_mirror(cfg.mirror)
    view = SurveyView(mirror, cfg, is_sim=True)
    view.is_watched = True
    state = Engagement()
    alarm = Alarm(name="lifted", severity="hold", cause="lifted", advice="look", since="", since_s=0.0)
    messages: tuple[Message | Verdict, ...] = (
        *(Heartbeat(seq=0, t_s=0.0, process=name, pid=1, phase="joined", frame_age_s=0.0) for name in LOOPS),
        MissionStatus(seq=0, t_s=0.0, state="driving", alarms=[alarm], turn=turn_of(state, None, ())),
        DisplayState(
            seq=0, t_s=0.0, x_m=0.0, y_m=0.0, heading_rad=0.0, covariance_m2=(1e-6, 0.0, 1e-6), heading_sigma_rad=0.1,
            nis=2.0, size=2, line=msgspec.Raw(LINE),
        ),
        Verdict.normal(0, 0.0),
        FixMessage(
            seq=0, t_s=0.0, point=None, is_fused=True, position_m=(0.0, 0.0, 0.0), covariance_m2=[0.0] * 9, dop=3.0,
            residual_rms_m=1e-6, channels=[1], jump_mm=0.1,
        ),
    )  # fmt: skip
    for message in messages:
        view.receive(message, 0.0)
    states = ground(mirror, cfg, is_sim=True)
    return frozenset(metrics_of(view.status_data(0.1) | {"pids": {"main": os.getpid()}}, 1, **states))


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
    while isinstance(command, click.Group) and arguments:
        command, arguments = command.get_command(click.Context(command), arguments[0]), arguments[1:]
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


# -- fixtures that fail a test for what it leaves behind ---------------------------------------------------------------

pytest_plugins = ["pytester"]

CONFTEST = Path(__file__).parents[1] / "conftest.py"


def run(pytester: pytest.Pytester, test: str) -> pytest.RunResult:
    pytester.makeconftest(CONFTEST.read_text(encoding="utf-8").replace("GRACE_S = 2.0", "GRACE_S = 0.1"))
    pytester.makepyfile(f"import asyncio, os, subprocess, sys\nkept = []\n{test}")
    settings = ["asyncio_mode=auto", "asyncio_default_fixture_loop_scope=function"]
    return pytester.runpytest_inprocess("-p", "no:cacheprovider", *(word for text in settings for word in ("-o", text)))


def test_a_leaked_task_fails_its_test(pytester: pytest.Pytester) -> None:
    result = run(pytester, "async def test_it():\n    kept.append(asyncio.create_task(asyncio.sleep(60)))\n")
    result.assert_outcomes(passed=1, errors=1)
    result.stdout.fnmatch_lines(["*asyncio tasks left behind: *sleep*"])


def test_a_leaked_child_fails_its_test(pytester: pytest.Pytester) -> None:
    command = "[sys.executable, '-c', 'import time; time.sleep(60)']"
    result = run(pytester, f"def test_it():\n    os.posix_spawn(sys.executable, {command}, os.environ)\n")
    result.assert_outcomes(passed=1, errors=1)
    result.stdout.fnmatch_lines(["*child processes left behind: *time.sleep(60)*"])


def test_tasks_and_children_that_end_are_no_leak(pytester: pytest.Pytester) -> None:
    test = (
        "async def test_task():\n    await asyncio.create_task(asyncio.sleep(0))\n"
        "async def test_cancelled():\n    asyncio.create_task(asyncio.sleep(60)).cancel()\n"
        "def test_child():\n    assert subprocess.run([sys.executable, '-c', '']).returncode == 0\n"
    )
    run(pytester, test).assert_outcomes(passed=3)
