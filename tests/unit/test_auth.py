"""Keys and the list of clients."""

import pytest
import zmq
from hypothesis import given
from hypothesis import strategies as st
from zmq.utils import z85

from ccatp.links.auth import AuthorizedClient, BadAccess, Role, decode_key, parse_clients

KEY = b"k" * 32
TEXT = z85.encode(KEY).decode()


@given(st.binary(min_size=32, max_size=32))
def test_keys_are_z85(key: bytes) -> None:
    assert decode_key(z85.encode(key).decode()) == key


@pytest.mark.parametrize("text", ["", TEXT[:-1], TEXT + "0", TEXT[:-1] + '"', TEXT[:-1] + "é"])
def test_what_is_no_key(text: str) -> None:
    with pytest.raises(BadAccess, match="a key has 40 characters of Z85"):
        decode_key(text)


def test_five_characters_may_stand_for_too_much() -> None:
    with pytest.raises(BadAccess, match="more than 32 bytes"):
        decode_key("#####" + TEXT[5:])


def test_a_list_of_clients() -> None:
    other = zmq.curve_keypair()[0].decode()
    text = f'[clients.a]\npublic_key = "{TEXT}"\nrole = "raise"\n[clients.b]\npublic_key = "{other}"\nrole = "clear"\n'
    clients = parse_clients(text)
    assert clients == {KEY: AuthorizedClient("a", Role.RAISE), decode_key(other): AuthorizedClient("b", Role.CLEAR)}
    assert parse_clients("# nobody\n") == {}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("clients = [", "is not TOML"),
        ("[client.a]", "has client, but only tables"),
        ("clients = 3", "must be tables"),
        ("[clients]\na = 3", "clients.a must have public_key and role"),
        (f'[clients.a]\npublic_key = "{TEXT}"', "clients.a must have public_key and role"),
        (f'[clients.a]\npublic_key = "{TEXT}"\nrole = "clear"\nip = "x"', "nothing else"),
        (f'[clients.a]\npublic_key = "{TEXT}"\nrole = "king"', "'king' must be raise or clear"),
        (f'[clients.a]\npublic_key = "{TEXT}"\nrole = []', r"\[\] must be raise or clear"),
        ('[clients.a]\npublic_key = "x"\nrole = "clear"', "clients.a.public_key: a key has 40"),
        (
            f'[clients.a]\npublic_key = "{TEXT}"\nrole = "raise"\n[clients.b]\npublic_key = "{TEXT}"\nrole = "clear"',
            "a and b have the same key",
        ),
    ],
)
def test_lists_that_count_for_nothing(text: str, message: str) -> None:
    with pytest.raises(BadAccess, match=message):
        parse_clients(text)
