"""Glue. The command ``ccatp conformance``."""

import difflib
import json
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import click

from ccatp.commands.frame import JSON_OPTION, WaitingTime, complain, example
from ccatp.errors import ConfigError

if TYPE_CHECKING:
    from ccatp.conformance.stage import Facts

FAILED = 1


@click.command(
    epilog=example(
        "ccatp conformance 192.168.1.20:7010 --no-motion",
        "ccatp conformance 127.0.0.1:7010 --key robot.key --json",
        "ccatp conformance 127.0.0.1:7010 --only ttl-drive --only ttl-permit",
    )
)
@click.argument("server", metavar="HOST:PORT")
@click.option(
    "--key", "key_file", type=click.Path(dir_okay=False), metavar="FILE",
    help="Key of the robot link, as in robot.key_file.",
)  # fmt: skip
@click.option("--no-motion", is_flag=True, help="Leave out the checks that turn wheels.")
@click.option("--only", multiple=True, metavar="ID", help="Run only this check. May be repeated.")
@click.option(
    "--timeout",
    "timeout_s",
    type=WaitingTime(),
    metavar="SECONDS",
    default=3.0,
    show_default=True,
    help="Seconds to wait for an answer.",
)
@JSON_OPTION
def conformance(
    server: str, key_file: str | None, no_motion: bool, only: Sequence[str], timeout_s: float, json_output: bool
) -> int:
    """Check a robot-link server, firmware or simulator, against the interface control document.

    Wheels turn slowly and for a moment, unless --no-motion. In the end the robot is held, its fans as they were.
    """
    from ccatp.conformance.report import as_json, last_line, table_line
    from ccatp.conformance.runner import Conformance
    from ccatp.conformance.table import check_ids

    address = _address(server)
    _check_ids(only, check_ids())
    checks = Conformance(address, _key(key_file), timeout_s)
    if not no_motion:
        _announce(checks.facts, only)
    results = checks.run(
        motion=not no_motion,
        only=only,
        tell=lambda result: None if json_output else click.echo(table_line(result)),
    )
    click.echo(json.dumps(as_json(server, results)) if json_output else last_line(results))
    return FAILED if any(result.outcome == "fail" for result in results) else 0


def _announce(facts: "Facts | None", only: Sequence[str]) -> None:
    """Say that wheels will turn, and by how much at most."""
    from ccatp.conformance.stories_motion import extent
    from ccatp.conformance.table import CHECKS

    moving = [check for check in CHECKS if "motion" in check.needs and (not only or check.check_id in only)]
    if facts is None or not moving:
        return
    most = extent(facts)
    complain(
        f"wheels will turn in {len(moving)} checks, each at most {most.rate_rad_s:g} rad/s "
        f"({1e3 * most.speed_m_s:.0f} mm/s) for {most.time_s:.2f} s: {1e3 * most.way_m:.0f} mm, "
        f"{math.degrees(most.turn_rad):.0f} degrees; --no-motion leaves them out",
        0,
    )


def _address(server: str) -> tuple[str, int]:
    host, _, port = server.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not host or not port.isdecimal() or not 0 < int(port) < 1 << 16:
        raise click.UsageError(f"{server!r} is not HOST:PORT, as in 127.0.0.1:7010")
    return host, int(port)


def _check_ids(only: Sequence[str], known: Sequence[str]) -> None:
    for name in only:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            hint = f"did you mean {near[0]}?" if near else f"there are {', '.join(known)}"
            raise click.UsageError(f"--only: no check {name!r}; {hint}")


def _key(key_file: str | None) -> bytes | None:
    from ccatp.robot_link import read_key

    try:
        return read_key(key_file or "")
    except ConfigError as error:
        raise ConfigError(str(error).replace("robot.key_file", "--key", 1)) from error
