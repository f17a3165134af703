"""What every command shares: suggestions, one-line errors, exit statuses, options, talk with a running daemon."""

import difflib
import json
import math
import os
import sys
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import click

from ccatp.config.package import configs_dir
from ccatp.errors import CcatpError, ExitStatus

Command = Callable[..., Any]
# Former names of commands, and what they are called now.
RENAMED_COMMANDS = {"log": "recording", "recover": "repair", "map": "plot"}
# Longer than any answer takes; what libzmq waits for is an int of milliseconds.
LONGEST_WAIT_S = 86_400.0


class NearestChoice(click.Choice[str]):
    """A choice that answers a misspelt one with the nearest."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """As ``click.Choice.convert``."""
        near = difflib.get_close_matches(str(value), [str(choice) for choice in self.choices], n=1)
        if near and value not in self.choices:
            self.fail(f"{value!r} is none of {', '.join(self.choices)}; did you mean {near[0]}?", param, ctx)
        return super().convert(value, param, ctx)


class WaitingTime(click.ParamType[float]):
    """Seconds to wait: more than none, and at most a day."""

    name = "seconds"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """As ``click.ParamType.convert``."""
        try:
            time_s = float(value)
        except ValueError:
            time_s = math.nan
        if not 0.0 < time_s <= LONGEST_WAIT_S:
            self.fail(f"{value} is no time to wait; give more than 0 s, at most {LONGEST_WAIT_S:g} s", param, ctx)
        return time_s


class OutputFile(click.Path):
    """A file to be written: what cannot be is told before the work, not after it.

    Args:
        formats: how its name may end; however it likes, if none is given.
    """

    def __init__(self, *formats: str) -> None:
        super().__init__(dir_okay=False, path_type=Path)
        self.formats = formats

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """As ``click.Path.convert``."""
        path = Path(str(super().convert(value, param, ctx)))
        option = "output" if param is None else param.opts[0]
        if not path.parent.is_dir():
            raise click.UsageError(f"{option}: no directory {path.parent}; make it first", ctx)
        if self.formats and path.suffix.lower() not in self.formats:
            known = ", ".join(self.formats)
            raise click.UsageError(f"{option}: {path.name}: no format by that name; the file may end in {known}", ctx)
        return path


class SuggestingGroup(click.Group):
    """A group of commands that answers a misspelt one with the nearest."""

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """The command that ``args`` starts with.

        Raises:
            click.UsageError: there is none of that name.
        """
        name = args[0]
        if self.get_command(ctx, name) is None and not name.startswith("-"):
            new_name = RENAMED_COMMANDS.get(name)
            if new_name is not None and self.get_command(ctx, new_name) is not None:
                raise click.UsageError(f"the command {name!r} is now called {new_name!r}", ctx)
            near = difflib.get_close_matches(name, self.list_commands(ctx), n=1)
            hint = f"did you mean {near[0]}?" if near else f"there are {', '.join(self.list_commands(ctx))}"
            raise click.UsageError(f"no command {name!r}; {hint}", ctx)
        return super().resolve_command(ctx, args)


def run_command_line(group: click.Group, argv: Sequence[str] | None = None) -> int:
    """Run a command line; expected errors become one line on standard error, never a traceback.

    Args:
        argv: arguments without the program's name; those of the process if ``None``.

    Returns:
        The exit status.
    """
    try:
        status = group.main(args=argv, prog_name="ccatp", standalone_mode=False)
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.format_message(), err=True)
        return ExitStatus.USAGE
    except click.UsageError as error:
        where = f"; see {error.ctx.command_path} --help" if error.ctx else ""
        return complain(error.format_message().rstrip(".") + where, ExitStatus.USAGE)
    except click.ClickException as error:
        return complain(error.format_message(), ExitStatus.USAGE)
    except CcatpError as error:
        return complain(str(error), error.exit_status)
    except (click.Abort, KeyboardInterrupt):
        return complain("interrupted", ExitStatus.INTERRUPTED)
    except BrokenPipeError:  # the reader of our output has seen enough; keep the interpreter from flushing into it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return ExitStatus.REFUSED
    except OSError as error:  # a path that nobody foresaw: too long a name, a folder that is not ours
        if error.filename is None:
            raise
        return complain(f"{error.filename}: {error.strerror}; give another path, or mend this one", ExitStatus.USAGE)
    return int(status or 0)


def complain(message: str, status: int) -> int:
    """One line on standard error; returns ``status``."""
    click.echo(f"ccatp: {' '.join(message.split())}", err=True)
    return int(status)


def example(*lines: str) -> str:
    """The epilog of a command's help."""
    return "\b\nExample:\n" + "\n".join(f"  {line}" for line in lines)


def options(*decorators: Callable[[Command], Command]) -> Callable[[Command], Command]:
    """Several options as one decorator, shown in the order given."""

    def decorate(command: Command) -> Command:
        for decorator in reversed(decorators):
            command = decorator(command)
        return command

    return decorate


def renamed_flag(old: str, new: str) -> Callable[[Command], Command]:
    """A hidden flag under its former name, which is refused with the present one."""

    def refuse(ctx: click.Context, _param: click.Parameter, is_given: bool) -> None:
        if is_given:
            raise click.UsageError(f"{old} is now called {new}", ctx)

    return click.option(
        old,
        f"former_{new.strip('-').replace('-', '_')}",
        is_flag=True,
        hidden=True,
        expose_value=False,
        callback=refuse,
    )


def parse_setting(text: str) -> tuple[str, object]:
    """``run.seed=2`` as ``("run.seed", 2)``. The value is TOML, or else text.

    Raises:
        ValueError: there is no key or no ``=``.
    """
    key, equals, value = text.partition("=")
    key = key.strip()
    if not equals or not all(key.split(".")):
        raise ValueError(f"{text!r} is not KEY=VALUE, as in run.seed=2")
    try:
        return key, tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return key, value.strip()


def _settings(_ctx: click.Context, _param: click.Parameter, values: Iterable[str]) -> dict[str, object]:
    try:
        return dict(parse_setting(value) for value in values)
    except ValueError as error:
        raise click.BadParameter(str(error)) from error


def names_of(folder: str) -> Callable[[click.Context, click.Parameter, str], list[str]]:
    """Completes the names of shipped configurations in a folder; a path of a file is the shell's own business."""

    def complete(_ctx: click.Context, _param: click.Parameter, incomplete: str) -> list[str]:
        names = (path.stem for path in (configs_dir() / folder).glob("*.toml"))
        return sorted(name for name in names if name.startswith(incomplete))

    return complete


CONFIG_OPTION = click.option("--config", "config_file", type=click.Path(path_type=Path), help="Configuration (TOML).")
TIMEOUT_OPTION = click.option(
    "--timeout", "timeout_s", type=WaitingTime(), default=10.0, show_default=True, metavar="SECONDS",
    help="Seconds to wait.",
)  # fmt: skip
RUNTIME_DIR_OPTION = click.option(
    "--runtime-dir", type=click.Path(path_type=Path), help="Folder of the sockets, if not the usual one."
)
FAULTS_OPTION = click.option(
    "--faults", "faults_file", type=click.Path(path_type=Path), help="Fault plan (TOML) for the simulated robot."
)

JSON_OPTION = click.option(
    "--json", "json_output", is_flag=True, help="Result as JSON on standard output, nothing else there."
)


def figure_option(what: str) -> Callable[[Command], Command]:
    """``--figure FILE``; ``what`` says what is drawn."""
    return click.option(
        "--figure", "figure_file", type=OutputFile(".png", ".pdf", ".svg"),
        help=f"{what} (PNG, PDF or SVG).",
    )  # fmt: skip


def settings_option(which: str) -> Callable[[Command], Command]:
    """``--set KEY=VALUE``; ``which`` tells what keys there are."""
    return click.option(
        "--set", "settings", multiple=True, callback=_settings, metavar="KEY=VALUE", help=f"{which} May be repeated."
    )


SETTINGS_OPTION = settings_option("Any key of the configuration, as in limits.v_max_m_s=0.05.")
WORLD_OPTIONS = options(
    CONFIG_OPTION,
    click.option(
        "--mirror",
        metavar="NAME",
        shell_complete=names_of("mirrors"),
        help="fyst-m1, fyst-m2, thesis-m1, thesis-m2, or a .toml file.",
    ),
    click.option(
        "--world",
        metavar="NAME",
        shell_complete=names_of("worlds"),
        help="Simulated world: thesis, thesis-x2, hard, extreme, or a .toml file.",
    ),
    click.option("--seed", type=int, metavar="N", help="Seed of every random draw."),
    SETTINGS_OPTION,
)
DAEMON_OPTIONS = options(
    CONFIG_OPTION,
    RUNTIME_DIR_OPTION,
    TIMEOUT_OPTION,
    click.option("--json", "json_output", is_flag=True, help="The daemon's answer as JSON on standard output."),
)
ADDRESS_OPTIONS = options(
    click.option("--host", help="Address to listen on."),
    click.option("--port", type=int, help="Port to listen on; 0 takes any free one."),
)


def overrides(settings: Mapping[str, object], named: Mapping[str, object]) -> dict[str, object]:
    """Command-line values by dotted key: the options that were given, and ``--set`` on top."""
    return {**{key: value for key, value in named.items() if value is not None}, **settings}


def configured_folder(config_file: Path | None, runtime_dir: Path | None) -> Path | None:
    """The runtime directory that command line or configuration names."""
    if runtime_dir is None and config_file is not None:
        from ccatp.config.load import is_radio_file, load_config, load_radio_config

        among_beacons = is_radio_file(config_file)
        processes = load_radio_config(config_file).processes if among_beacons else load_config(config_file).run
        configured = processes.runtime_dir
        return Path(configured) if configured else None
    return runtime_dir


def ask_daemon(runtime_dir: Path | None, channel: str, payload: dict[str, object], timeout_s: float) -> dict[str, Any]:
    """One request to a running daemon.

    Args:
        runtime_dir: its runtime directory, if not the usual one.
        channel: ``control`` or ``emergency``.

    Raises:
        UnreachableError: nobody listens there, or no answer came in time.
        RefusedError: the daemon said no, and why.
    """
    from ccatp.links.client import OperatorClient

    daemon = OperatorClient(runtime_dir, timeout_s)
    return daemon.ask(str(payload["cmd"])) if channel == "control" else daemon.observatory.ask(payload)


def tell(reply: Mapping[str, Any], json_output: bool) -> None:
    """A daemon's answer on standard output."""
    if json_output:
        click.echo(json.dumps(reply))
        return
    _tell_rows([(k, v) for k, v in _flat({key: value for key, value in reply.items() if key != "ok"}) if v])


def tell_status(reply: Mapping[str, Any], json_output: bool) -> None:
    """An answer of the operator channel on standard output: where the mission stands."""
    status = reply.get("status")
    if json_output or not isinstance(status, Mapping):
        tell(reply, json_output)
        return
    from ccatp.daemon.terminal import status_rows

    _tell_rows(status_rows(status))


def _tell_rows(rows: Sequence[tuple[str, str]]) -> None:
    width = max((len(name) for name, _ in rows), default=0)
    for name, value in rows:
        click.echo(f"{name:<{width}}  {value}")
    if not rows:
        click.echo("ok")


def _flat(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    for key, value in tree.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield prefix + key, f"{value:.6g}" if isinstance(value, float) else "-" if value is None else str(value)
