"""Tests of the client: what it asks over real sockets, and what it makes of the answers."""

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from ccatp.errors import DaemonUnreachableError, RefusedError
from ccatp.links.client import Latched, OperatorClient, Pong, StillWaiting
from ccatp.links.topics import MissionStatus
from tests.unit.serving import serving

NO_STATUS = MissionStatus(seq=-1, t_s=0.0, state="")


@pytest.fixture
def folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="ccatp-") as path:  # short: unix sockets take no long one
        yield Path(path)


def status(**fields: object) -> dict[str, Any]:
    return {"ok": True, "status": {**msgspec.to_builtins(NO_STATUS), **fields}}


def test_commands_and_typed_answers(folder: Path) -> None:
    with serving(folder, "control", lambda request: status(state=request["cmd"], done=3)) as asked:
        daemon = OperatorClient(folder)
        for order in (daemon.status, daemon.pause, daemon.resume, daemon.abort, daemon.stop):
            found = order()
            assert (found.state, found.done) == (order.__name__, 3)
    assert [request["cmd"] for request in asked] == ["status", "pause", "resume", "abort", "stop"]


def test_a_refusal_says_why(folder: Path) -> None:
    with (
        serving(folder, "control", lambda _: {"ok": False, "error": "nothing is paused"}),
        pytest.raises(RefusedError, match="resume refused: nothing is paused"),
    ):
        OperatorClient(folder).resume()


def test_nobody_there(folder: Path) -> None:
    with pytest.raises(DaemonUnreachableError, match=r"no daemon in .*; start one with ccatp run"):
        OperatorClient(folder).status()
    (folder / "control").touch()
    with pytest.raises(DaemonUnreachableError, match=r"no answer from .* within 0\.1 s"):
        OperatorClient(folder, timeout_s=0.1).status()


def test_an_answer_of_another_shape_is_told(folder: Path) -> None:
    with (
        serving(folder, "control", lambda _: {"ok": True, "status": {"state": 7}}),
        pytest.raises(DaemonUnreachableError, match="not what was asked for"),
    ):
        OperatorClient(folder).status()


def test_waiting(folder: Path) -> None:
    done = iter(range(100))
    with serving(folder, "control", lambda _: status(done=next(done), total=9, state="driving")):
        daemon = OperatorClient(folder)
        assert daemon.wait(lambda found: found.done >= 3, timeout_s=20.0, period_s=0.001).done == 3
        begin = time.monotonic()
        with pytest.raises(StillWaiting, match=r"not within 0\.05 s: the mission is driving, \d+ points done"):
            daemon.wait(lambda _: False, timeout_s=0.05, period_s=0.01)
        assert time.monotonic() - begin >= 0.05


def test_observatory(folder: Path) -> None:
    def answer(request: dict[str, Any]) -> dict[str, Any]:
        if request["cmd"] == "ping":
            return {"ok": True, "code": 1, "age_s": None}
        if request["cmd"] == "clear":
            return {"ok": False, "id": request["id"], "error": "the robot moves"}
        return {"ok": True, "id": request["id"], "latched": True, "code": 2}

    with serving(folder, "emergency", answer) as asked:
        observatory = OperatorClient(folder).observatory
        assert observatory.ping() == Pong(1, None)
        latched = observatory.emergency("fire", "smoke")
        assert latched == Latched(latched.id, 2)
        assert observatory.emergency("fire", emergency_id=latched.id).id == latched.id
        with pytest.raises(RefusedError, match="clear refused: the robot moves"):
            observatory.clear(latched.id)
    kinds = [(request["kind"], request["note"]) for request in asked if request["cmd"] == "emergency"]
    assert kinds[0] == ("fire", "smoke")
