"""The documentation: what is made from the code is current, code blocks run, command lines exist, Sphinx is content."""

import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import patch

import click
import pytest
from _pytest.mark.structures import ParameterSet

from ccatp.cli import cli, main
from ccatp.conditions import Owner, all_conditions
from ccatp.filters import FILTERS
from tests.support.recorded import record
from tests.support.rows import OTHERS
from tools.generated_docs import DOCS, MADE, MARKED, ROOT, pages, shown

FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.DOTALL | re.MULTILINE)
SOURCES = [*sorted(DOCS.rglob("*.md")), ROOT / "README.md"]
LONGEST_RESULT = 5  # lines, of a page of measurements
# Console commands that are quick and need no daemon: these are not only understood but run.
EXAMPLES = {"ID": "6f1c3c1e-5a0f-4d0e-9f2b-0c8f5b6a7d11"}  # for placeholders that a command would refuse
RUN = frozenset(("config", "plan", "report", "align", "compare"))
DRAW_FOR_SECONDS = frozenset(("report", "compare"))  # what they do is tried in tests/unit/report


def blocks(path: Path, *languages: str) -> list[str]:
    return [body for language, body in FENCE.findall(path.read_text(encoding="utf-8")) if language in languages]


def test_no_two_conditions_have_the_same_text() -> None:
    rows = [shown(row.message) for row in OTHERS]
    assert len(rows) == len(set(rows))


PLACES = {  # where the owner of a condition finds it
    Owner.DANGER: ("danger.py", "safety", "beacons/safety"),
    Owner.LOCALIZER: ("localizer.py", "estimation"),
    Owner.MISSION: ("survey", "control", "beacons", "daemon"),
    Owner.FIXES: ("survey", "daemon"),
    Owner.MAIN: ("daemon", "survey"),
    Owner.LINK: ("daemon",),
    Owner.OPERATOR: ("daemon",),
}


def test_each_condition_is_used_where_its_owner_is() -> None:
    for row in all_conditions():
        paths = [path for name in PLACES[row.owner] for path in (ROOT / "ccatp").glob(f"{name}/**/*.py")]
        paths += [ROOT / "ccatp" / name for name in PLACES[row.owner] if name.endswith(".py")]
        sources = (path.read_text(encoding="utf-8") for path in paths)
        assert any(re.search(rf"\b{row.name.upper()}\b", text) for text in sources), row.name


def test_what_is_made_from_the_code_is_current() -> None:
    found = pages()
    used = [name for path in found for name in re.findall(MARKED, path.read_text(encoding="utf-8"))]
    assert {name for _, name, _ in used} == set(MADE)
    for path, text in found.items():
        assert path.read_text(encoding="utf-8") == text, f"{path.name} is not current: make docs"


def command_names(group: click.Group, path: str = "ccatp") -> Iterator[str]:
    """Everything that can be called, groups that do something by themselves as well."""
    for name in group.list_commands(click.Context(group)):
        command = group.get_command(click.Context(group), name)
        assert command is not None
        if not isinstance(command, click.Group) or command.invoke_without_command:
            yield f"{path} {name}"
        if isinstance(command, click.Group):
            yield from command_names(command, f"{path} {name}")


def test_the_page_of_commands_has_each_of_them() -> None:
    heads = re.findall(r"^## `([a-z0-9 -]+)", (DOCS / "commands.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert [head.strip() for head in heads] == list(command_names(cli))


@pytest.mark.parametrize("path", sorted((DOCS / "measurements").glob("*.md")), ids=lambda path: path.stem)
def test_a_page_of_measurements_begins_with_its_result(path: Path) -> None:
    title, result, *_ = path.read_text(encoding="utf-8").split("\n\n")
    assert re.fullmatch(r"# [^\n]+", title)
    assert result.startswith("**Result.** ")
    assert result.count("\n") < LONGEST_RESULT


# tests/docs/test_notebook.py executes those of the page on analysis.
@pytest.mark.parametrize(
    "path", [path for path in SOURCES if blocks(path, "python") and path.stem != "python"], ids=lambda path: path.stem
)
def test_python_blocks_run(path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    names: dict[str, object] = {"__name__": "__docs__"}
    with patch.dict(FILTERS):  # a page may add one of its own
        for number, body in enumerate(blocks(path, "python"), 1):
            exec(compile(body, f"{path.name}, block {number}", "exec"), names)
    assert capfd.readouterr().out  # every one of them shows something


def command_lines() -> Iterator[tuple[str, str]]:
    """Command lines of ``ccatp`` in fenced blocks: the page, and the line without comment and prompt."""
    for path in SOURCES:
        for body in blocks(path, "", "console", "sh"):
            for line in body.splitlines():
                words = re.split(r"\s#\s|\s{3,}", line.removeprefix("$ ").strip())[0]  # the rest is a remark
                if re.match(r"(\S*/)?ccatp [a-z]", words) and not re.search(r"\.\.\.|\u2026|\[--", words):
                    yield path.stem, words


def resolved(words: list[str], *, is_whole: bool = True) -> tuple[click.Context, list[str]]:
    """The command that the words name, and the words after it. ``is_whole``: a group of commands is not enough."""
    command: click.Command = cli
    context = click.Context(cli, info_name="ccatp")
    while isinstance(command, click.Group) and (is_whole or (words and not words[0].startswith("-"))):
        name, found, words = command.resolve_command(context, words)
        assert found is not None
        command, context = found, click.Context(found, parent=context, info_name=name)
    return context, words


@pytest.mark.parametrize(("page", "line"), sorted(set(command_lines())))
def test_command_lines_exist(page: str, line: str) -> None:
    shown = re.split(r" [|>] ", line)[0]
    context, words = resolved([EXAMPLES.get(word, word) for word in shlex.split(shown)[1:]])
    context.command.make_context(context.info_name, list(words), parent=context.parent)  # parses; runs nothing


INLINE = re.compile(r"`((?:\S*/)?ccatp [a-z][^`]*)`")


def unknown_options(line: str) -> list[str]:
    """Options that the named command does not have; click.UsageError: there is no such command."""
    context, words = resolved(shlex.split(re.split(r" [|>] ", line)[0])[1:], is_whole=False)
    known = {option for one in context.command.params for option in (*one.opts, *one.secondary_opts)}
    given = [word.partition("=")[0] for word in words if re.match(r"--?[a-z]", word)]
    return [option for option in given if option not in known | {"--help", "--version"}]


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.stem)
def test_commands_in_the_text_exist(path: Path) -> None:
    lines = [" ".join(line.split()) for line in INLINE.findall(FENCE.sub("", path.read_text(encoding="utf-8")))]
    assert {line: unknown for line in lines if (unknown := unknown_options(line))} == {}


def test_a_command_in_the_text_that_does_not_exist_is_found() -> None:
    assert unknown_options("ccatp plan --mirror NAME --orders") == ["--orders"]
    assert unknown_options(".venv/bin/ccatp config check FILE") == []
    with pytest.raises(click.UsageError, match="No such command 'plans'"):
        unknown_options("ccatp plans --mirror NAME")


@pytest.fixture(scope="module")
def telescope(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory in which the lines of the guides make sense."""
    folder = tmp_path_factory.mktemp("telescope")
    (folder / "telescope.toml").write_text("[run]\npanels = 2\n")
    tonight = record(folder / "runs" / "tonight", only=4)
    for name in ("before", "after"):
        shutil.copytree(tonight, folder / "runs" / name)
    return folder


def quick_lines() -> list[ParameterSet]:
    """Of each command that is quick the line with the most options; the others are slow."""
    lines = {
        line.split(" ", 1)[1]
        for path in SOURCES
        if path.stem != "first_look"  # tests/processes runs it as a whole
        for body in blocks(path, "console")
        for line in (one.removeprefix("$ ") for one in body.splitlines() if one.startswith("$ ccatp "))
        if line.split()[1] in RUN
    }
    longest = {line.split()[0]: line for line in sorted(lines, key=len)}
    quick = [line for command, line in longest.items() if command not in DRAW_FOR_SECONDS]
    return [pytest.param(line, marks=() if line in quick else pytest.mark.slow) for line in sorted(lines)]


@pytest.mark.parametrize("line", quick_lines())
def test_console_lines_run(
    line: str, telescope: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    if "--fig" in line:
        pytest.importorskip("matplotlib")
    monkeypatch.chdir(telescope)
    assert main(shlex.split(line)) == 0, capsys.readouterr().err
    assert capsys.readouterr().out


@pytest.mark.slow  # `make docs` does it, too
def test_sphinx_builds_without_a_warning(tmp_path: Path) -> None:
    pytest.importorskip("furo")
    # Everything is read and every reference resolved; only the writing of HTML is left to ``make docs``.
    command = [sys.executable, "-m", "sphinx", "-W", "-q", "-b", "dummy", str(DOCS), str(tmp_path / "docs")]
    done = subprocess.run(command, cwd=ROOT, env={**os.environ}, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
