"""The file with the token."""

from pathlib import Path

import pytest

from ccatp.config.models import Config
from ccatp.errors import ConfigError
from ccatp.report.dashboard.access import read_token

TOKEN = "0123456789abcdef0123456789abcdef"


def test_none_is_configured(config: Config) -> None:
    assert read_token(config.dashboard) is None


def test_a_token(config: Config, tmp_path: Path) -> None:
    path = tmp_path / "token"
    path.write_text(f"{TOKEN}\n")
    path.chmod(0o600)
    assert read_token(config.dashboard.model_copy(update={"token_file": str(path)})) == TOKEN


@pytest.mark.parametrize(
    ("content", "mode", "why"),
    [
        (None, 0, r"dashboard\.token_file: cannot read .*token: No such file or directory; make one with"),
        (TOKEN.encode(), 0o644, r"open to others \(mode 0644\); chmod go= "),
        (TOKEN[1:].encode(), 0o600, "must hold one word of at least 32 characters; make one with"),
        (b"two words of more than thirty characters", 0o600, "must hold one word of at least 32 characters"),
        (b"\xff" * 40, 0o600, "is no text of ASCII characters; make one with"),
    ],
)
def test_what_is_no_token(config: Config, tmp_path: Path, content: bytes | None, mode: int, why: str) -> None:
    path = tmp_path / "token"
    if content is not None:
        path.write_bytes(content)
        path.chmod(mode)
    with pytest.raises(ConfigError, match=why):
        read_token(config.dashboard.model_copy(update={"token_file": str(path)}))
