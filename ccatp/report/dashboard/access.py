"""Who may ask, and who may command, over HTTP: host names, origins, tokens.

A page of some other site that the operator has open must neither command the robot (it can send requests anywhere, but
the browser says from where) nor read its state (by a name of its own that suddenly means our address).

The token that commands over HTTP have to carry.
"""

import hmac
import ipaddress
import re
import stat
from collections.abc import Collection
from pathlib import Path

from ccatp.config.models import DashboardConfig
from ccatp.errors import ConfigError

_HOST = re.compile(r"(?P<name>\[[0-9a-fA-F:.]+\]|[A-Za-z0-9._-]+)(?::[0-9]{1,5})?")
_SAME_SITE = ("same-origin", "none")
_BEARER = "bearer "


def host_refusal(host: str | None, names: Collection[str]) -> str | None:
    """Why a request is not served by the name under which it was sent, or ``None``.

    Addresses cannot be bent to another machine, names can: only ``localhost`` and the configured ones are ours.

    Args:
        host: the header ``Host``.
    """
    matched = _HOST.fullmatch(host or "")
    if matched is None:
        return "the Host header is missing or no host"
    name = matched["name"].strip("[]").lower()
    if name == "localhost" or name in {known.lower() for known in names} or _is_address(name):
        return None
    return f"this is not {name}; ask by address, or add the name to dashboard.host_names"


def origin_refusal(origin: str | None, fetch_site: str | None, host: str) -> str | None:
    """Why a command may not come from where the browser says that it comes from, or ``None``.

    Args:
        origin: the header ``Origin``; programs that are no browsers send none.
        fetch_site: the header ``Sec-Fetch-Site``, likewise.
        host: the header ``Host``.
    """
    if origin is not None and origin.lower() not in (f"http://{host.lower()}", f"https://{host.lower()}"):
        return f"commands from pages of {origin} are not taken"
    if fetch_site is not None and fetch_site.lower() not in _SAME_SITE:
        return f"commands from pages of other sites ({fetch_site}) are not taken"
    return None


def token_refusal(authorization: str | None, token: str | None) -> str | None:
    """Why a command lacks its token, or ``None``.

    Args:
        authorization: the header ``Authorization``.
        token: what it has to carry; ``None`` where there is none.
    """
    if token is None:
        return None
    if authorization is None or not authorization.lower().startswith(_BEARER):
        return "commands need the token of dashboard.token_file: Authorization: Bearer TOKEN"
    given = authorization[len(_BEARER) :].strip()
    if not hmac.compare_digest(given.encode(), token.encode()):
        return "the token is not that of dashboard.token_file"
    return None


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


# 128 bits in hexadecimal digits; whoever asks may try as often as they like.
MIN_CHARACTERS = 32
_MAKE = "make one with: (umask 077; openssl rand -hex 24 > FILE)"


def read_token(cfg: DashboardConfig) -> str | None:
    """The token, without white space around it; ``None`` where none is configured.

    Raises:
        ConfigError: the file cannot be read, is open to others, or holds no token.
    """
    if not cfg.token_file:
        return None
    path = Path(cfg.token_file)
    try:
        mode = path.stat().st_mode
        token = path.read_text(encoding="ascii").strip()
    except OSError as error:
        raise ConfigError(f"dashboard.token_file: cannot read {path}: {error.strerror}; {_MAKE}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"dashboard.token_file: {path} is no text of ASCII characters; {_MAKE}") from error
    if mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise ConfigError(
            f"dashboard.token_file: {path} is open to others (mode {stat.S_IMODE(mode):04o}); chmod go= {path}"
        )
    if len(token) < MIN_CHARACTERS or not token.isprintable() or " " in token:
        raise ConfigError(
            f"dashboard.token_file: {path} must hold one word of at least {MIN_CHARACTERS} characters; {_MAKE}"
        )
    return token
