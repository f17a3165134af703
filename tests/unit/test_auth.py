"""The list of clients of the observatory channel."""

from pathlib import Path

import pytest
import zmq
from hypothesis import given
from hypothesis import strategies as st
from zmq.utils import z85

from ccatp.errors import ConfigError
from ccatp.links.auth import AuthorizedClient, check_key, read_clients

KEY = z85.encode(b"k" * 32).decode()
OTHER = zmq.curve_keypair()[0].decode()
ENTRY = f'[clients.a]\npublic_key = "{KEY}"\nrole = "raise"\n'
NO_KEY = "is no key: a key has 40 characters of Z85"


@given(st.binary(min_size=32, max_size=32))
def test_keys_are_z85(key: bytes) -> None:
    assert check_key(z85.encode(key).decode()) == ""


@pytest.mark.parametrize("text", ["", KEY[:-1], KEY + "0", KEY[:-1] + '"', KEY[:-1] + "é"])
def test_what_is_no_key(text: str) -> None:
    assert check_key(text).startswith(NO_KEY)
    assert "more than 32 bytes" in check_key("#####" + KEY[5:])


def test_a_list_of_clients(tmp_path: Path) -> None:
    path = tmp_path / "clients.toml"
    path.write_text(f'{ENTRY}[clients.b]\npublic_key = "{OTHER}"\nrole = "clear"\n')
    assert read_clients(path, "list") == {KEY: AuthorizedClient("a", "raise"), OTHER: AuthorizedClient("b", "clear")}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("# nobody\n", "lists no client; add a table"),
        ("clients = [", "1: is not TOML"),
        ("[client.a]", r"1: client is unknown; did you mean clients\?"),
        ("clients = 3", "1: clients = 3 must be a section"),
        ("[clients]\na = 3", "2: clients.a = 3 must be a section"),
        (f'[clients.a]\npublic_key = "{KEY}"', "1: clients.a.role is missing"),
        (f'{ENTRY}ip = "x"', "4: clients.a.ip is unknown; known here: public_key, role"),
        (ENTRY.replace("raise", "king"), "3: clients.a.role = \"king\" must be 'raise' or 'clear'"),
        (ENTRY.replace('"raise"', "[]"), r"3: clients.a.role = \[\] must be 'raise' or 'clear'"),
        (ENTRY.replace(KEY, "x"), f"2: clients.a.public_key {NO_KEY}, this one 1"),
        (ENTRY + ENTRY.replace(".a]", ".b]"), "5: clients.b.public_key is that of a, too"),
    ],
)
def test_lists_that_count_for_nothing(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "clients.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=f"^list: {path}:?{message}|^list: {path} {message}"):
        read_clients(path, "list")
