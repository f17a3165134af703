"""Edge. The same small client over HTTP, for a daemon on another machine, by way of its dashboard.

from ccatp.http_client import HttpClient

page = HttpClient("http://127.0.0.1:7080")
print(page.status()["trouble"])
page.abort()
"""

import json
import urllib.error
import urllib.request
from dataclasses import dataclass
from typing import Any

from ccatp.errors import ConfigError, RefusedError, UnreachableError

TIMEOUT_S = 10.0
MAX_BYTES = 1 << 20


@dataclass(frozen=True, slots=True)
class HttpClient:
    """A dashboard.

    Attributes:
        url: of the page, ``http://HOST:PORT``.
        token: that commands have to carry where the page is open to a network.
        timeout_s: longest wait for an answer; a pause is answered when the robot is at rest.
    """

    url: str
    token: str = ""
    timeout_s: float = TIMEOUT_S

    def __post_init__(self) -> None:
        """Refuse what is no page.

        Raises:
            ConfigError: the URL is not one of HTTP.
        """
        if not self.url.startswith(("http://", "https://")):
            raise ConfigError(f"{self.url!r} is no page; name it like http://127.0.0.1:7080")

    def status(self) -> dict[str, Any]:
        """What the page shows.

        Raises:
            UnreachableError: nobody answers in time.
        """
        return self._ask("GET", "status")

    def is_healthy(self) -> bool:
        """Whether the daemon is there and well.

        Raises:
            UnreachableError: not even the dashboard answers.
        """
        try:
            self._ask("GET", "healthz")
        except RefusedError:
            return False
        return True

    def pause(self) -> None:
        """Hold the robot where it is, until ``resume``; returns when it is at rest.

        Raises:
            RefusedError: the daemon said no, and why.
            UnreachableError: nobody answers in time.
        """
        self._ask("POST", "pause")

    def resume(self) -> None:
        """Carry on after ``pause``."""
        self._ask("POST", "resume")

    def abort(self) -> None:
        """Give up the survey; the robot drives to its base."""
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
            raise UnreachableError(f"no answer from {where}: {why}; is ccatp dashboard running there?") from error
        try:
            found = json.loads(text)
        except ValueError as error:
            raise UnreachableError(f"{where}: the answer is no JSON; is this a ccatp dashboard?") from error
        if not isinstance(found, dict):
            raise UnreachableError(f"{where}: the answer is no object; is this a ccatp dashboard?")
        return found


def _message(text: bytes) -> str:
    """What the page says to a refusal."""
    try:
        found = json.loads(text)
        return str(found["message"])
    except (ValueError, KeyError, TypeError):
        return text.decode("utf-8", "replace")[:200]
