"""Synchronous clients of a running daemon with deadlines: its own channels, and HTTP by way of its dashboard.

    from ccatp.links.client import HttpClient, OperatorClient

    daemon = OperatorClient()
    print(daemon.status().state)
    daemon.abort()
    daemon.wait(lambda status: status.exit_status >= 0, timeout_s=600.0)

    page = HttpClient("http://127.0.0.1:7080")
    print(page.status()["trouble"])

Every request raises ``DaemonUnreachableError`` where no answer arrives in time and ``RefusedError`` where the daemon
refuses; both are ``ccatp.errors.CcatpError``, with a message of one line.
"""

import json
import os
import time
import urllib.error
import urllib.request
import uuid
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

import msgspec

from ccatp.errors import CcatpError, ConfigError, DaemonUnreachableError, ExitStatus, RefusedError
from ccatp.links.auth import read_pair, read_public
from ccatp.links.rpc import CurveClient, RequestFailed, request
from ccatp.links.runtime_dir import LOCK_FILE, is_held, runtime_dir_path
from ccatp.links.topics import MissionStatus

EmergencyKind = Literal["fire", "earthquake", "power", "weather", "operator"]
TIMEOUT_S = 10.0
PERIOD_S = 0.2
_T = TypeVar("_T")


class StillWaiting(CcatpError):
    """The awaited condition did not hold in time."""

    exit_status = ExitStatus.REFUSED


class Latched(msgspec.Struct, frozen=True):
    """An emergency that is in force; ``clear`` takes its ``id``."""

    id: str
    code: int


class Pong(msgspec.Struct, frozen=True):
    """The event code (0 normal, 1 near an edge, 2 aborted) and the age of its frame, ``None`` before the first."""

    code: int
    age_s: float | None = None


@dataclass(frozen=True, slots=True)
class ObservatoryClient:
    """The observatory channel of a daemon.

    ``OperatorClient.observatory`` makes one for a daemon on this machine, ``connect`` for one on another machine.
    """

    endpoint: str
    curve: CurveClient | None = None
    timeout_s: float = TIMEOUT_S

    @classmethod
    def connect(cls, endpoint: str, server_key: Path, key: Path, timeout_s: float = TIMEOUT_S) -> "ObservatoryClient":
        """A daemon on another machine, at ``tcp://HOST:PORT``, which lists the public half of the secret ``key``.

        ``ConfigError``: a key file cannot be used.
        """
        own = read_pair(key, "key")
        return cls(endpoint, CurveClient(read_public(server_key, "server key"), own), timeout_s)

    def emergency(self, kind: EmergencyKind, note: str = "", emergency_id: str | None = None) -> Latched:
        """Report an emergency: the robot drives to its base. The request is repeated until it is answered.

        ``emergency_id`` is a UUID, by default a new one; reporting the same one again has no effect.
        """
        payload = {"cmd": "emergency", "kind": kind, "id": emergency_id or str(uuid.uuid4()), "note": note}
        return _as(Latched, self.ask(payload))

    def clear(self, emergency_id: str) -> None:
        """End an emergency whose cause is gone; the robot must be at base or held."""
        self.ask({"cmd": "clear", "id": emergency_id})

    def ping(self) -> Pong:
        """Request the event code."""
        return _as(Pong, self.ask({"cmd": "ping"}))

    def ask(self, payload: Mapping[str, object]) -> dict[str, Any]:
        """Send a request as it is; returns the whole answer."""
        return _exchange(self.endpoint, payload, self.timeout_s, self.curve, repeats=True)


class OperatorClient:
    """The operator channel of a daemon on this machine, by default in the default runtime directory.

    A pause is answered when the robot is at rest.
    """

    def __init__(self, runtime_dir: Path | None = None, timeout_s: float = TIMEOUT_S) -> None:
        self.runtime_dir = runtime_dir_path(str(runtime_dir or ""), os.environ)
        self.timeout_s = timeout_s

    @property
    def observatory(self) -> ObservatoryClient:
        """The observatory channel of the same daemon."""
        return ObservatoryClient(self._endpoint("emergency"), timeout_s=self.timeout_s)

    def status(self) -> MissionStatus:
        """The status of the mission."""
        return self._order("status")

    def pause(self) -> MissionStatus:
        """Hold the robot where it is, until ``resume``; returns when it is at rest."""
        return self._order("pause")

    def resume(self) -> MissionStatus:
        """Continue after ``pause``."""
        return self._order("resume")

    def abort(self) -> MissionStatus:
        """End the survey; the robot drives to its base."""
        return self._order("abort")

    def stop(self) -> MissionStatus:
        """Hold the wheels where the robot is, save, and end the daemon."""
        return self._order("stop")

    def wait(
        self, is_there: Callable[[MissionStatus], bool], timeout_s: float, period_s: float = PERIOD_S
    ) -> MissionStatus:
        """Poll the status until a condition holds; ``StillWaiting`` where it does not in time."""
        deadline_s = time.monotonic() + timeout_s
        while not is_there(status := self.status()):
            left_s = deadline_s - time.monotonic()
            if left_s <= 0.0:
                raise StillWaiting(
                    f"not within {timeout_s:g} s: the mission is {status.state}, {status.done} points done"
                )
            time.sleep(min(period_s, left_s))
        return status

    def acknowledge(self, alarm: str, by: str = "") -> MissionStatus:
        """Acknowledge an alarm of the status by its name; ``by``: who."""
        return _as(MissionStatus, self.ask("acknowledge", name=alarm, by=by).get("status"))

    def ask(self, cmd: str, **fields: str) -> dict[str, Any]:
        """Send a command as it is; returns the whole answer."""
        return _exchange(self._endpoint("control"), {"cmd": cmd, **fields}, self.timeout_s, has_ended=self._has_ended)

    def _order(self, cmd: str) -> MissionStatus:
        return _as(MissionStatus, self.ask(cmd).get("status"))

    def _endpoint(self, channel: str) -> str:
        if self._has_ended() or not (self.runtime_dir / channel).exists():
            raise DaemonUnreachableError(
                f"no daemon in {self.runtime_dir}; start one with ccatp run, or name its folder with --runtime-dir"
            )
        return f"ipc://{self.runtime_dir / channel}"

    def _has_ended(self) -> bool:
        return is_held(self.runtime_dir / LOCK_FILE) is False


def _exchange(
    endpoint: str,
    payload: Mapping[str, object],
    timeout_s: float,
    curve: CurveClient | None = None,
    *,
    repeats: bool = False,
    has_ended: Callable[[], bool] = lambda: False,
) -> dict[str, Any]:
    """One request and its answer, as by ``ccatp.links.rpc.request``; ``RefusedError`` where the daemon refuses.

    An answer to an emergency that does not confirm that it is in force is a ``RequestFailed``.
    """
    reply = request(endpoint, json.dumps(payload).encode(), timeout_s, curve, repeats=repeats, has_ended=has_ended)
    if reply.get("ok") is not True:
        raise RefusedError(f"{payload.get('cmd')} refused: {reply.get('error', 'no reason given')}")
    if payload.get("cmd") == "emergency":
        # Only an answer that names this emergency counts as its confirmation.
        is_named, latched = reply.get("id") == payload["id"], reply.get("latched")
        if is_named and latched is False:
            raise RequestFailed(
                "emergency not in force: the one with that id was cleared; report another with an id of its own"
            )
        if not is_named or latched is not True:
            raise RequestFailed(
                f"{endpoint}: something answers there, but not that this emergency is in force; "
                "is it a daemon of ccatp?"
            )
    return reply


def _as(kind: type[_T], found: object) -> _T:
    try:
        return msgspec.convert(found, kind)
    except msgspec.ValidationError as error:
        raise RequestFailed(
            f"the daemon's answer is not what was asked for: {error}; is it of another version?"
        ) from error


MAX_BYTES = 1 << 20


@dataclass(frozen=True, slots=True)
class HttpClient:
    """A dashboard at ``http://HOST:PORT``; commands need a ``token``.

    ``ConfigError``: the URL is not one of HTTP.
    """

    url: str
    token: str = ""
    timeout_s: float = TIMEOUT_S

    def __post_init__(self) -> None:
        if not self.url.startswith(("http://", "https://")):
            raise ConfigError(f"{self.url!r} is no page; name it like http://127.0.0.1:7080")

    def status(self) -> dict[str, Any]:
        """The state that the page shows."""
        return self._ask("GET", "status")

    def is_healthy(self) -> bool:
        """Whether the daemon runs without a fault of its processes or its robot link."""
        try:
            self._ask("GET", "healthz")
        except RefusedError:
            return False
        return True

    def pause(self) -> None:
        """Hold the robot where it is, until ``resume``; returns when it is at rest."""
        self._ask("POST", "pause")

    def resume(self) -> None:
        """Continue after ``pause``."""
        self._ask("POST", "resume")

    def abort(self) -> None:
        """End the survey; the robot drives to its base."""
        self._ask("POST", "abort")

    def stop(self) -> None:
        """Hold the wheels where the robot is, save, and end the daemon."""
        self._ask("POST", "stop")

    def _ask(self, method: str, name: str) -> dict[str, Any]:
        where = f"{self.url.rstrip('/')}/{name}"
        headers = {"authorization": f"Bearer {self.token}"} if self.token else {}
        question = urllib.request.Request(where, method=method, headers=headers)  # noqa: S310 - http, see above
        try:
            with urllib.request.urlopen(question, timeout=self.timeout_s) as reply:  # noqa: S310 - the same
                text = reply.read(MAX_BYTES)
        except urllib.error.HTTPError as error:
            with error:
                raise RefusedError(f"{name} refused ({error.code}): {_message(error.read(MAX_BYTES))}") from error
        except (urllib.error.URLError, TimeoutError, ConnectionError) as error:
            why = getattr(error, "reason", error)
            raise DaemonUnreachableError(f"no answer from {where}: {why}; is ccatp dashboard running there?") from error
        try:
            found = json.loads(text)
        except ValueError as error:
            raise DaemonUnreachableError(f"{where}: the answer is no JSON; is this a ccatp dashboard?") from error
        if not isinstance(found, dict):
            raise DaemonUnreachableError(f"{where}: the answer is no object; is this a ccatp dashboard?")
        return found


def _message(text: bytes) -> str:
    try:
        found = json.loads(text)
        return str(found["message"])
    except (ValueError, KeyError, TypeError):
        return text.decode("utf-8", "replace")[:200]
