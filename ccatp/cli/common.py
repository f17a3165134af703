"""Common parts of the commands: one-line errors, exit statuses, options, connection to a running daemon."""

import errno
import io
import json
import math
import os
import re
import signal
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import reduce
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.shell_completion import CompletionItem

from ccatp.config.package import configs_dir
from ccatp.errors import CcatpError, ConfigError, ExitStatus, one_line, printable
from ccatp.missions import Part

Command = Callable[..., Any]
_NOT_WRITTEN = (errno.ENOSPC, errno.EIO, errno.EBADF)  # full device, closed terminal, read-only stream
# Former and present names of commands.
RENAMED_COMMANDS = {"log": "recording", "recover": "repair", "map": "plot"}
# Longer than any answer takes; libzmq accepts a time-out as an int in milliseconds.
LONGEST_WAIT_S = 86_400.0
_LONGEST_WARNING = 2000  # characters: a sentence is never cut, what a file contains may be
# After which a command says that it works.
PATIENCE_S = 2.0


PATH = click.Path(path_type=Path)
# The oldest click that is supported, which computers of robots may have, has no generic types.
if TYPE_CHECKING:
    _FloatType = click.ParamType[float]
else:
    _FloatType = click.ParamType


class WaitingTime(_FloatType):
    """Time to wait, s: more than 0 and at most a day."""

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


class FiniteNumber(_FloatType):
    """A number that is not infinite, and not NaN."""

    name = "float"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """As ``click.ParamType.convert``."""
        number = float(click.FLOAT.convert(value, param, ctx))
        if not math.isfinite(number):
            self.fail(f"{value} is no finite number", param, ctx)
        return number


class ConfigFile(click.Path):
    """The path of a configuration, or the name of a shipped one."""

    def __init__(self) -> None:
        super().__init__(path_type=Path)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """As ``click.Path.convert``."""
        path, names = Path(str(super().convert(value, param, ctx))), shipped_names("")
        if (path.exists() and not path.is_dir()) or path.name != str(value) or path.suffix == ".toml":
            return path
        if path.name not in names:
            from ccatp.config.messages import choice_hint

            self.fail(f"{path}: no such file, and no configuration by that name; {choice_hint(path.name, names)}")
        return configs_dir() / f"{path}.toml"

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """As ``click.Path.shell_complete``, with the names of shipped configurations."""
        names = [CompletionItem(name) for name in shipped_names("") if name.startswith(incomplete)]
        return [*names, *super().shell_complete(ctx, param, incomplete)]


class OutputFolder(click.Path):
    """A folder to write into; ``files``: names there that might be those of input files."""

    def __init__(self, *files: str) -> None:
        super().__init__(file_okay=False, path_type=Path)
        self.files = files

    def written(self, path: Path) -> list[Path]:
        """Files that the command may write, if it writes to ``path``."""
        return [path / name for name in self.files]


class OutputFile(click.Path):
    """A file to write, with one of the suffixes ``formats`` if given; a bad path is refused before the work.

    ``second``: added to the name of the file, it is the name of another one that is written beside it.
    """

    def __init__(self, *formats: str, second: str = "") -> None:
        super().__init__(dir_okay=False, path_type=Path)
        self.formats = formats
        self.second = second

    def written(self, path: Path) -> list[Path]:
        """Files that the command writes, if it writes to ``path``."""
        return [path, *([path.with_stem(path.stem + self.second)] if self.second else [])]

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """As ``click.Path.convert``."""
        path = Path(str(super().convert(value, param, ctx)))
        option = "output" if param is None else param.opts[0]
        if not path.parent.is_dir():
            raise click.UsageError(f"{option}: no directory {path.parent}; make it first", ctx)
        if self.formats:
            if path.suffix.lower() not in self.formats:
                known = ", ".join(self.formats)
                why = f"{path.name}: no format by that name; the file may end in {known}"
                raise click.UsageError(f"{option}: {why}", ctx)
            from ccatp.report.plots import check_drawing

            check_drawing(path.parent)
        return path


class CheckedCommand(click.Command):
    """A command that never writes over a file that it reads, nor two results into one file."""

    def invoke(self, ctx: click.Context) -> Any:
        """As ``click.Command.invoke``; a bad output is refused before the work."""
        self._check_outputs(ctx)
        return super().invoke(ctx)

    def _check_outputs(self, ctx: click.Context) -> None:
        outputs = list[tuple[str, Path]]()
        inputs = [(key, value) for key, value in _changes(ctx).items() if isinstance(value, str)]
        for param in self.params:
            value, name = ctx.params.get(param.name or ""), _name_of(param)
            for one in value if isinstance(value, tuple) else (value,):
                if not isinstance(one, str | Path):
                    continue
                if isinstance(param.type, OutputFile | OutputFolder):
                    outputs += [(name, file) for file in param.type.written(Path(one))]
                else:
                    # A text may name a file after an equals sign.
                    inputs += [(name, part) for part in {str(one), str(one).partition("=")[2]} if part]
        for at, (option, path) in enumerate(outputs):
            for other, second in outputs[:at]:
                if path.resolve() == second.resolve():
                    raise click.UsageError(f"{other} and {option} name the same file {path}; name two")
            for name, text in inputs:
                if _would_replace(path, Path(text)):
                    raise click.UsageError(
                        f"{option}: {path} is an input, {name} {text}; nothing was written; name another file"
                    )


def _name_of(param: click.Parameter) -> str:
    return param.opts[0] if isinstance(param, click.Option) else param.make_metavar(click.get_current_context())


# What commands write into the folder of a run, and into any folder; all other files there are inputs.
_RESULTS, _PICTURES = (".csv", ".html", ".pdf", ".png", ".svg", ".tum"), (".html", ".pdf", ".png", ".svg")


def _would_replace(output: Path, source: Path) -> bool:
    """Whether an output is the input file ``source``, or a file of the input folder ``source``."""
    try:
        if not output.exists() or not source.exists():
            return False
        if not source.is_dir():
            return output.samefile(source)
        results = _RESULTS if (source / "config.toml").exists() else _PICTURES
        return source.resolve() in output.resolve().parents and output.suffix.lower() not in results
    except (OSError, ValueError):  # a text that is no path
        return False


_errors_as_json = False


class CommandGroup(click.Group):
    """A group of commands that refuses the former name of a command with a message of its present name.

    ``sections``: titles in the help and the places of the commands below them, in this order; a command is imported
    when it is used. Without them there is one title.
    """

    command_class = CheckedCommand

    def __init__(self, *args: Any, sections: Mapping[str, Sequence[Part]] | None = None, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.sections = {title: {part.name: part for part in parts} for title, parts in (sections or {}).items()}
        self._parts = {name: part for parts in self.sections.values() for name, part in parts.items()}

    def list_commands(self, ctx: click.Context) -> list[str]:
        """As ``click.Group.list_commands``."""
        return sorted({*super().list_commands(ctx), *self._parts})

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """As ``click.Group.get_command``."""
        if cmd_name in self._parts:
            command: click.Command = self._parts[cmd_name].get()
            return command
        return super().get_command(ctx, cmd_name)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the complete first sentence of each command's help; click shortens it."""
        sections: Mapping[str, Iterable[str]] = self.sections or {"Commands": self.commands}
        for title, names in sections.items():
            commands = [command for name in names if (command := self.get_command(ctx, name)) is not None]
            texts = [" ".join((command.help or "").split()) for command in commands]
            firsts = [re.split(r"(?<=[.:;])\s", text, maxsplit=1)[0].rstrip(".:;") for text in texts]
            with formatter.section(title):
                formatter.write_dl([(one.name or "", text) for one, text in zip(commands, firsts, strict=True)])

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """As ``click.Group.resolve_command``."""
        name, new_name, known = args[0], RENAMED_COMMANDS.get(args[0]), self.list_commands(ctx)
        if name not in known and new_name in known:
            raise click.UsageError(f"the command {name!r} is now called {new_name!r}", ctx)
        if name not in known:
            for part in self._parts.values():  # click proposes what it has
                self.add_command(part.get())
        return super().resolve_command(ctx, args)


def run_command_line(group: click.Group, argv: Sequence[str] | None = None) -> int:
    """Run a command line (that of the process if ``None``) and return the exit status.

    Errors become one line on standard error, never a traceback; with ``--json`` that is one JSON object.
    """
    global _errors_as_json  # noqa: PLW0603 - of this process, like its standard error
    _errors_as_json = "--json" in (sys.argv[1:] if argv is None else argv)
    # The matrices are small: threads would compete for the cores, and their number can change the rounding.
    # This must be set before numpy is imported.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    _prepare_streams()
    try:
        status = _status_of(group, argv)
    except Exception as error:
        from ccatp.config.files import keep_traceback

        status = complain(keep_traceback(error), ExitStatus.REFUSED)
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:  # discard the rest of the buffer
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
    return status


def _status_of(group: click.Group, argv: Sequence[str] | None) -> int:
    try:
        status = group.main(args=argv, prog_name="ccatp", standalone_mode=False)
        sys.stdout.flush()
    except click.exceptions.NoArgsIsHelpError as error:
        with suppress(OSError):
            click.echo(error.format_message(), err=True)
        return ExitStatus.USAGE
    except (click.ClickException, ModuleNotFoundError) as error:
        missing = f"the package {getattr(error, 'name', '')} is not installed; install ccatp with all its dependencies"
        what = error.format_message().rstrip(".") if isinstance(error, click.ClickException) else missing
        context = getattr(error, "ctx", None)
        where = f"; see {context.command_path} --help" if context else ""
        return complain(one_line(what + where), ExitStatus.USAGE)
    except CcatpError as error:
        return complain(str(error), error.exit_status)
    except (click.Abort, KeyboardInterrupt):
        return complain("interrupted", ExitStatus.INTERRUPTED)
    except BrokenPipeError:  # the reader of the output has closed the pipe
        return ExitStatus.REFUSED
    except OSError as error:
        if error.filename is None and error.errno in _NOT_WRITTEN:
            return complain(f"output cannot be written: {error.strerror}", ExitStatus.USAGE)
        if error.filename is None:
            raise
        # For example a name that is too long, or a folder without permission.
        what = f"{error.filename}: {error.strerror}; give another path, or correct this one"
        return complain(one_line(what), ExitStatus.USAGE)
    return int(status or 0)


def _prepare_streams() -> None:
    """Connect closed standard streams to the null device, not to the next opened file; escape unencodable text."""
    for fd in range(3):
        try:
            os.fstat(fd)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # uses the lowest free descriptor
    sys.stdout = sys.stdout or Path(os.devnull).open("w", encoding="utf-8")  # noqa: SIM115
    sys.stderr = sys.stderr or Path(os.devnull).open("w", encoding="utf-8")  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def complain(message: str, status: int) -> int:
    """Write one line on standard error; with ``--json`` an error (``status`` > 0) is an object. Return ``status``."""
    line = printable(" ".join(message.split()))
    if _errors_as_json and status:
        line = json.dumps({"error": line, "status": int(status)})
    with suppress(OSError):  # standard error may be closed
        click.echo(line if line.startswith("{") else f"ccatp: {line}", err=True)
    return int(status)


def warn(warnings: Iterable[str]) -> None:
    """A line on standard error for each warning."""
    for warning in warnings:
        complain(f"warning: {one_line(warning, _LONGEST_WARNING)}", 0)


@contextmanager
def working(what: str) -> Iterator[None]:
    """On a terminal, say after two seconds that a command works, and for how long; the line goes when it is done.

    In the main thread, by a signal: with a second thread the report could not draw on two cores (``report.html``).
    """
    if not sys.stderr.isatty():
        yield
        return
    begun_s, line = time.monotonic(), ""

    def tell(*_: object) -> None:
        nonlocal line
        line = f"ccatp: {printable(what)}, {time.monotonic() - begun_s:.0f} s"
        with suppress(OSError):  # a terminal that is gone
            click.echo(f"\r{line}", nl=False, err=True)

    handler = signal.signal(signal.SIGALRM, tell)
    timer = signal.setitimer(signal.ITIMER_REAL, PATIENCE_S, 1.0)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, *timer)
        signal.signal(signal.SIGALRM, handler)
        if line:
            click.echo(f"\r{' ' * len(line)}\r", nl=False, err=True)


def print_lines(lines: Iterable[str]) -> None:
    """Lines on standard output."""
    for line in lines:
        click.echo(printable(line))


def print_result(result: object, lines: Iterable[str], as_json: bool) -> None:
    """A result on standard output, as JSON or as lines for a reader."""
    print_lines([json.dumps(result)] if as_json else lines)


def columns(rows: Sequence[Sequence[str]], *, left: int = 99) -> list[str]:
    """Rows as lines, their first ``left`` columns aligned to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    formats = [f"{'<' if k < left else '>'}{width}" for k, width in enumerate(widths)]
    return ["  ".join(map(format, row, formats)).rstrip() for row in rows]


def write_lines(option: str, path: Path, lines: Iterable[str]) -> None:
    """Write the text file that an option names. Raises ConfigError: it cannot be written."""
    try:
        with path.open("w", encoding="utf-8") as file:
            file.writelines(line + "\n" for line in lines)
    except OSError as error:
        raise ConfigError(f"{option}: cannot write {path}: {error.strerror or error}") from error


def example(*lines: str) -> str:
    """The epilog of a command's help."""
    return "\b\nExample:\n" + "\n".join(f"  {line}" for line in lines)


def command(*examples: str, **attributes: Any) -> Callable[[Command], click.Command]:
    """``click.command`` with these examples at the end of its help."""
    return click.command(epilog=example(*examples), **{"cls": CheckedCommand, **attributes})


def options(*decorators: Callable[[Command], Command]) -> Callable[[Command], Command]:
    """Several options as one decorator, shown in the order given."""
    return lambda command: reduce(lambda changed, decorator: decorator(changed), reversed(decorators), command)


def renamed_flag(old: str, new: str) -> Callable[[Command], Command]:
    """A hidden flag with the former name, which is refused with a message of the present name."""

    def refuse(ctx: click.Context, _param: click.Parameter, is_given: bool) -> None:
        if is_given:
            raise click.UsageError(f"{old} is now called {new}", ctx)

    former = f"former_{new.strip('-').replace('-', '_')}"
    return click.option(old, former, is_flag=True, hidden=True, expose_value=False, callback=refuse)


def parse_setting(text: str) -> tuple[str, object]:
    """Parse ``run.seed=2`` to ``("run.seed", 2)``; a value that is not TOML is text. ValueError: no key or no ``=``."""
    from ccatp.config.messages import MOST_PARTS, parse_toml

    key, equals, value = text.partition("=")
    parts = key.strip().split(".")
    if not equals or not all(parts) or len(parts) > MOST_PARTS:
        raise ValueError(f"{text!r} is not KEY=VALUE, as in run.seed=2")
    try:
        found = parse_toml(f"value = {value}", "")
    except ConfigError:
        found = {}
    # Several lines of TOML are text, too.
    return key.strip(), found["value"] if len(found) == 1 else value.strip()


def _changes(ctx: click.Context) -> Any:
    """Configuration values that this command line sets, by dotted key."""
    return ctx.meta.setdefault("ccatp.changes", {})


def _take_settings(ctx: click.Context, _param: click.Parameter, values: Iterable[str]) -> dict[str, object]:
    changes: dict[str, object] = _changes(ctx)
    try:
        changes.update(parse_setting(value) for value in values)
    except ValueError as error:
        raise click.BadParameter(str(error)) from error
    return changes


def key_option(flag: str, key: str, **attributes: Any) -> Callable[[Command], Command]:
    """An option that sets a key of the configuration in ``settings``; ``--set`` has precedence."""

    def take(ctx: click.Context, _param: click.Parameter, value: object) -> None:
        if value is not None:
            _changes(ctx).setdefault(key, value)

    return click.option(flag, expose_value=False, callback=take, **attributes)


def names_of(folder: str) -> Callable[[click.Context, click.Parameter, str], list[str]]:
    """Complete the names of shipped configurations in a folder; the shell completes paths."""
    return lambda _ctx, _param, incomplete: [name for name in shipped_names(folder) if name.startswith(incomplete)]


def shipped_names(folder: str) -> list[str]:
    """Names of the shipped configurations in a folder."""
    return sorted(path.stem for path in (configs_dir() / folder).glob("*.toml"))


def json_option(help_text: str) -> Callable[[Command], Command]:
    """``--json``."""
    return click.option("--json", "json_output", is_flag=True, help=help_text)


def figure_option(what: str) -> Callable[[Command], Command]:
    """``--figure FILE``; ``what`` names the drawing."""
    formats = OutputFile(".png", ".pdf", ".svg")
    return click.option("--figure", "figure_file", type=formats, help=f"{what} (PNG, PDF or SVG).")


def settings_option(which: str) -> Callable[[Command], Command]:
    """``--set KEY=VALUE`` as ``settings``, with the values of other options; ``which`` names the keys."""
    return click.option(
        "--set", "settings", multiple=True, callback=_take_settings, metavar="KEY=VALUE",
        help=f"{which} May be repeated.",
    )  # fmt: skip


JSON_OPTION = json_option("Result as JSON on standard output, nothing else there.")
CONFIG_FILE = ConfigFile()
CONFIG_OPTION = click.option(
    "--config", "config_file", type=CONFIG_FILE, help="Configuration: a TOML file, or the name of a shipped one."
)
TIMEOUT_OPTION = click.option(
    "--timeout", "timeout_s", type=WaitingTime(), default=10.0, show_default=True, metavar="SECONDS",
    help="Seconds to wait.",
)  # fmt: skip
RUNTIME_DIR_OPTION = click.option(
    "--runtime-dir", type=PATH, help="Folder of the sockets, if not the usual one; it names one of several runs."
)
FAULTS_OPTION = click.option("--faults", "faults_file", type=PATH, help="Fault plan (TOML) for the simulated robot.")
SETTINGS_OPTION = settings_option("Any key of the configuration, as in limits.v_max_m_s=0.05.")
PANELS_OPTION = key_option(
    "--panels", "run.panels", type=int, metavar="N", help="Only the first N panels of the traversal; 0 takes all."
)
WORLD_OPTIONS = options(
    CONFIG_OPTION,
    key_option("--mirror", "run.mirror", metavar="NAME", shell_complete=names_of("mirrors"),
               help="fyst-m1, fyst-m2, thesis-m1, thesis-m2, or a .toml file."),
    key_option("--world", "run.world", metavar="NAME", shell_complete=names_of("worlds"),
               help="Simulated world: thesis, thesis-x2, hard, extreme, or a .toml file."),
    key_option("--seed", "run.seed", type=int, metavar="N", help="Seed of every random draw."),
    SETTINGS_OPTION,
)  # fmt: skip


def address_options(section: str) -> Callable[[Command], Command]:
    """``--host`` and ``--port`` of a section of the configuration."""
    return options(
        key_option("--host", f"{section}.host", help="Address to listen on."),
        key_option("--port", f"{section}.port", type=int, help="Port to listen on; 0 takes any free one."),
    )


def configured_folder(config_file: Path | None, runtime_dir: Path | None) -> Path | None:
    """The given runtime directory, or that of the only running daemon, or None. ConfigError: several daemons run."""
    if runtime_dir is None and config_file is not None:
        from ccatp.config.load import load_mission

        configured = load_mission(config_file).processes.runtime_dir
        runtime_dir = Path(configured) if configured else None
    if runtime_dir is not None:
        return runtime_dir
    from ccatp.links.runtime_dir import running_in, runtime_dir_path

    running = running_in(runtime_dir_path("", os.environ))
    if len(running) > 1:
        from ccatp.daemon.supervision.process import run_dir_in

        runs = [f"{folder} ({run_dir.name if (run_dir := run_dir_in(folder)) else 'starts'})" for folder in running]
        raise ConfigError(f"{len(running)} runs are in progress; choose one with --runtime-dir: {', '.join(runs)}")
    return running[0] if running else None
