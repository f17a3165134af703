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
    name_of,
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
_EXCHANGED_BYTES = 60  # of a request and its answer, with a name of 20 letters
_QUESTIONS = (b"AP", b"SH", b"SL", b"VR", b"NI", b"NT")


class Strength(NamedTuple):
    """Result of one request; ``dbm`` is None without a strength that belongs to the radio."""

    name: str
    dbm: float | None


class _Request(NamedTuple):
    name: str  # empty: the name is wanted, not the strength
    address: int
    tries_left: int
    frame_id: int
    until_s: float
    damaged: int  # received bytes and sums so far
    has_answered: bool  # the radio; then the module is asked


class Coordinator(BeaconDevice):
    """The module.

    The node discovery gives serial numbers. Names are those that the radios answer themselves, also with each strength.

    Attributes:
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
        self._ask_s = self._discover_s = self._searched_s = -inf
        self._discovery_id = 0
        self._names: dict[int, str] = {}  # of the radios, by serial number
        self._unnamed: list[int] = []  # serial numbers of radios that were found, and are to be asked for their names
        self._relayed: set[int] = set()
        self._is_found = False
        self._request: _Request | None = None
        self._result: Strength | None = None
        self._now_s = 0.0
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
    def radios(self) -> dict[str, int]:
        """Serial numbers of the radios that were found, by name."""
        return {name: address for address, name in self._names.items()}

    @property
    def relayed(self) -> set[str]:
        """Names of radios whose packets are relayed."""
        return {name for address, name in self._names.items() if address in self._relayed}

    @property
    def twins(self) -> set[str]:
        """Names that several radios have; none of them is measured."""
        return {name for name, count in Counter(self._names.values()).items() if count > 1}

    @property
    def missing(self) -> list[str]:
        """Wanted radios that were not found."""
        return [name for name in self._config.names if name not in self.radios]

    @property
    def wanted(self) -> list[str]:
        """Radios of which strengths are measured."""
        names = self._config.names or tuple(sorted(self.radios))
        measured = self.radios.keys() - self.relayed - self.twins
        return [name for name in names if name in measured]

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
        self._request, self._result = None, None
        if name in self.wanted:
            self._send_request(name, self.radios[name], self._config.tries, now_s)
        else:  # another radio has been found that has its name, or relays its packets
            self._result = Strength(name, None)

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
        self._answers, self._is_found, self._searched_s = {}, False, -inf
        self._ask_s = now_s
        self._fail()

    def _stop(self) -> None:
        self._is_found = False
        self._fail()

    def _fail(self) -> None:
        request, self._request = self._request, None
        if request is not None and request.name:
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
        self._discover(now_s)
        if self._request is None and now_s >= max(self._line.valid_s, self._ask_s) + ASK_S:
            self._ask_s = now_s  # the line is silent: is the module still there?
            self._send(format_at(self._next_id(), b"AP"))
        if self._request is not None and now_s > self._request.until_s:
            self._try_again(self._request, "lost")

    def _discover(self, now_s: float) -> None:
        """Ask the module what it is, then which radios there are, then these for their names."""
        if len(self._answers) < len(_QUESTIONS):
            if now_s >= self._ask_s:
                self._ask_s = now_s + ASK_S
                for command in _QUESTIONS:
                    if command not in self._answers:
                        self._send(format_at(self._next_id(), command))
        elif self._request is not None or now_s < self._searched_s:
            pass
        elif self._unnamed:
            self._send_request("", self._unnamed.pop(), self._config.tries, now_s)
        elif not self._is_found and self._searched_s > -inf:
            self._is_found = True
        elif (not self._is_found or self.missing) and now_s >= self._discover_s:
            self._discover_s, self._searched_s = now_s + DISCOVER_AGAIN_S, now_s + self._config.discovery_s
            self._discovery_id = self._next_id()
            self._send(format_at(self._discovery_id, b"ND"))

    def _take_message(self, message: Message, kind: int) -> None:
        request = self._request
        if isinstance(message, ModemStatus) and message.status in RESETS:
            self.resets += 1
            self._discover_s = -inf
            self._restart(self._now_s)
        elif isinstance(message, AtResponse):
            self._take_answer(message, request)
        elif isinstance(message, RouteRecord):
            (self._relayed.add if message.relays else self._relayed.discard)(message.address)
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
            name = self._names[request.address] = name_of(request.address, message.data)
            if name != request.name:
                self._fail()  # only its name was wanted, or it has another one now
                return
            frame_id, until_s = self._next_id(), self._now_s + self._longest_s
            self._request = request._replace(frame_id=frame_id, until_s=until_s, has_answered=True)
            self._send(format_at(frame_id, b"DB"))

    def _take_answer(self, answer: AtResponse, request: _Request | None) -> None:
        if answer.command == b"ND":
            if answer.frame_id == self._discovery_id and (node := parse_node(answer.data)) is not None:
                if node.address not in self._names and node.address not in self._unnamed:
                    self._unnamed.append(node.address)
                if node.is_relayed is not None:
                    (self._relayed.add if node.is_relayed else self._relayed.discard)(node.address)
        elif answer.command == b"DB" and request is not None and request.has_answered:
            if answer.frame_id == request.frame_id and request.damaged != self._damaged:
                self._try_again(request, "mixed")
            elif answer.frame_id == request.frame_id:
                level = answer.data[-1] if answer.status == OK and answer.data else 0
                is_own = 0 < level <= WEAKEST_DBM and request.name in self.wanted  # 0: it has received nothing yet
                self.counts["none"] += not is_own
                self._request, self._result = None, Strength(request.name, -float(level) if is_own else None)
        elif answer.command in _QUESTIONS and (answer.status == OK or answer.command == b"NT"):  # old ones have no NT
            self._answers[answer.command] = answer.data
            if answer.command == b"NT" and (search_s := 0.1 * int.from_bytes(answer.data)) > self._config.discovery_s:
                raise HardwareError(
                    f"it searches radios for {search_s:g} s (NT); set devices.radio.discovery_s above, or NT lower"
                )
            if answer.command == b"AP" and (mode := answer.data[-1:]) != bytes([self._config.api_mode]):
                raise HardwareError(f"it is in API mode {mode.hex()}; set devices.radio.api_mode, or AP of the module")
            if len(self._answers) == len(_QUESTIONS):
                high, low, version = (self._answers[command].hex().upper() for command in (b"SH", b"SL", b"VR"))
                name = self._answers[b"NI"].decode("latin-1").strip()
                self._identity = f"XBee {high}{low} {name}, firmware {version}"

    @property
    def _damaged(self) -> int:
        return self.reader.counts["noise"] + self.reader.counts["bad_sums"]

    # -- requests -----------------------------------------------------------------------------------------------------

    @property
    def _longest_s(self) -> float:
        """Time for an answer; its bytes and those of the request take time on the line as well."""
        return self._config.answer_timeout_s + _EXCHANGED_BYTES * self._byte_s

    def _try_again(self, request: _Request, why: str) -> None:
        self.counts[why] += 1
        if request.tries_left > 1:
            self._send_request(request.name, request.address, request.tries_left - 1, self._now_s)
        else:
            self._fail()

    def _send_request(self, name: str, address: int, tries_left: int, now_s: float) -> None:
        frame_id = self._next_id()
        until_s = now_s + self._longest_s
        self._request = _Request(name, address, tries_left, frame_id, until_s, self._damaged, has_answered=False)
        self._send(format_remote_at(frame_id, address, b"NI"))

    def _next_id(self) -> int:
        self._frame_id = self._frame_id % 255 + 1  # 0 asks for no answer
        return self._frame_id

    def _send(self, data: bytes) -> None:
        self._line.write(format_frame(data, is_escaped=self._is_escaped))
