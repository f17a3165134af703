"""Who may read and who may command over HTTP: host names, origins, the token.

A page of another site that the operator has open must neither command the robot (it can send requests anywhere, but
the browser states its origin) nor read its state (under a name of its own that resolves to this address).
"""

import contextlib
import hmac
import ipaddress
import re
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import NamedTuple

from ccatp.config.models import DashboardConfig
from ccatp.errors import ConfigError
from ccatp.links.auth import FOR_OTHERS, reading

# 128 bits in hexadecimal digits: nothing limits the attempts.
MIN_CHARACTERS = 32
_HOST = re.compile(r"(?P<name>\[[0-9a-fA-F:.]+\]|[A-Za-z0-9._-]+)(?::[0-9]{1,5})?")
_MAKE = "make one with: (umask 077; openssl rand -hex 24 > FILE)"


class CommandRefusal(NamedTuple):
    """HTTP status and reason."""

    http_status: int
    message: str


def host_refusal(host: str | None, names: Collection[str]) -> str | None:
    """Why a request with this header ``Host`` is not served: no address, not ``localhost`` and no configured name.

    A foreign name may resolve to this address; an address is always that of this machine.
    """
    matched = _HOST.fullmatch(host or "")
    if matched is None:
        return "the Host header is missing or no host"
    name = matched["name"].strip("[]").lower()
    if name == "localhost" or name in {known.lower() for known in names}:
        return None
    with contextlib.suppress(ValueError):
        ipaddress.ip_address(name)
        return None
    return f"this is not {name}; ask by address, or add the name to dashboard.host_names"


def command_refusal(headers: Mapping[str, str], token: str | None) -> CommandRefusal | None:
    """Why a command with these headers is refused: its origin (403) or its token (401); ``None`` if it is accepted.

    Browsers send ``Origin`` and ``Sec-Fetch-Site``, other programs need not.
    """
    host, origin, site = headers["host"].lower(), headers.get("origin"), headers.get("sec-fetch-site", "none")
    if origin is not None and origin.lower() not in (f"http://{host}", f"https://{host}"):
        return CommandRefusal(403, f"commands from pages of {origin} are not taken")
    if site.lower() not in ("same-origin", "none"):
        return CommandRefusal(403, f"commands from pages of other sites ({site}) are not taken")
    if token is None:
        return None
    scheme, space, given = headers.get("authorization", "").partition(" ")
    if scheme.lower() != "bearer" or not space:
        return CommandRefusal(401, "commands need the token of dashboard.token_file: Authorization: Bearer TOKEN")
    if not hmac.compare_digest(given.strip().encode(), token.encode()):
        return CommandRefusal(401, "the token is not that of dashboard.token_file")
    return None


def read_token(cfg: DashboardConfig) -> str | None:
    """The token, ``None`` where none is configured; ConfigError: it cannot be read, is open to others, or is none."""
    if not cfg.token_file:
        return None
    path = Path(cfg.token_file)
    with reading(path, "dashboard.token_file", FOR_OTHERS, _MAKE):
        data = path.read_bytes()
    if not data.isascii():
        raise ConfigError(f"dashboard.token_file: {path} is no text of ASCII characters; {_MAKE}")
    token = data.decode().strip()
    if len(token) < MIN_CHARACTERS or not token.isprintable() or " " in token:
        raise ConfigError(
            f"dashboard.token_file: {path} must hold one word of at least {MIN_CHARACTERS} characters; {_MAKE}"
        )
    return token
