"""Who may ask, and who may command."""

import pytest

from ccatp.report.dashboard.access import host_refusal, origin_refusal, token_refusal

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


@pytest.mark.parametrize(
    ("origin", "site"),
    [(None, None), ("http://127.0.0.1:7080", "same-origin"), ("https://127.0.0.1:7080", None), (None, "none")],
)
def test_our_own_page_and_programs_command(origin: str | None, site: str | None) -> None:
    assert origin_refusal(origin, site, "127.0.0.1:7080") is None


@pytest.mark.parametrize(
    ("origin", "site", "why"),
    [
        ("http://evil.example", None, "commands from pages of http://evil.example are not taken"),
        ("null", None, "commands from pages of null are not taken"),
        ("http://127.0.0.1:9999", None, "commands from pages of http://127.0.0.1:9999 are not taken"),
        ("http://127.0.0.1:7080.evil.org", None, "commands from pages of http://127.0.0.1:7080.evil.org are not taken"),
        (None, "cross-site", "commands from pages of other sites (cross-site) are not taken"),
        ("http://127.0.0.1:7080", "same-site", "commands from pages of other sites (same-site) are not taken"),
    ],
)  # fmt: skip
def test_pages_of_others_do_not_command(origin: str | None, site: str | None, why: str) -> None:
    assert origin_refusal(origin, site, "127.0.0.1:7080") == why


def test_the_token() -> None:
    assert token_refusal(None, None) is None
    assert token_refusal(f"Bearer {TOKEN}", TOKEN) is None
    assert token_refusal(f"bearer  {TOKEN} ", TOKEN) is None
    for none in (None, "", TOKEN, f"Basic {TOKEN}"):
        refusal = token_refusal(none, TOKEN)
        assert refusal == "commands need the token of dashboard.token_file: Authorization: Bearer TOKEN"
    for wrong in ("Bearer ", f"Bearer {TOKEN}x", f"Bearer {TOKEN[:-1]}", "Bearer é"):
        assert token_refusal(wrong, TOKEN) == "the token is not that of dashboard.token_file"
