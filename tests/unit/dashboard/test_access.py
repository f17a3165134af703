"""Who may read and who may command, and the file with the token."""

from pathlib import Path

import pytest

from ccatp.config.models import Config
from ccatp.errors import ConfigError
from ccatp.report.dashboard.access import command_refusal, host_refusal, read_token

TOKEN = "0123456789abcdef0123456789abcdef"


@pytest.mark.parametrize(
    "host",
    ["localhost", "localhost:7080", "LOCALHOST:1", "127.0.0.1:7080", "192.168.1.20", "[::1]:80", "m1.local:80"],
)  # fmt: skip
def test_our_names(host: str) -> None:
    assert host_refusal(host, ["M1.local"]) is None


@pytest.mark.parametrize(
    "host", ["evil.example:7080", "localhost.evil.example", "127.0.0.1.evil.example", "m1.local.evil.org"]
)  # fmt: skip
def test_a_name_that_may_be_bent_to_our_address_is_not_served(host: str) -> None:
    refusal = host_refusal(host, ["m1.local"])
    assert refusal is not None
    assert refusal.endswith("ask by address, or add the name to dashboard.host_names")


@pytest.mark.parametrize("host", [None, "", "a b", "user@localhost", "localhost:x", "localhost/", "[::1", "::1"])
def test_what_is_no_host(host: str | None) -> None:
    assert host_refusal(host, []) == "the Host header is missing or no host"


HOST = {"host": "127.0.0.1:7080"}
SITE = "sec-fetch-site"


@pytest.mark.parametrize(
    "headers",
    [
        {},
        {"origin": "http://127.0.0.1:7080", SITE: "same-origin"},
        {"origin": "https://127.0.0.1:7080"},
        {SITE: "none"},
    ],
)
def test_the_own_page_and_programs_command(headers: dict[str, str]) -> None:
    assert command_refusal(HOST | headers, None) is None


@pytest.mark.parametrize(
    ("headers", "why"),
    [
        ({"origin": "http://evil.example"}, "commands from pages of http://evil.example are not taken"),
        ({"origin": "null"}, "commands from pages of null are not taken"),
        ({"origin": "http://127.0.0.1:9999"}, "commands from pages of http://127.0.0.1:9999 are not taken"),
        ({"origin": "http://127.0.0.1:7080.evil.org"}, "pages of http://127.0.0.1:7080.evil.org are not taken"),
        ({SITE: "cross-site"}, "commands from pages of other sites (cross-site) are not taken"),
        ({"origin": "http://127.0.0.1:7080", SITE: "same-site"}, "other sites (same-site) are not taken"),
    ],
)
def test_pages_of_others_do_not_command(headers: dict[str, str], why: str) -> None:
    refusal = command_refusal(HOST | headers, None)
    assert refusal is not None
    assert refusal.http_status == 403
    assert refusal.message.endswith(why)


@pytest.mark.parametrize(
    ("authorization", "why"),
    [
        *((none, "commands need the token") for none in ("", TOKEN, "bearer", f"Basic {TOKEN}")),
        *((f"Bearer {wrong}", "the token is not that of") for wrong in ("", f"{TOKEN}x", TOKEN[:-1], "é")),
    ],
)
def test_a_wrong_token(authorization: str, why: str) -> None:
    refusal = command_refusal(HOST | {"authorization": authorization}, TOKEN)
    assert refusal is not None
    assert (refusal.http_status, refusal.message.startswith(why)) == (401, True)


@pytest.mark.parametrize("authorization", [f"Bearer {TOKEN}", f"bearer  {TOKEN} "])
def test_the_token(authorization: str) -> None:
    assert command_refusal(HOST | {"authorization": authorization}, TOKEN) is None
    assert command_refusal(HOST, TOKEN) is not None


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
