"""Keys and clients of the observatory channel, the dashboard's options, and the client in Python."""

import asyncio
import json
import os
import stat
import threading
import time
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import pytest
import zmq
import zmq.asyncio
import zmq.auth
from hypothesis import given
from hypothesis import strategies as st
from zmq.utils import z85

from ccatp.cli import main
from ccatp.config.files import read_key
from ccatp.config.load import dump_config, load_config
from ccatp.errors import ConfigError, DaemonUnreachableError, RefusedError
from ccatp.links.auth import AuthorizedClient, ClientsFile, check_key, read_clients, read_pair, read_public
from ccatp.links.client import HttpClient, Latched, OperatorClient, Pong, StillWaiting
from ccatp.links.rpc import Router
from ccatp.links.topics import MissionStatus
from tests.support.command import answered, printed, refused
from tests.support.http_server import answering

# -- ``ccatp keys``: what is written, and what is never shown ---------------------------------------------------------


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "keys"


def generate(folder: Path, *more: str) -> int:
    return main(["keys", "generate", "--dir", str(folder), *more])


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def test_the_keys_of_a_daemon(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    old = os.umask(0)  # the modes are ours, not those of the shell
    try:
        assert generate(folder) == 0
    finally:
        os.umask(old)
    names = {path.name: mode(path) for path in folder.iterdir()}
    assert names == {
        "ccatp.key": 0o644,
        "ccatp.key_secret": 0o600,
        "ccatp-robot.key_secret": 0o600,
        "ccatp-clients.toml": 0o600,
    }
    assert mode(folder) == 0o700
    pair = read_pair(folder / "ccatp.key_secret", "--key")
    assert zmq.auth.load_certificate(str(folder / "ccatp.key_secret")) == tuple(pair)
    assert zmq.auth.load_certificate(str(folder / "ccatp.key")) == (pair.public, None)
    link = read_key(str(folder / "ccatp-robot.key_secret"))
    assert link is not None
    assert len(bytes.fromhex(link.decode())) == 32
    out, err = capsys.readouterr()
    for secret in (pair.secret.decode(), link.decode()):
        assert secret not in out + err
    assert str(folder / "ccatp.key_secret") in out
    assert pair.secret.decode() not in repr(pair)


def test_what_is_printed_is_a_configuration_without_secrets(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert generate(folder) == 0
    (folder / "mine.toml").write_text(capsys.readouterr().out.split("at theirs):\n\n")[1])
    cfg = load_config(folder / "mine.toml")
    assert cfg.observatory.key_file == str(folder / "ccatp.key_secret")
    dumped = dump_config(cfg)
    assert all(file.name in dumped for file in folder.glob("*_secret"))
    assert read_pair(folder / "ccatp.key_secret", "x").secret.decode() not in dumped
    assert (folder / "ccatp-robot.key_secret").read_text().strip() not in dumped


def test_the_keys_of_a_client_and_its_lines_for_the_list(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert generate(folder, "--client", "--name", "observatory") == 0
    assert {path.name for path in folder.iterdir()} == {"observatory.key", "observatory.key_secret"}
    out = capsys.readouterr().out
    lines = "[clients" + out.split("[clients")[1].split("\n\n")[0]
    key = read_public(folder / "observatory.key", "x").decode()
    assert tomllib.loads(lines) == {"clients": {"observatory": {"public_key": key, "role": "raise"}}}
    (folder / "list.toml").write_text(lines)
    assert [client.name for client in read_clients(folder / "list.toml", "x").values()] == ["observatory"]


def test_keys_are_replaced_by_force_alone_and_the_list_never(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert generate(folder) == 0
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    capsys.readouterr()
    why = f"{folder}/ccatp.key exists; choose another --name, or replace it with --force\n"
    assert refused(capsys, "keys", "generate", "--dir", folder) == f"ccatp: --dir: {why}"
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    (folder / "ccatp-clients.toml").write_text("# mine\n")
    assert generate(folder, "--force") == 0
    after = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert after.pop("ccatp-clients.toml") == b"# mine\n"
    assert all(after[name] != before[name] for name in after)
    assert mode(folder / "ccatp.key_secret") == 0o600


def test_one_of_the_files_is_enough_to_refuse_all(folder: Path) -> None:
    folder.mkdir(mode=0o700)
    (folder / "ccatp-robot.key_secret").write_text("mine")
    assert generate(folder) == 2
    assert {path.name: path.read_text() for path in folder.iterdir()} == {"ccatp-robot.key_secret": "mine"}


@pytest.mark.parametrize("name", ["", "a b", "../a", "a.b", "-a", "x" * 64])
def test_names_that_are_no_names(folder: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert generate(folder, f"--name={name}") == 2
    assert "letters, digits, - and _ only" in capsys.readouterr().err
    assert not folder.exists()


def test_a_folder_open_to_others_is_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder.mkdir()
    folder.chmod(0o750)
    assert generate(folder) == 2
    assert f"{folder} is open to others (mode 0750); chmod 700 {folder}\n" in capsys.readouterr().err
    assert not any(folder.iterdir())


def test_a_folder_that_takes_no_files(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    assert generate(folder) == 2
    assert "ccatp.key: cannot be written: No space left on device\n" in capsys.readouterr().err
    assert list(folder.iterdir()) == []


def test_show_public_shows_public_keys(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert generate(folder, "--name", "a") == generate(folder, "--name", "bcd") == 0
    capsys.readouterr()
    keys = {name: read_public(folder / f"{name}.key", "x").decode() for name in ("a", "bcd")}
    assert printed(capsys, "keys", "show-public", "--dir", folder) == f"a    {keys['a']}\nbcd  {keys['bcd']}\n"
    assert answered(capsys, "keys", "show-public", "--dir", folder, "--name", "a") == {"a": keys["a"]}
    assert "no c.key in" in refused(capsys, "keys", "show-public", "--dir", folder, "--name", "c")


def test_secret_files_that_are_refused(folder: Path) -> None:
    assert generate(folder) == 0
    secret, public, broken = folder / "ccatp.key_secret", folder / "ccatp.key", folder / "broken"
    text = secret.read_text()
    other_key = text.replace(read_public(public, "x").decode(), zmq.curve_keypair()[0].decode())
    broken.touch(mode=0o600)
    with pytest.raises(ConfigError, match=r"holds no public key; name the file that ends in \.key"):
        read_public(broken, "--server-key")
    with pytest.raises(ConfigError, match=r"--key: cannot read .*none: No such file or directory; make keys with"):
        read_pair(folder / "none", "--key")
    for content, message in (
        (public.read_text(), r"--key: .* holds no secret key; name the file that ends in \.key_secret"),
        (text.replace('secret-key = "', 'secret-key = "x'), r"a key has 40 characters of Z85, this one 41$"),
        (other_key, "public and secret key are no pair"),
        ("x" * 300_000, "is longer than 262144 bytes"),
    ):
        broken.write_text(content)
        with pytest.raises(ConfigError, match=message):
            read_pair(broken, "--key")
    secret.chmod(0o640)
    with pytest.raises(ConfigError, match=r"is open to others \(mode 0640\); chmod go= "):
        read_pair(secret, "--key")


def test_the_list_is_read_again_when_it_changes_and_a_bad_one_names_nobody(folder: Path) -> None:
    assert generate(folder) == 0
    path = folder / "ccatp-clients.toml"
    listed = ClientsFile(path, "observatory.clients_file")
    assert not listed.clients
    assert "observatory.clients_file: " in listed.trouble
    assert "lists no client; add a table" in listed.trouble
    key = read_public(folder / "ccatp.key", "x").decode()
    path.write_text(f'[clients.a]\npublic_key = "{key}"\nrole = "clear"\n')
    assert [client.name for client in listed.clients.values()] == ["a"]
    assert listed.trouble == ""
    for ruin, trouble in (
        (lambda: path.chmod(0o666), "is open to others"),
        (lambda: path.chmod(0o600), ""),
        (lambda: path.write_text("[clients.a]\n"), "clients.a.public_key is missing"),
        (path.unlink, "observatory.clients_file: cannot read"),
    ):
        ruin()
        assert bool(listed.clients) is not bool(trouble)
        assert trouble in listed.trouble


# -- the command ``ccatp dashboard``, where there is nothing to attach to ---------------------------------------------


def test_a_key_of_the_daemon_is_not_the_pages(capsys: pytest.CaptureFixture[str]) -> None:
    said = refused(capsys, "dashboard", "--set", "run.seed=2")
    assert "run.seed is no key of the page; the daemon runs with what it has" in said


# -- the list of clients -----------------------------------------------------------------------------------------------

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


# -- clients of a daemon in Python: over its sockets and its page ------------------------------------------------------


@contextmanager
def serving(
    runtime_dir: Path, channel: str, answer: Callable[[dict[str, Any]], dict[str, Any]]
) -> Iterator[list[dict[str, Any]]]:
    """A real ROUTER in a thread of its own; yields what it was asked."""
    asked: list[dict[str, Any]] = []
    ready, loop = threading.Event(), asyncio.new_event_loop()

    def handle(frame: bytes) -> bytes:
        asked.append(json.loads(frame))
        return json.dumps(answer(asked[-1])).encode()

    async def serve() -> None:
        context = zmq.asyncio.Context()
        try:
            async with Router(f"ipc://{runtime_dir / channel}", handle, context) as router:
                ready.set()
                await router.serve()
        finally:
            context.destroy(linger=0)

    task = loop.create_task(serve())

    def run() -> None:
        try:
            loop.run_until_complete(task)
        except asyncio.CancelledError:
            pass
        finally:
            loop.close()

    thread = threading.Thread(target=run)
    thread.start()
    assert ready.wait(10.0)
    try:
        yield asked
    finally:
        loop.call_soon_threadsafe(task.cancel)
        thread.join()


NO_STATUS = MissionStatus(seq=-1, t_s=0.0, state="")


def status(**fields: object) -> dict[str, Any]:
    return {"ok": True, "status": {**msgspec.to_builtins(NO_STATUS), **fields}}


def test_commands_and_typed_answers(runtime_dir: Path) -> None:
    with serving(runtime_dir, "control", lambda request: status(state=request["cmd"], done=3)) as asked:
        daemon = OperatorClient(runtime_dir)
        for order in (daemon.status, daemon.pause, daemon.resume, daemon.abort, daemon.stop):
            found = order()
            assert (found.state, found.done) == (order.__name__, 3)
    assert [request["cmd"] for request in asked] == ["status", "pause", "resume", "abort", "stop"]


def test_an_answer_of_another_shape_is_reported(runtime_dir: Path) -> None:
    with (
        serving(runtime_dir, "control", lambda _: {"ok": True, "status": {"state": 7}}),
        pytest.raises(DaemonUnreachableError, match="not what was asked for"),
    ):
        OperatorClient(runtime_dir).status()


def test_waiting(runtime_dir: Path) -> None:
    done = iter(range(100))
    with serving(runtime_dir, "control", lambda _: status(done=next(done), total=9, state="driving")):
        daemon = OperatorClient(runtime_dir)
        assert daemon.wait(lambda found: found.done >= 3, timeout_s=20.0, period_s=0.001).done == 3
        begin = time.monotonic()
        with pytest.raises(StillWaiting, match=r"not within 0\.05 s: the mission is driving, \d+ points done"):
            daemon.wait(lambda _: False, timeout_s=0.05, period_s=0.01)
        assert time.monotonic() - begin >= 0.05


def test_observatory(runtime_dir: Path) -> None:
    def answer(request: dict[str, Any]) -> dict[str, Any]:
        if request["cmd"] == "ping":
            return {"ok": True, "code": 1, "age_s": None}
        if request["cmd"] == "clear":
            return {"ok": False, "id": request["id"], "error": "the robot moves"}
        return {"ok": True, "id": request["id"], "latched": True, "code": 2}

    with serving(runtime_dir, "emergency", answer) as asked:
        observatory = OperatorClient(runtime_dir).observatory
        assert observatory.ping() == Pong(1, None)
        latched = observatory.emergency("fire", "smoke")
        assert latched == Latched(latched.id, 2)
        assert observatory.emergency("fire", emergency_id=latched.id).id == latched.id
        with pytest.raises(RefusedError, match="clear refused: the robot moves"):
            observatory.clear(latched.id)
    kinds = [(request["kind"], request["note"]) for request in asked if request["cmd"] == "emergency"]
    assert kinds[0] == ("fire", "smoke")


# -- the client over HTTP, against a server that answers otherwise than a dashboard -----------------------------------


@pytest.mark.parametrize(
    ("body", "reported"), [(b'{"status": "error", "message": "nothing is paused"}', "nothing is paused"), (b"no", "no")]
)
def test_a_refusal_of_the_page_says_why(body: bytes, reported: str) -> None:
    with answering(lambda method, *_: (409 if method == "POST" else 503, body)) as url:
        client = HttpClient(url)
        assert not client.is_healthy()
        for order in (client.pause, client.resume, client.abort, client.stop):
            with pytest.raises(RefusedError, match=rf"{order.__name__} refused \(409\): {reported}"):
                order()


def test_no_page_there(free_port: int) -> None:
    with pytest.raises(DaemonUnreachableError, match="is ccatp dashboard running there"):
        HttpClient(f"http://127.0.0.1:{free_port}").status()


@pytest.mark.parametrize(("body", "reported"), [(b"<html>", "is no JSON"), (b"[]", "is no object")])
def test_another_server_is_reported(body: bytes, reported: str) -> None:
    with answering(lambda *_: (200, body)) as url, pytest.raises(DaemonUnreachableError, match=reported):
        HttpClient(url).status()


def test_what_is_no_page_is_refused() -> None:
    with pytest.raises(ConfigError, match="is no page; name it like http"):
        HttpClient("file:///etc/passwd")
