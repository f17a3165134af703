"""No command writes over a file that it reads, nor two results into one file."""

from collections.abc import Iterator
from pathlib import Path

import click
import pytest

from ccatp.cli import cli, main
from ccatp.cli.common import CheckedCommand, OutputFile, OutputFolder

WRITTEN = ("--out", "--csv", "--work-list", "--figure", "--figures", "--tables", "--tum", "--ros2", "--markdown")
TEXT = "1/2/1,2232.9,-2934.0,4929.8\n"


def commands(group: click.Group, names: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], click.Command]]:
    context = click.Context(group)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        assert command is not None
        if isinstance(command, click.Group):
            yield from commands(command, (*names, name))
        else:
            yield (*names, name), command


ALL = [*commands(cli)]


def outputs(command: click.Command) -> list[click.Parameter]:
    return [one for one in command.params if isinstance(one.type, OutputFile | OutputFolder)]


def arguments(command: click.Command, path: Path, values: dict[str | None, Path]) -> list[str]:
    """A command line with these values, and other files of ``path`` for the arguments without any."""
    words = []
    for one in command.params:
        value = values.get(one.name)
        if isinstance(one, click.Argument):
            if value is None and not one.required:
                continue
            if value is None:
                value = path / f"other-{one.name}.csv"
                value.write_text(TEXT)
            words.append(str(value))
        elif value is not None:
            words += [one.opts[0], str(value)]
    return words


def overwrites() -> Iterator[tuple[tuple[str, ...], click.Command, click.Parameter, click.Parameter]]:
    for names, command in ALL:
        for output in outputs(command):
            for source in command.params:
                if isinstance(source.type, click.Path) and source not in outputs(command):
                    yield names, command, output, source


def test_every_command_checks_its_outputs() -> None:
    for names, command in ALL:
        assert isinstance(command, CheckedCommand), names
        for one in command.params:
            if set(one.opts) & set(WRITTEN):
                assert one in outputs(command), (names, one.opts)


@pytest.mark.parametrize(
    ("names", "command", "output", "source"),
    [pytest.param(*case, id=" ".join((*case[0], case[2].opts[0], case[3].opts[0]))) for case in overwrites()],
)
def test_an_output_that_is_an_input_is_refused(
    names: tuple[str, ...], command: click.Command, output: click.Parameter, source: click.Parameter,
    tmp_path: Path, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    kind = output.type
    assert isinstance(kind, OutputFile | OutputFolder)
    if isinstance(kind, OutputFile):
        target = tmp_path / f"input{kind.formats[0] if kind.formats else '.csv'}"
    else:
        target = tmp_path
    for path in kind.written(target):
        path.write_text(TEXT)
        assert main([*names, *arguments(command, tmp_path, {output.name: target, source.name: path})]) == 2
        assert "is an input" in capsys.readouterr().err
        assert path.read_text() == TEXT


def test_two_outputs_into_one_file_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pairs = 0
    for names, command in ALL:
        files = [one for one in outputs(command) if isinstance(one.type, OutputFile)]
        for at, second in enumerate(files):
            for first in files[:at]:
                kinds = [one.type.formats for one in (first, second) if isinstance(one.type, OutputFile)]
                target = tmp_path / f"both{(*kinds[0], *kinds[1], '.csv')[0]}"
                line = [*names, *arguments(command, tmp_path, {first.name: target, second.name: target})]
                assert main(line) == 2
                assert "name the same file" in capsys.readouterr().err
                assert not target.exists()
                pairs += 1
    assert pairs >= 5


@pytest.mark.parametrize("name", ["config.toml", "mission.sqlite", "telemetry.mcap"])
def test_the_record_of_a_run_is_not_replaced_and_its_results_are(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "config.toml").write_text("")
    for file in (name, "moves.csv"):
        (tmp_path / file).write_text("")
    assert main(["align", str(tmp_path), "--csv", str(tmp_path / name)]) == 2
    assert "is an input" in capsys.readouterr().err
    assert main(["align", str(tmp_path), "--csv", str(tmp_path / "moves.csv")]) == 2
    assert "is an input" not in capsys.readouterr().err


def test_a_file_that_a_setting_or_a_name_gives_is_an_input(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mirror, moved = tmp_path / "mirror.toml", tmp_path / "points.csv"
    for file in (mirror, moved):
        file.write_text(TEXT)
    for words in (
        ["align", "--points", str(moved), "--set", f"run.mirror={mirror}", "--csv", str(mirror)],
        ["align", "--points", str(moved), "--mirror", str(mirror), "--csv", str(mirror)],
        ["radio", "map", "--cricket", f"N1={mirror}", "--out", str(mirror)],
    ):
        assert main(words) == 2
        assert "is an input" in capsys.readouterr().err
        assert mirror.read_text() == TEXT


def test_another_name_of_the_same_file_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    points, link = tmp_path / "points.csv", tmp_path / "link.csv"
    points.write_text(TEXT)
    link.symlink_to(points)
    assert main(["align", "--points", str(points), "--work-list", str(link)]) == 2
    assert "is an input" in capsys.readouterr().err
