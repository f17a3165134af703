"""The commands to a running daemon, for operators and for the observatory."""

import getpass
import json
import os
import sys
import time
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from ccatp.cli import common
from ccatp.errors import ConfigError, DaemonUnreachableError

if TYPE_CHECKING:
    from ccatp.daemon.supervision.run_text import RunText

_JSON = common.json_option("The daemon's answer as JSON on standard output.")
DAEMON_OPTIONS = common.options(common.CONFIG_OPTION, common.RUNTIME_DIR_OPTION, common.TIMEOUT_OPTION, _JSON)
EMERGENCY_KINDS = ("fire", "earthquake", "power", "weather", "operator")
# Without a terminal a line is written at each change, and at least at this interval.
QUIET_S = 10.0


def _ask(folder: Path | None, command: str, timeout_s: float, **fields: str) -> dict[str, Any]:
    """Send a request to the operator channel of the daemon in a runtime directory, or in the default one."""
    from ccatp.links.client import OperatorClient

    return OperatorClient(folder, timeout_s).ask(command, **fields)


def _text_in(folder: Path | None) -> "RunText | None":
    from ccatp.daemon.supervision.run_text import text_in
    from ccatp.links.runtime_dir import runtime_dir_path

    return text_in(runtime_dir_path(str(folder or ""), os.environ))


def _print_reply(
    reply: Mapping[str, Any], json_output: bool, page: str = "", text: "Callable[[], RunText | None]" = lambda: None
) -> None:
    """Print a daemon's answer; if it has a mission status, print its rows, with the words of the run.

    ``page``: address of the page.
    """
    if json_output:
        click.echo(json.dumps(reply))
        return
    from ccatp.daemon.operator.terminal import status_rows

    facts, status = [(name, str(value)) for name, value in reply.items() if name != "ok"], reply.get("status")
    rows = list(status_rows(status, text())) if isinstance(status, Mapping) else facts
    rows += [("page", page)] if page else []
    common.print_lines(common.columns(rows) or ["ok"])


def _user() -> str:
    """Name of the user who gives a command, for the daemon's log."""
    try:
        return getpass.getuser()
    except (OSError, KeyError):  # a user without a name
        return str(os.getuid())


# What the ways to end a survey have in common and not, in the help of each.
_COMPARED = """

\b
abort      the robot drives home; the run ends there, status 3
stop       the robot stays where it is; the run ends at once, status 4
emergency  the robot drives home, or stands in an earthquake; latched until
           it is cleared
pause      the robot stays where it is until resume; a new emergency or a
           low battery sends it home all the same
"""


def _operator_command(name: str, help_text: str) -> click.Command:
    @common.command(f"ccatp {name}", name=name, help=help_text)
    @DAEMON_OPTIONS
    def command(config_file: Path | None, runtime_dir: Path | None, timeout_s: float, json_output: bool) -> None:
        folder = common.configured_folder(config_file, runtime_dir)
        _print_reply(_ask(folder, name, timeout_s, by=_user()), json_output, text=partial(_text_in, folder))

    return command


pause = _operator_command("pause", f"Stop the robot where it is, until resume.{_COMPARED}")
resume = _operator_command("resume", "Continue after a pause, or after a fault whose cause is gone.")
abort = _operator_command("abort", f"End the survey and drive the robot to its base.{_COMPARED}")
stop = _operator_command("stop", f"Hold the wheels where the robot is, save, and end the daemon.{_COMPARED}")

OBSERVATORY_OPTIONS = common.options(
    click.option("--endpoint", metavar="tcp://HOST:PORT", help="A daemon on another machine, by its TCP endpoint."),
    click.option("--server-key", type=common.PATH, help="With --endpoint: the daemon's NAME.key."),
    click.option("--key", "key_file", type=common.PATH, help="With --endpoint: our NAME.key_secret."),
    DAEMON_OPTIONS,
)


@common.command(
    "ccatp emergency fire --note 'smoke in the receiver cabin'",
    "ccatp emergency fire --endpoint tcp://m1:7020 --server-key ccatp.key --key observatory.key_secret",
    help="Send the robot to its base because of an emergency, which is latched until it is cleared.\n\n"
    f"KIND is fire, earthquake, power, weather or operator.{_COMPARED}",
)
@click.argument("kind", type=click.Choice(EMERGENCY_KINDS), metavar="KIND")
@click.option("--note", default="", help="What happened, for the log.")
@click.option(
    "--id", "emergency_id", type=click.UUID, help="Identity of the emergency; sending the same one again is harmless."
)
@OBSERVATORY_OPTIONS
def emergency(kind: str, note: str, emergency_id: uuid.UUID | None, json_output: bool, **where: Any) -> None:
    """Report an emergency."""
    payload = {"cmd": "emergency", "kind": kind, "id": str(emergency_id or uuid.uuid4()), "note": note}
    _print_reply(_ask_observatory(payload, **where), json_output)


@common.command("ccatp clear 6f1c3c1e-5a0f-4d0e-9f2b-0c8f5b6a7d11")
@click.argument("emergency_id", type=click.UUID, metavar="ID")
@OBSERVATORY_OPTIONS
def clear(emergency_id: uuid.UUID, json_output: bool, **where: Any) -> None:
    """End the emergency ID, whose cause is gone.

    ID is what ccatp emergency printed, and ccatp alarms shows. The robot must be at base or held; over TCP, our key
    needs the role clear.
    """
    _print_reply(_ask_observatory({"cmd": "clear", "id": str(emergency_id)}, **where), json_output)


def _ask_observatory(
    payload: Mapping[str, str], *, endpoint: str | None, server_key: Path | None, key_file: Path | None,
    config_file: Path | None, runtime_dir: Path | None, timeout_s: float,
) -> dict[str, Any]:  # fmt: skip
    """Send a request to the observatory channel of a daemon on this machine, or by TCP on another one."""
    from ccatp.links.client import ObservatoryClient, OperatorClient

    if endpoint is None:
        if server_key is not None or key_file is not None:
            raise click.UsageError("--server-key and --key go with --endpoint tcp://HOST:PORT")
        return OperatorClient(common.configured_folder(config_file, runtime_dir), timeout_s).observatory.ask(payload)
    if not endpoint.startswith("tcp://"):
        raise click.UsageError(f"--endpoint {endpoint!r} is not tcp://HOST:PORT; a daemon here has --runtime-dir")
    if server_key is None or key_file is None:
        raise click.UsageError("--endpoint needs --server-key and --key; make keys with ccatp keys generate")
    return ObservatoryClient.connect(endpoint, server_key, key_file, timeout_s).ask(payload)


@click.group(
    cls=common.CommandGroup,
    invoke_without_command=True,
    epilog=common.example("ccatp alarms", "ccatp alarms ack wheel_blocked", "ccatp alarms history"),
)
@DAEMON_OPTIONS
@click.pass_context
def alarms(
    context: click.Context, config_file: Path | None, runtime_dir: Path | None, timeout_s: float, json_output: bool
) -> None:
    """Show the alarms of the running daemon: severity, start time, cause, and what to do.

    An alarm that held the robot or sent it home stays in the list until it is acknowledged.
    """
    if (command := context.invoked_subcommand) is not None:
        if any(context.get_parameter_source(name) is ParameterSource.COMMANDLINE for name in context.params):
            raise click.UsageError(f"options go behind the command, as in ccatp alarms {command} --runtime-dir DIR")
        return
    folder = common.configured_folder(config_file, runtime_dir)
    found = _ask(folder, "status", timeout_s)["status"]["alarms"]
    latched = _latched(folder)
    lines = [line for alarm in found for line in _alarm_lines(alarm, latched)]
    common.print_result(
        {"alarms": found, "emergencies": latched},
        lines or ["no alarms; ccatp status shows what the robot waits for"],
        json_output,
    )


def _latched(folder: Path | None) -> list[dict[str, str]]:
    """The latched emergencies of the running daemon: alarm, kind, id, note; none if their file cannot be read."""
    from ccatp.daemon.loops.emergency_file import EMERGENCIES_FILE, read_active
    from ccatp.daemon.supervision.process import run_dir_in
    from ccatp.links.runtime_dir import runtime_dir_path
    from ccatp.safety.emergency_latch import cause_of

    run_dir = run_dir_in(runtime_dir_path(str(folder or ""), os.environ))
    try:
        active = [] if run_dir is None else read_active(run_dir / EMERGENCIES_FILE)
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError):
        return []
    return [{"alarm": cause_of(e.kind).condition, "kind": str(e.kind), "id": e.id, "note": e.note} for e in active]


def _alarm_lines(alarm: Mapping[str, Any], latched: Sequence[Mapping[str, str]]) -> list[str]:
    times = f", {alarm['count']} times" if alarm["count"] > 1 else ""
    ended = f", ended {alarm['ended']}" if alarm["ended"] else ""
    seen = f", acknowledged by {alarm['acknowledged_by']} {alarm['acknowledged']}" if alarm["acknowledged"] else ""
    return [
        f"{alarm['severity']:<7} {alarm['name']}: {alarm['cause']}",
        f"        since {alarm['since']}{times}{ended}{seen}",
        *([f"        {alarm['advice']}"] if alarm["advice"] else []),
        *(
            f"        {one['kind']}{': ' if one['note'] else ''}{one['note']}; ended by 'ccatp clear {one['id']}'"
            for one in latched
            if one["alarm"] == alarm["name"] and not alarm["ended"]
        ),
    ]


@alarms.command(epilog=common.example("ccatp alarms ack wheel_blocked"))
@click.argument("name")
@DAEMON_OPTIONS
def ack(name: str, config_file: Path | None, runtime_dir: Path | None, timeout_s: float, json_output: bool) -> None:
    """Acknowledge the alarm NAME: somebody takes care of it. That releases no hold."""
    folder = common.configured_folder(config_file, runtime_dir)
    reply = _ask(folder, "acknowledge", timeout_s, name=name, by=_user())
    _print_reply(reply if json_output else {"ok": True}, json_output)


@alarms.command(epilog=common.example("ccatp alarms history", "ccatp alarms history runs/tonight --json"))
@click.argument("run_dir", type=common.PATH, required=False)
@common.CONFIG_OPTION
@common.RUNTIME_DIR_OPTION
@common.json_option("The events as JSON on standard output.")
def history(run_dir: Path | None, config_file: Path | None, runtime_dir: Path | None, json_output: bool) -> None:
    """Show the events of the alarms of the running daemon, or of the run in RUN_DIR, oldest first."""
    from ccatp.daemon.operator.alarms import read_history
    from ccatp.daemon.supervision.process import run_dir_in
    from ccatp.links.runtime_dir import runtime_dir_path

    if run_dir is None:
        folder = common.configured_folder(config_file, runtime_dir)
        run_dir = run_dir_in(runtime_dir_path(str(folder or ""), os.environ))
    if run_dir is None or not (run_dir / "config.toml").is_file():
        raise ConfigError(f"{run_dir or 'no run'}: no such run; name its directory, as in ccatp alarms history RUN_DIR")
    events = list(read_history(run_dir))
    if json_output:
        import msgspec

        click.echo(msgspec.json.encode({"history": events}))
        return
    rows = [f"{e.utc}  {e.event}{f' by {e.by}' if e.by else ''}: {e.severity} {e.name}: {e.cause}" for e in events]
    common.print_lines(rows or ["no alarms"])


@common.command("ccatp status", "ccatp status --watch", "ccatp status --watch --json | jq -c .status.done")
@DAEMON_OPTIONS
@click.option("--watch", is_flag=True, help="Repeat until the run has ended; with --json one answer a line.")
@click.option(
    "--every", "period_s", type=click.FloatRange(0.1, 3600.0), default=1.0, show_default=True, metavar="SECONDS",
    help="With --watch: period of the answers.",
)  # fmt: skip
def status(
    config_file: Path | None, runtime_dir: Path | None, timeout_s: float, watch: bool, period_s: float,
    json_output: bool,
) -> None:  # fmt: skip
    """Show what the running daemon is doing."""
    folder = common.configured_folder(config_file, runtime_dir)
    if not watch:
        from ccatp.daemon.supervision.child_processes import page_address
        from ccatp.links.runtime_dir import runtime_dir_path

        try:
            reply = _ask(folder, "status", timeout_s)
        except DaemonUnreachableError as error:
            if json_output:  # whoever reads the answer gets one
                click.echo(json.dumps({"ok": False, "error": str(error)}))
            raise
        page = page_address(runtime_dir_path(str(folder or ""), os.environ))
        _print_reply(reply, json_output, page, text=partial(_text_in, folder))
        return
    answers = _answers(folder, timeout_s, period_s)
    if json_output:
        for answer in answers:
            click.echo(json.dumps(answer))
            sys.stdout.flush()
    elif sys.stdout.isatty():
        _watch_terminal(answers, partial(_text_in, folder))
    else:
        _watch_lines(answers, partial(_text_in, folder))


def _answers(folder: Path | None, timeout_s: float, period_s: float) -> Iterator[dict[str, Any]]:
    """Answers one after the other, until the run is over or its daemon, once reached, has ended."""
    is_seen = False
    while True:
        try:
            answer = _ask(folder, "status", timeout_s)
        except DaemonUnreachableError:
            if not is_seen:
                raise
            return
        is_seen = True
        yield answer
        if answer.get("status", {}).get("exit_status", -1) >= 0:
            return
        time.sleep(period_s)


def _watch_lines(answers: Iterator[dict[str, Any]], text_of_run: "Callable[[], RunText | None]") -> None:
    from ccatp.daemon.operator.terminal import status_line

    text: RunText | None = None
    shown, shown_s = tuple[object, ...](), 0.0
    for answer in answers:
        found = answer.get("status", {})
        newest = (found.get("state"), found.get("done"), found.get("cause"))
        if newest != shown or time.monotonic() - shown_s >= QUIET_S:
            shown, shown_s = newest, time.monotonic()
            text = text or text_of_run()  # after the first answer there is a run
            click.echo(status_line(found, text))
            sys.stdout.flush()


def _watch_terminal(answers: Iterator[dict[str, Any]], text_of_run: "Callable[[], RunText | None]") -> None:
    from rich.live import Live
    from rich.table import Table

    from ccatp.daemon.operator.terminal import status_rows

    text: RunText | None = None
    with Live(auto_refresh=False) as live:
        for answer in answers:
            text = text or text_of_run()
            table = Table(box=None, show_header=False, pad_edge=False)
            table.add_column(style="bold")
            table.add_column(overflow="fold")
            for name, value in status_rows(answer.get("status", {}), text):
                style = "red" if name in ("cause", "event code") and value not in ("", "0 normal") else ""
                table.add_row(name, value.replace("[", "\\["), style=style)
            live.update(table, refresh=True)
