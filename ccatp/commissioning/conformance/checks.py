"""What a check is, how it ends, and how the messages of a server are read.

Messages are read twice: leniently, so that a check can go on, and strictly where the line itself is checked.
"""

import json
import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, NoReturn

if TYPE_CHECKING:
    from ccatp.commissioning.conformance.connections import CheckContext

Need = Literal["motion", "real time", "lockstep", "hmac"]
Message = dict[str, Any]
Duty = tuple[float, float]
Run = Callable[["CheckContext"], str]
DUTY_TOLERANCE = 0.01  # a duty in eight bits


class CheckFailed(AssertionError):
    """The server does not do what the interface control document promises; the text says what was seen instead."""


class NotApplicable(Exception):
    """The server promises nothing here, or nothing that can be seen; the text says why."""


class Check(NamedTuple):
    """One check: ``run`` returns what was seen, or raises ``CheckFailed`` or ``NotApplicable``.

    Without what it needs it is not applicable.
    """

    check_id: str
    promise: str
    run: "Run"
    needs: tuple[Need, ...] = ()


class CheckList(list[Check]):
    """Checks in the order in which they run."""

    def add(self, check_id: str, promise: str, *needs: Need) -> "Callable[[Run], Run]":
        """Decorator: append a function as a check."""

        def append(run: Run) -> Run:
            self.append(Check(check_id, promise, run, needs))
            return run

        return append


def require(is_kept: bool, seen: str) -> None:
    """Raise ``CheckFailed`` with what was seen unless a promise is kept."""
    if not is_kept:
        raise CheckFailed(seen)


class CheckedFrame(NamedTuple):
    """What the checks need of a sensors frame; ``enc`` holds samples (t, right, left) of the wheels, s and rad/s."""

    seq: int
    t_s: float
    drive_seq: int
    age_s: float
    permit_age_s: float
    is_held: bool
    fans: Duty
    enc: tuple[tuple[float, float, float], ...]

    @property
    def drive_arrival_s(self) -> float:
        """When the drive in force arrived, robot's clock."""
        return self.t_s - self.age_s

    @property
    def permit_arrival_s(self) -> float:
        """When the newest permit arrived, robot's clock."""
        return self.t_s - self.permit_age_s


def parse_frame(message: Message) -> CheckedFrame:
    """The frame in a sensors message; ``CheckFailed`` where a field that every check needs is missing or wrong."""
    cmd: Any = message.get("cmd")
    require(isinstance(cmd, dict), f"a sensors frame with cmd = {cmd!r}")
    seq: Any = message.get("seq")
    drive_seq, held = cmd.get("seq"), cmd.get("held")
    fans: Any = message.get("fans")
    enc: Any = message.get("enc")
    for name, number in (("seq", seq), ("cmd.seq", drive_seq)):
        require(is_whole(number), f"a sensors frame with {name} = {number!r}")
    numbers = {"t": message.get("t"), "cmd.age": cmd.get("age"), "cmd.permit_age": cmd.get("permit_age")}
    for name, number in numbers.items():
        require(is_number(number), f"a sensors frame with {name} = {number!r}")
    require(isinstance(held, bool), f"a sensors frame with cmd.held = {held!r}")
    require(is_numbers(fans, 2), f"a sensors frame with fans = {fans!r}")
    require(isinstance(enc, list), f"a sensors frame with enc = {enc!r}")
    t_s, age_s, permit_age_s = map(float, numbers.values())
    samples = tuple((sample[0], sample[1], sample[2]) for sample in enc if is_numbers(sample, 3))
    return CheckedFrame(seq, t_s, drive_seq, age_s, permit_age_s, held, (fans[0], fans[1]), samples)


def mean_rates(frames: Sequence[CheckedFrame]) -> tuple[float, float] | None:
    """Mean (right, left) wheel rates of all encoder samples in the frames, rad/s; ``None`` without samples."""
    samples = [sample for frame in frames for sample in frame.enc]
    if not samples:
        return None
    return sum(wr for _, wr, _ in samples) / len(samples), sum(wl for _, _, wl in samples) / len(samples)


def is_duty(seen: Duty, wanted: Duty) -> bool:
    """Whether fan duties are those wanted, within ``DUTY_TOLERANCE``."""
    return all(abs(a - b) <= DUTY_TOLERANCE for a, b in zip(seen, wanted, strict=True))


def read_message(line: bytes) -> Message | None:
    """The object in a line, ``None`` if there is none. Lenient: the same key twice, NaN and the like pass."""
    try:
        value = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return value if isinstance(value, dict) else None


def line_fault(line: bytes, limit_bytes: int) -> str | None:
    """What is wrong with a line: length, JSON, a repeated key, a number that is not finite; ``None`` if nothing."""
    if len(line) > limit_bytes:
        return f"a line of {len(line)} bytes"
    try:
        value = json.loads(line.decode("utf-8"), object_pairs_hook=_once, parse_float=_finite, parse_constant=_constant)
    except (ValueError, RecursionError) as error:
        return f"{error} in {shorten(line)}"
    return None if isinstance(value, dict) else f"no object: {shorten(line)}"


def _once(pairs: list[tuple[str, Any]]) -> Message:
    found = dict(pairs)
    if len(found) != len(pairs):
        raise ValueError("a key stands twice")
    return found


def _finite(text: str) -> float:
    if not math.isfinite(float(text)):
        raise ValueError(f"number {text[:20]} is not finite")
    return float(text)


def _constant(text: str) -> NoReturn:
    raise ValueError(f"{text} is no number of JSON")


def shorten(line: bytes, most: int = 60) -> str:
    """A line for a message."""
    text = line[:most].decode("utf-8", "backslashreplace")
    return text if len(line) <= most else text + "..."


def is_number(value: object) -> bool:
    """Whether it is a finite number; booleans are none."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def is_positive(value: Any) -> bool:
    """Whether it is a finite number over 0."""
    return is_number(value) and value > 0.0


def is_whole(value: object) -> bool:
    """Whether it is an integer; booleans are none."""
    return isinstance(value, int) and not isinstance(value, bool)


def is_numbers(value: object, count: int) -> bool:
    """Whether it is a list of so many finite numbers."""
    return isinstance(value, list) and len(value) == count and all(map(is_number, value))
