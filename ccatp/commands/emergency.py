"""Glue. The commands ``ccatp emergency`` and ``ccatp clear``: to a daemon here, or by TCP to one elsewhere."""

import uuid
from pathlib import Path
from typing import Any

import click

from ccatp.commands.frame import (
    DAEMON_OPTIONS,
    NearestChoice,
    ask_daemon,
    configured_folder,
    example,
    options,
    tell,
)

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

    ID is what ccatp emergency told. The robot must be at base or held; over TCP, our key needs the role clear.
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
        server_key: file with the daemon's public key.
        key: file with our own secret key.
        payload: the request.
        timeout_s: longest wait for the answer.

    Raises:
        ConfigError: a key file cannot be used.
        UnreachableError: nobody listens there, or no answer came in time; a daemon does not answer who is not listed.
        RefusedError: the daemon said no, and why.
    """
    from ccatp.client import exchange
    from ccatp.curve_keys import read_pair, read_public
    from ccatp.router import CurveClient

    pair = read_pair(key, "--key")
    curve = CurveClient(read_public(server_key, "--server-key"), pair.public, pair.secret)
    return exchange(endpoint, payload, timeout_s, curve, repeats=True)
