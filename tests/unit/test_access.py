"""Keys, the list of clients, and whom ZAP admits."""

import re

import pytest
import zmq
from hypothesis import given
from hypothesis import strategies as st
from zmq.utils import z85

from ccatp.links.auth import Admission, AuthorizedClient, BadAccess, Role, answer_zap, decode_key, parse_clients

KEY = b"k" * 32
TEXT = z85.encode(KEY).decode()
LISTED = {KEY: AuthorizedClient("observatory", Role.RAISE)}
REQUEST = [b"1.0", b"7", b"ccatp", b"10.0.0.1", b"", b"CURVE", KEY]


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


def test_the_listed_are_admitted_under_their_key() -> None:
    reply = [b"1.0", b"7", b"200", b"OK", KEY.hex().encode(), b""]
    assert answer_zap(REQUEST, "ccatp", LISTED) == Admission(reply, "")


@pytest.mark.parametrize(
    ("frames", "status", "why"),
    [
        ([*REQUEST[:6], b"x" * 32], b"400", "10.0.0.1: key 7878.* is not on the list"),
        ([*REQUEST[:2], b"other", *REQUEST[3:]], b"400", "another domain"),
        ([*REQUEST[:5], b"NULL", KEY], b"400", "no CURVE key"),
        ([*REQUEST[:5], b"PLAIN", KEY], b"400", "no CURVE key"),
        ([*REQUEST[:6], KEY[:-1]], b"400", "no CURVE key"),
        ([*REQUEST[:6]], b"500", "not a request of ZAP"),
        ([*REQUEST, b"more"], b"500", "not a request of ZAP"),
        ([b"2.0", *REQUEST[1:]], b"500", "not a request of ZAP"),
        ([], b"500", "not a request of ZAP"),
    ],
)
def test_nobody_else_is(frames: list[bytes], status: bytes, why: str) -> None:
    reply, refusal = answer_zap(frames, "ccatp", LISTED)
    assert reply[2] == status
    assert reply[4] == b""
    assert re.search(why, refusal)


def test_an_empty_list_admits_nobody() -> None:
    assert answer_zap(REQUEST, "ccatp", {}).reply[2] == b"400"
