"""Edge. The token that commands over HTTP have to carry."""

import stat
from pathlib import Path

from ccatp.config.models import DashboardConfig
from ccatp.errors import ConfigError

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
