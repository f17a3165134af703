"""The XBee that coordinates the network: finds the radios, and asks each for one packet whose strength is its own.

``DB`` of the module is the strength of the last hop of the last packet, whoever sent it. So a radio is asked for its
name; after its answer the module is asked for ``DB``. The strength counts only if the answer fits sender and request,
no other packet and no damaged bytes came in between, and no module relays the packets of this radio.
"""

from collections import Counter
from math import inf
from typing import NamedTuple

from ccatp.beacons.config.onboard_models import RadioDeviceConfig
from ccatp.beacons.links.xbee_frames import (
    BY_RADIO,
    OK,
    RESETS,
    AtResponse,
    FrameReader,
    Message,
    ModemStatus,
    RemoteResponse,
    RouteRecord,
    format_at,
    format_frame,
    format_remote_at,
    parse_frame,
    parse_node,
)
from ccatp.beacons.onboard.recognition import PATIENCE_S, BeaconDevice
from ccatp.onboard.devices.serial_device import Clock, Sleep
from ccatp.onboard.devices.serial_line import OpenPort
from ccatp.onboard.hardware import HardwareError

ASK_S = 0.3  # between two requests at the start
WEAKEST_DBM = 120  # beyond the sensitivity of all modules
DISCOVER_AGAIN_S = 30.0  # while a wanted radio is missing
_QUESTIONS = (b"AP", b"SH", b"SL", b"VR", b"NI")


class Strength(NamedTuple):
    """Result of one request; ``dbm`` is None without a strength that belongs to the radio."""

    name: str
    dbm: float | None


class _Request(NamedTuple):
    name: str
    address: int
    tries_left: int
    frame_id: int
    until_s: float
    damaged: int  # received bytes and sums so far
    has_answered: bool  # the radio; then the module is asked


class Coordinator(BeaconDevice):
    """The module.

    Attributes:
        radios: serial numbers of the radios that were found, by name.
        relayed: names of radios whose packets are relayed.
        twins: names that several radios have; none of them is measured.
        resets: of the module.
        counts: requests without a strength: ``lost`` (no answer), ``failed`` (not transmitted, or refused), ``mixed``
            (another packet came in between, or damaged bytes, which may have been one), ``none`` (the module has no
            strength that can be).
        reader: of the received bytes.
    """

    title, key = "radio", "devices.radio"

    def __init__(self, config: RadioDeviceConfig, open_port: OpenPort, clock: Clock, sleep: Sleep) -> None:
        super().__init__((config.device, config.baud), open_port, clock, sleep)
        self._config = config
        self.patience_s = PATIENCE_S + config.discovery_s
        self._is_escaped = config.api_mode == 2
        self.reader = FrameReader(is_escaped=self._is_escaped)
        self._frame_id = 0
        self._answers: dict[bytes, bytes] = {}
        self._ask_s = self._discover_s = -inf
        self._discovery_until_s: float | None = None
        self._discovery_id = 0
        self._found: dict[str, int] = {}  # in the newest discovery
        self._is_found = False
        self._request: _Request | None = None
        self._result: Strength | None = None
        self._now_s = 0.0
        self.radios: dict[str, int] = {}
        self.relayed: set[str] = set()
        self.twins: set[str] = set()
        self.resets = 0
        self.counts: Counter[str] = Counter(lost=0, failed=0, mixed=0, none=0)

    @property
    def is_ready(self) -> bool:
        """It has answered, and the radios were searched."""
        return self._line.is_open and self._is_found

    @property
    def identity(self) -> str:
        """What it says of itself, and whose packets it receives."""
        return f"{self._identity}; receives {', '.join(sorted(self.radios)) or 'no radio'}"

    @property
    def missing(self) -> list[str]:
        """Wanted radios that were not found."""
        return [name for name in self._config.names if name not in self.radios]

    @property
    def wanted(self) -> list[str]:
        """Radios of which strengths are measured."""
        names = self._config.names or tuple(sorted(self.radios))
        return [name for name in names if name in self.radios and name not in self.relayed | self.twins]

    def fault(self) -> str:
        """The reason why radios cannot be measured; empty if all can."""
        if not self.is_ready:
            return self.why()
        if self.missing:
            return f"does not receive {', '.join(self.missing)}"
        if self.twins:
            return f"several radios have the name {', '.join(sorted(self.twins))}; set NI of each to another one"
        if self.relayed:
            return f"the packets of {', '.join(sorted(self.relayed))} are relayed: their strength is not their own"
        return ""

    def ask(self, name: str, now_s: float) -> None:
        """Begin the request of the strength of a radio; ``take`` gives the result. Raises OSError."""
        self._result = None
        self._send_request(name, self.radios[name], self._config.tries, now_s)

    def take(self) -> Strength | None:
        """The result of the request; None while it is not known."""
        result, self._result = self._result, None
        return result

    # -- in time ------------------------------------------------------------------------------------------------------

    def _begin(self, now_s: float) -> None:
        super()._begin(now_s)
        self.reader = FrameReader(is_escaped=self._is_escaped)
        self._restart(now_s)

    def _restart(self, now_s: float) -> None:
        self._answers, self._is_found, self._discovery_until_s = {}, False, None
        self._ask_s = now_s
        self._fail()

    def _stop(self) -> None:
        self._is_found = False
        self._fail()

    def _fail(self) -> None:
        request, self._request = self._request, None
        if request is not None:
            self._result = Strength(request.name, None)

    def _receive(self, data: bytes, now_s: float) -> None:
        super()._receive(data, now_s)
        self._now_s = now_s
        frames = self.reader.feed(data)
        if self._request is not None and now_s > self._request.until_s and not frames:
            frames = self.reader.give_up()
        for frame in frames:
            self._line.accept(now_s)
            self._line.recover()
            self._take_message(parse_frame(frame), frame[0])
        if len(self._answers) < len(_QUESTIONS):
            if now_s >= self._ask_s:
                self._ask_s = now_s + ASK_S
                for command in _QUESTIONS:
                    if command not in self._answers:
                        self._send(format_at(self._next_id(), command))
        elif self._discovery_until_s is not None:
            if now_s >= self._discovery_until_s:
                self._discovery_until_s, self._is_found = None, True
        elif self._request is None and (not self._is_found or self.missing) and now_s >= self._discover_s:
            self._discover_s = now_s + DISCOVER_AGAIN_S
            self._discovery_until_s = now_s + self._config.discovery_s
            self._discovery_id = self._next_id()
            self._found, self.twins = {}, set()
            self._send(format_at(self._discovery_id, b"ND"))
        if self._request is None and now_s >= max(self._line.valid_s, self._ask_s) + ASK_S:
            self._ask_s = now_s  # the line is silent: is the module still there?
            self._send(format_at(self._next_id(), b"AP"))
        if self._request is not None and now_s > self._request.until_s:
            self._try_again(self._request, "lost")

    def _take_message(self, message: Message, kind: int) -> None:
        request = self._request
        if isinstance(message, ModemStatus) and message.status in RESETS:
            self.resets += 1
            self._discover_s = -inf
            self._restart(self._now_s)
        elif isinstance(message, AtResponse):
            self._take_answer(message, request)
        elif isinstance(message, RouteRecord):
            for name, address in self.radios.items():
                if address == message.address:
                    (self.relayed.add if message.relays else self.relayed.discard)(name)
        is_node = isinstance(message, AtResponse) and message.command == b"ND" and message.data
        if request is None or not (kind in BY_RADIO or is_node):
            return
        if request.has_answered:
            self._try_again(request, "mixed")
        elif isinstance(message, RemoteResponse) and (message.frame_id, message.address) == (
            request.frame_id,
            request.address,
        ):
            if message.status != OK:
                self._try_again(request, "failed")
                return
            frame_id, until_s = self._next_id(), self._now_s + self._config.answer_timeout_s
            self._request = request._replace(frame_id=frame_id, until_s=until_s, has_answered=True)
            self._send(format_at(frame_id, b"DB"))

    def _take_answer(self, answer: AtResponse, request: _Request | None) -> None:
        if answer.command == b"ND":
            if answer.frame_id == self._discovery_id and (node := parse_node(answer.data)) is not None:
                if self._found.setdefault(node.name, node.address) != node.address:
                    self.twins.add(node.name)
                self.radios[node.name] = node.address
                (self.relayed.add if node.is_relayed else self.relayed.discard)(node.name)
        elif answer.command == b"DB" and request is not None and request.has_answered:
            if answer.frame_id == request.frame_id and request.damaged != self._damaged:
                self._try_again(request, "mixed")
            elif answer.frame_id == request.frame_id:
                level = answer.data[-1] if answer.status == OK and answer.data else 0
                name = request.name
                is_own = 0 < level <= WEAKEST_DBM and name not in self.relayed  # 0: it has received nothing yet
                self.counts["none"] += not is_own
                self._request, self._result = None, Strength(name, -float(level) if is_own else None)
        elif answer.status == OK and answer.command in _QUESTIONS:
            self._answers[answer.command] = answer.data
            if answer.command == b"AP" and (mode := answer.data[-1:]) != bytes([self._config.api_mode]):
                raise HardwareError(f"it is in API mode {mode.hex()}; set devices.radio.api_mode, or AP of the module")
            if len(self._answers) == len(_QUESTIONS):
                high, low, version = (self._answers[command].hex().upper() for command in (b"SH", b"SL", b"VR"))
                name = self._answers[b"NI"].decode("ascii", "replace").strip()
                self._identity = f"XBee {high}{low} {name}, firmware {version}"

    @property
    def _damaged(self) -> int:
        return self.reader.counts["noise"] + self.reader.counts["bad_sums"]

    # -- requests -----------------------------------------------------------------------------------------------------

    def _try_again(self, request: _Request, why: str) -> None:
        self.counts[why] += 1
        if request.tries_left > 1:
            self._send_request(request.name, request.address, request.tries_left - 1, self._now_s)
        else:
            self._fail()

    def _send_request(self, name: str, address: int, tries_left: int, now_s: float) -> None:
        frame_id = self._next_id()
        until_s = now_s + self._config.answer_timeout_s
        self._request = _Request(name, address, tries_left, frame_id, until_s, self._damaged, has_answered=False)
        self._send(format_remote_at(frame_id, address, b"NI"))

    def _next_id(self) -> int:
        self._frame_id = self._frame_id % 255 + 1  # 0 asks for no answer
        return self._frame_id

    def _send(self, data: bytes) -> None:
        self._line.write(format_frame(data, is_escaped=self._is_escaped))
