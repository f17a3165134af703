"""Who may read and who may command, and the file with the token."""

from pathlib import Path

import pytest

from ccatp.config.models import Config
from ccatp.errors import ConfigError
from ccatp.report.dashboard.access import command_refusal, host_refusal, read_token

TOKEN = "0123456789abcdef0123456789abcdef"
OURS = ("localhost", "localhost:7080", "LOCALHOST:1", "127.0.0.1:7080", "192.168.1.20", "[::1]:80", "m1.local:80")
# Names that may be bent to our address.
OTHERS = ("evil.example:7080", "localhost.evil.example", "127.0.0.1.evil.example", "m1.local.evil.org")
NONE = (None, "", "a b", "user@localhost", "localhost:x", "localhost/", "[::1", "::1")


@pytest.mark.parametrize("host", [*OURS, *OTHERS, *NONE])
def test_hosts(host: str | None) -> None:
    refusal = host_refusal(host, ["M1.local"])
    if host in OURS:
        assert refusal is None
    elif host in NONE:
        assert refusal == "the Host header is missing or no host"
    else:
        assert str(refusal).endswith("ask by address, or add the name to dashboard.host_names")


HOST = {"host": "127.0.0.1:7080"}
SITE = "sec-fetch-site"


@pytest.mark.parametrize(
    ("headers", "why"),
    [
        ({}, None),
        ({"origin": "http://127.0.0.1:7080", SITE: "same-origin"}, None),
        ({"origin": "https://127.0.0.1:7080"}, None),
        ({SITE: "none"}, None),
        ({"origin": "http://evil.example"}, "commands from pages of http://evil.example are not taken"),
        ({"origin": "null"}, "commands from pages of null are not taken"),
        ({"origin": "http://127.0.0.1:9999"}, "commands from pages of http://127.0.0.1:9999 are not taken"),
        ({"origin": "http://127.0.0.1:7080.evil.org"}, "pages of http://127.0.0.1:7080.evil.org are not taken"),
        ({SITE: "cross-site"}, "commands from pages of other sites (cross-site) are not taken"),
        ({"origin": "http://127.0.0.1:7080", SITE: "same-site"}, "other sites (same-site) are not taken"),
    ],
)
def test_the_own_page_and_programs_command_and_pages_of_others_do_not(headers: dict[str, str], why: str | None) -> None:
    refusal = command_refusal(HOST | headers, None)
    if why is None:
        assert refusal is None
    else:
        assert refusal is not None
        assert (refusal.http_status, refusal.message.endswith(why)) == (403, True)


@pytest.mark.parametrize(
    ("authorization", "why"),
    [
        *((right, None) for right in (f"Bearer {TOKEN}", f"bearer  {TOKEN} ")),
        *((none, "commands need the token") for none in ("", TOKEN, "bearer", f"Basic {TOKEN}")),
        *((f"Bearer {wrong}", "the token is not that of") for wrong in ("", f"{TOKEN}x", TOKEN[:-1], "é")),
    ],
)
def test_tokens(authorization: str, why: str | None) -> None:
    refusal = command_refusal(HOST | {"authorization": authorization}, TOKEN)
    if why is None:
        assert refusal is None
    else:
        assert refusal is not None
        assert (refusal.http_status, refusal.message.startswith(why)) == (401, True)


@pytest.mark.parametrize(
    ("content", "mode", "why"),
    [
        (f"{TOKEN}\n".encode(), 0o600, ""),
        (None, 0, r"dashboard\.token_file: cannot read .*token: No such file or directory; make one with"),
        (TOKEN.encode(), 0o644, r"open to others \(mode 0644\); chmod go= "),
        (TOKEN[1:].encode(), 0o600, "must hold one word of at least 32 characters; make one with"),
        (b"two words of more than thirty characters", 0o600, "must hold one word of at least 32 characters"),
        (b"\xff" * 40, 0o600, "is no text of ASCII characters; make one with"),
    ],
)
def test_the_file_of_the_token(config: Config, tmp_path: Path, content: bytes | None, mode: int, why: str) -> None:
    path = tmp_path / "token"
    if content is not None:
        path.write_bytes(content)
        path.chmod(mode)
    cfg = config.dashboard.model_copy(update={"token_file": str(path)})
    if not why:
        assert (read_token(cfg), read_token(config.dashboard)) == (TOKEN, None)
        return
    with pytest.raises(ConfigError, match=why):
        read_token(cfg)
