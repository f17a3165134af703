"""The commands of the operator: ``ccatp pause``, ``resume``, ``abort`` and ``stop``.

The commands ``ccatp emergency`` and ``ccatp clear``: to a daemon here, or by TCP to one elsewhere.

The command ``ccatp status``.
"""

import json
import sys
import time
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click

from ccatp.cli.common import (
    CONFIG_OPTION,
    DAEMON_OPTIONS,
    RUNTIME_DIR_OPTION,
    TIMEOUT_OPTION,
    NearestChoice,
    ask_daemon,
    configured_folder,
    example,
    options,
    tell,
    tell_status,
)
from ccatp.errors import DaemonUnreachableError


@click.command(epilog=example("ccatp pause"))
@DAEMON_OPTIONS
def pause(config_file: Path | None, runtime_dir: Path | None, timeout_s: float, json_output: bool) -> None:
    """Stop the robot where it is, until resume."""
    tell_status(_ask("pause", config_file, runtime_dir, timeout_s), json_output)


@click.command(epilog=example("ccatp resume"))
@DAEMON_OPTIONS
def resume(config_file: Path | None, runtime_dir: Path | None, timeout_s: float, json_output: bool) -> None:
    """Carry on after pause."""
    tell_status(_ask("resume", config_file, runtime_dir, timeout_s), json_output)


@click.command(epilog=example("ccatp abort"))
@DAEMON_OPTIONS
def abort(config_file: Path | None, runtime_dir: Path | None, timeout_s: float, json_output: bool) -> None:
    """Give up the survey and drive the robot to its base."""
    tell_status(_ask("abort", config_file, runtime_dir, timeout_s), json_output)


@click.command(epilog=example("ccatp stop"))
@DAEMON_OPTIONS
def stop(config_file: Path | None, runtime_dir: Path | None, timeout_s: float, json_output: bool) -> None:
    """Hold the wheels where the robot is, save, and end the daemon."""
    tell_status(_ask("stop", config_file, runtime_dir, timeout_s), json_output)


def _ask(command: str, config_file: Path | None, runtime_dir: Path | None, timeout_s: float) -> dict[str, Any]:
    return ask_daemon(configured_folder(config_file, runtime_dir), "control", {"cmd": command}, timeout_s)


EMERGENCY_KINDS = ("fire", "earthquake", "power", "weather", "operator")
OBSERVATORY_OPTIONS = options(
    click.option("--endpoint", metavar="tcp://HOST:PORT", help="A daemon on another machine, by its TCP endpoint."),
    click.option("--server-key", type=click.Path(path_type=Path), help="With --endpoint: the daemon's NAME.key."),
    click.option("--key", "key_file", type=click.Path(path_type=Path), help="With --endpoint: our NAME.key_secret."),
    DAEMON_OPTIONS,
)


@click.command(
    epilog=example(
        "ccatp emergency fire --note 'smoke in the receiver cabin'",
        "ccatp emergency fire --endpoint tcp://m1:7020 --server-key ccatp.key --key observatory.key_secret",
    )
)
@click.argument("kind", type=NearestChoice(EMERGENCY_KINDS), metavar="KIND")
@click.option("--note", default="", help="What happened, for the log.")
@click.option(
    "--id", "emergency_id", type=click.UUID, help="Identity of the emergency; sending the same one again is harmless."
)
@OBSERVATORY_OPTIONS
def emergency(
    kind: str, note: str, emergency_id: uuid.UUID | None,
    endpoint: str | None, server_key: Path | None, key_file: Path | None,
    config_file: Path | None, runtime_dir: Path | None, timeout_s: float, json_output: bool,
) -> None:  # fmt: skip
    """Report an emergency: the robot goes to its base.

    KIND is fire, earthquake, power, weather or operator.
    """
    payload: dict[str, object] = {
        "cmd": "emergency",
        "kind": kind,
        "id": str(emergency_id or uuid.uuid4()),
        "note": note,
    }
    folder = configured_folder(config_file, runtime_dir)
    tell(_ask_observatory(endpoint, server_key, key_file, folder, payload, timeout_s), json_output)


@click.command(epilog=example("ccatp clear 6f1c3c1e-5a0f-4d0e-9f2b-0c8f5b6a7d11"))
@click.argument("emergency_id", type=click.UUID, metavar="ID")
@OBSERVATORY_OPTIONS
def clear(
    emergency_id: uuid.UUID, endpoint: str | None, server_key: Path | None, key_file: Path | None,
    config_file: Path | None, runtime_dir: Path | None, timeout_s: float, json_output: bool,
) -> None:  # fmt: skip
    """End the emergency ID, whose cause is gone.

    ID is what ccatp emergency printed. The robot must be at base or held; over TCP, our key needs the role clear.
    """
    payload: dict[str, object] = {"cmd": "clear", "id": str(emergency_id)}
    folder = configured_folder(config_file, runtime_dir)
    tell(_ask_observatory(endpoint, server_key, key_file, folder, payload, timeout_s), json_output)


def _ask_observatory(
    endpoint: str | None, server_key: Path | None, key_file: Path | None,
    folder: Path | None, payload: dict[str, object], timeout_s: float,
) -> dict[str, Any]:  # fmt: skip
    if endpoint is None:
        if server_key is not None or key_file is not None:
            raise click.UsageError("--server-key and --key go with --endpoint tcp://HOST:PORT")
        return ask_daemon(folder, "emergency", payload, timeout_s)
    if not endpoint.startswith("tcp://"):
        raise click.UsageError(f"--endpoint {endpoint!r} is not tcp://HOST:PORT; a daemon here has --runtime-dir")
    if server_key is None or key_file is None:
        raise click.UsageError("--endpoint needs --server-key and --key; make keys with ccatp keys generate")
    return _ask_over_tcp(endpoint, server_key, key_file, payload, timeout_s)


def _ask_over_tcp(
    endpoint: str, server_key: Path, key: Path, payload: dict[str, object], timeout_s: float
) -> dict[str, Any]:
    """One request to the observatory channel of a daemon elsewhere.

    Args:
        endpoint: ``tcp://HOST:PORT``.

    Raises:
        ConfigError: a key file cannot be used.
        UnreachableError: nobody listens there, or no answer came in time; a daemon does not answer who is not listed.
        RefusedError: the daemon said no, and why.
    """
    from ccatp.links.auth import read_pair, read_public
    from ccatp.links.client import exchange
    from ccatp.links.rpc import CurveClient

    pair = read_pair(key, "--key")
    curve = CurveClient(read_public(server_key, "--server-key"), pair.public, pair.secret)
    return exchange(endpoint, payload, timeout_s, curve, repeats=True)


# Without a terminal a line is told at a change, and at least this often.
QUIET_S = 10.0


@click.command(
    epilog=example("ccatp status", "ccatp status --watch", "ccatp status --watch --json | jq -c .status.done")
)
@CONFIG_OPTION
@RUNTIME_DIR_OPTION
@TIMEOUT_OPTION
@click.option("--watch", is_flag=True, help="Go on until the run is over.")
@click.option(
    "--every", "period_s", type=click.FloatRange(0.1, 3600.0), default=1.0, show_default=True, metavar="SECONDS",
    help="With --watch: look this often.",
)  # fmt: skip
@click.option("--json", "json_output", is_flag=True, help="The daemon's answer as JSON; with --watch one a line.")
def status(
    config_file: Path | None, runtime_dir: Path | None, timeout_s: float, watch: bool, period_s: float,
    json_output: bool,
) -> int:  # fmt: skip
    """Show what the running daemon is doing."""
    folder = configured_folder(config_file, runtime_dir)
    if not watch:
        tell_status(ask_daemon(folder, "control", {"cmd": "status"}, timeout_s), json_output)
        return 0
    answers = _answers(folder, timeout_s, period_s)
    if json_output:
        for answer in answers:
            click.echo(json.dumps(answer))
            sys.stdout.flush()
    elif sys.stdout.isatty():
        _watch_terminal(answers)
    else:
        _watch_lines(answers)
    return 0


def _answers(folder: Path | None, timeout_s: float, period_s: float) -> Iterator[dict[str, Any]]:
    """One after the other, until the run is over or its daemon, which was there, is gone."""
    is_seen = False
    while True:
        try:
            answer = ask_daemon(folder, "control", {"cmd": "status"}, timeout_s)
        except DaemonUnreachableError:
            if not is_seen:
                raise
            return
        is_seen = True
        yield answer
        if answer.get("status", {}).get("exit_status", -1) >= 0:
            return
        time.sleep(period_s)


def _watch_lines(answers: Iterator[dict[str, Any]]) -> None:
    from ccatp.daemon.terminal import status_line

    told: tuple[object, ...] = ()
    told_s = 0.0
    for answer in answers:
        found = answer.get("status", {})
        news = (found.get("state"), found.get("done"), found.get("cause"))
        if news != told or time.monotonic() - told_s >= QUIET_S:
            told, told_s = news, time.monotonic()
            click.echo(status_line(found))
            sys.stdout.flush()


def _watch_terminal(answers: Iterator[dict[str, Any]]) -> None:
    from rich.live import Live
    from rich.table import Table

    from ccatp.daemon.terminal import status_rows

    with Live(auto_refresh=False) as live:
        for answer in answers:
            table = Table(box=None, show_header=False, pad_edge=False)
            table.add_column(style="bold")
            table.add_column(overflow="fold")
            for name, value in status_rows(answer.get("status", {})):
                style = "red" if name in ("cause", "danger") and value not in ("", "0 normal") else ""
                table.add_row(name, value.replace("[", "\\["), style=style)
            live.update(table, refresh=True)
