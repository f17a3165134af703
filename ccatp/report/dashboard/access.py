"""Who may read and who may command over HTTP: host names, origins, tokens.

A page of another site that the operator has open must neither command the robot (it can send requests anywhere, but
the browser states its origin) nor read its state (under a name of its own that resolves to this address).
"""

import contextlib
import hmac
import ipaddress
import re
import secrets
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import NamedTuple

from ccatp.config.files import FOR_OTHERS, read_private, write_file
from ccatp.config.models import DashboardConfig
from ccatp.errors import ConfigError

# 128 bits in hexadecimal digits: the number of attempts is not limited.
MIN_CHARACTERS = 32
# In the runtime directory: the token made at the start if none is configured.
TOKEN_FILE = "dashboard.token"  # noqa: S105 - the name of a file
# Name of a token without a configured name.
DEFAULT_NAME = "operator"
_HOST = re.compile(r"(?P<name>\[[0-9a-fA-F:.]+\]|[A-Za-z0-9._-]+)(?::[0-9]{1,5})?")
_MAKE = "make one with: (umask 077; openssl rand -hex 24 > FILE)"
_WHICH = "that of the address that ccatp status shows, or one of dashboard.token_file"


class CommandRefusal(NamedTuple):
    """HTTP status and reason."""

    http_status: int
    message: str


def host_refusal(host: str | None, names: Collection[str]) -> str | None:
    """Reason to refuse a request with this ``Host`` header; None for an IP address, ``localhost`` or a configured name.

    A foreign name may resolve to this machine's address, so other names are refused (DNS rebinding).
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


def check_command(headers: Mapping[str, str], tokens: Mapping[str, str]) -> str | CommandRefusal:
    """The name of the token of a command with these headers, or why it is refused: its origin (403), its token (401).

    Browsers send ``Origin`` and ``Sec-Fetch-Site``; other programs may omit them.
    """
    host, origin, site = headers["host"].lower(), headers.get("origin"), headers.get("sec-fetch-site", "none")
    if origin is not None and origin.lower() not in (f"http://{host}", f"https://{host}"):
        return CommandRefusal(403, f"commands from pages of {origin} are not taken")
    if site.lower() not in ("same-origin", "none"):
        return CommandRefusal(403, f"commands from pages of other sites ({site}) are not taken")
    scheme, space, given = headers.get("authorization", "").partition(" ")
    if scheme.lower() != "bearer" or not space:
        return CommandRefusal(401, f"commands need a token (Authorization: Bearer TOKEN): {_WHICH}")
    # Compare with all tokens, each in constant time, so that the response time reveals nothing about a token.
    names = [name for name, token in tokens.items() if hmac.compare_digest(given.strip().encode(), token.encode())]
    return names[0] if names else CommandRefusal(401, f"the token is not accepted: give {_WHICH}")


def make_token(runtime_dir: Path) -> str:
    """A new token, in a file that only the user of this process can read; ConfigError: it cannot be written."""
    token = secrets.token_hex(MIN_CHARACTERS // 2)
    write_file(runtime_dir / TOKEN_FILE, f"{token}\n", 0o600)
    return token


def read_tokens(path: Path) -> dict[str, str]:
    """The tokens in a file by name, a line each; ConfigError: it cannot be read, is open to others, or has a bad line.

    The messages contain no line of the file.
    """
    text = read_private(path, "dashboard.token_file", FOR_OTHERS, _MAKE).decode("ascii", "replace")
    tokens: dict[str, str] = {}
    for number, line in enumerate(text.splitlines(), 1):
        if line.startswith("#") or not line.strip():
            continue
        *name, token = line.split()
        key = name[0] if name else DEFAULT_NAME
        if len(name) > 1 or len(token) < MIN_CHARACTERS or not (line.isascii() and token.isprintable()):
            raise ConfigError(
                f"dashboard.token_file: line {number} of {path} is not NAME TOKEN, or TOKEN alone, with a token of "
                f"at least {MIN_CHARACTERS} ASCII characters; {_MAKE}"
            )
        if key in tokens or token in tokens.values():
            raise ConfigError(f"dashboard.token_file: line {number} of {path}: name or token stands twice")
        tokens[key] = token
    if not tokens:
        raise ConfigError(f"dashboard.token_file: {path} holds no token; {_MAKE}")
    return tokens


def page_tokens(cfg: DashboardConfig, runtime_dir: Path) -> dict[str, str]:
    """The configured tokens by name, or else that of this start; errors as of ``read_tokens``."""
    return read_tokens(Path(cfg.token_file) if cfg.token_file else runtime_dir / TOKEN_FILE)
