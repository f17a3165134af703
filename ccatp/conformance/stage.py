"""Edge. What the stories are played on: connections to the server under test, joined or not."""

import time
from collections.abc import Callable
from contextlib import suppress
from typing import NamedTuple

from ccatp.conformance.link import Link, receive_any
from ccatp.conformance.reading import Message, read_message, shorten
from ccatp.conformance.verdict import Broken, NotApplicable, require
from ccatp.wire.robot import AUTH_HMAC, Join, Role, encode, join_mac

POLL_S = 0.05
# Numbers between two of these are free for messages that must be older or newer than others.
SEQ_STEP = 10


class Facts(NamedTuple):
    """What the stories need of the server's hello.

    Attributes:
        is_lockstep, frame_hz, ttl_s: as in the hello.
        needs_mac: a join needs a mac.
        wheel_radius_m, wheel_base_m, max_wheel_rad_s, fan_floor: of the robot.
    """

    is_lockstep: bool
    frame_hz: float
    ttl_s: float
    needs_mac: bool
    wheel_radius_m: float
    wheel_base_m: float
    max_wheel_rad_s: float
    fan_floor: float

    @property
    def frame_s(self) -> float:
        """Period of the frames."""
        return 1.0 / self.frame_hz


class Stage:
    """Connections of one check; ``clear`` before the next.

    Args:
        address: of the server.
        facts: of its hello.
        key: of the link, if any.
        timeout_s: longest wait for an answer.
        first_seq: above every number used so far.
    """

    def __init__(
        self, address: tuple[str, int], facts: Facts, key: bytes | None, timeout_s: float, first_seq: int
    ) -> None:
        self._address, self.facts, self.key, self.timeout_s = address, facts, key, timeout_s
        self._seq = first_seq
        self._links: list[Link] = []

    def next_seq(self) -> int:
        """A number above all that were used."""
        self._seq += SEQ_STEP
        return self._seq

    def connect(self) -> Link:
        """A fresh connection.

        Raises:
            Broken: it is not accepted.
        """
        try:
            link = Link(self._address, self.timeout_s)
        except OSError as error:
            raise Broken(f"connection not accepted: {error.strerror or error}") from error
        self._links.append(link)
        return link

    def poll(self, wait_s: float = POLL_S) -> None:
        """Receive on all connections, waiting at most so long."""
        receive_any(self._links, wait_s)

    def until(self, is_done: Callable[[], bool], wait_s: float | None = None) -> bool:
        """Receive until something is done; false when it is not within ``wait_s`` (the time-out by default)."""
        deadline_s = time.monotonic() + (self.timeout_s if wait_s is None else wait_s)
        while not is_done():
            left_s = deadline_s - time.monotonic()
            if left_s <= 0.0:
                return False
            self.poll(min(left_s, POLL_S))
        return True

    def wait(self, wait_s: float) -> None:
        """Receive for so long."""
        self.until(lambda: False, wait_s)

    def line(self, link: Link, what: str, wait_s: float | None = None) -> bytes:
        """The next line on a connection.

        Raises:
            Broken: none comes; ``what`` says what it should have been.
        """
        self.until(lambda: bool(link.lines) or link.is_ended, wait_s)
        require(bool(link.lines), f"{'connection closed' if link.is_ended else 'silence'} instead of {what}")
        return link.lines.popleft()

    def message(self, link: Link, kind: str, wait_s: float | None = None) -> Message:
        """The next message on a connection, which has to be of this type.

        Raises:
            Broken: it is not.
        """
        line = self.line(link, kind, wait_s)
        message = read_message(line)
        if message is None or message.get("type") != kind:
            raise Broken(f"{shorten(line)} instead of {kind}")
        return message

    def greet(self) -> tuple[Link, Message]:
        """A fresh connection and its hello.

        Raises:
            Broken: no hello.
        """
        link = self.connect()
        return link, self.message(link, "hello")

    def join_line(self, hello: Message, role: Role, mac: str | None = None) -> bytes:
        """The right answer to a hello, or one with another mac.

        Raises:
            NotApplicable: a mac is needed and there is no key.
        """
        if mac is None and self.facts.needs_mac:
            if self.key is None:
                raise NotApplicable("the server asks for a mac, and there is no key")
            mac = join_mac(self.key, str(hello.get("nonce")), role)
        return encode(Join(role=role, client="conformance", mac=mac or ""))

    def answer(self, link: Link) -> Message:
        """What the server says to a join, whatever frames come before it.

        Raises:
            Broken: nothing in time, or neither joined nor refused.
        """
        line = self.line(link, "joined or refused")
        message = read_message(line)
        if message is None or message.get("type") not in {"joined", "refused"}:
            raise Broken(f"{shorten(line)} instead of joined or refused")
        return message

    def join(self, role: Role, patience_s: float | None = None) -> Link:
        """A session. The one before may not have ended yet, so a role that is taken is asked for again.

        Args:
            role: what to join as.
            patience_s: how long it is asked for; the time-out by default.

        Raises:
            Broken: refused.
        """
        deadline_s = time.monotonic() + (self.timeout_s if patience_s is None else patience_s)
        while True:
            link, hello = self.greet()
            link.send(self.join_line(hello, role))
            answer = self.answer(link)
            if answer["type"] == "joined":
                return link
            link.close()
            is_over = time.monotonic() > deadline_s
            require(answer.get("reason") == "role taken" and not is_over, f"{role} refused: {answer.get('reason')}")
            self.wait(POLL_S)

    def is_closed(self, link: Link, wait_s: float | None = None) -> bool:
        """Whether the server closes the connection in time."""
        return self.until(lambda: link.is_ended, wait_s)

    def clear(self) -> None:
        """Close everything."""
        for link in self._links:
            with suppress(OSError):
                link.close()
        self._links.clear()


def auth_needs_mac(hello: Message) -> bool:
    """Whether a hello asks for a mac."""
    return hello.get("auth") == AUTH_HMAC
