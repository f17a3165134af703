"""Pure. Lines of a server, read twice: leniently to go on with the story, strictly to judge the line itself."""

import json
import math
from typing import Any, NamedTuple, NoReturn

from ccatp.conformance.verdict import require

Message = dict[str, Any]


class Frame(NamedTuple):
    """What the stories need of a sensors frame.

    Attributes:
        seq: its number.
        t_s: the robot's clock.
        drive_seq: number of the drive in force.
        age_s, permit_age_s: ages of drive and permit.
        is_held: wheels held by the robot's own rules.
        fans: duties, left and right.
        enc: samples (t, right, left) of the wheels, rad/s.
    """

    seq: int
    t_s: float
    drive_seq: int
    age_s: float
    permit_age_s: float
    is_held: bool
    fans: tuple[float, float]
    enc: tuple[tuple[float, float, float], ...]

    @property
    def drive_arrival_s(self) -> float:
        """When the drive in force arrived, robot's clock."""
        return self.t_s - self.age_s

    @property
    def permit_arrival_s(self) -> float:
        """When the newest permit arrived, robot's clock."""
        return self.t_s - self.permit_age_s


def read_message(line: bytes) -> Message | None:
    """The object in a line, ``None`` if there is none. Lenient: the same key twice, NaN and the like pass."""
    try:
        value = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return value if isinstance(value, dict) else None


def fault_of_line(line: bytes, limit_bytes: int) -> str | None:
    """What is wrong with a line as such: length, JSON, a key twice, a number that is none; ``None`` if nothing."""
    if len(line) > limit_bytes:
        return f"a line of {len(line)} bytes"
    try:
        value = json.loads(line.decode("utf-8"), object_pairs_hook=_once, parse_float=_finite, parse_constant=_constant)
    except (ValueError, RecursionError) as error:
        return f"{error} in {shorten(line)}"
    return None if isinstance(value, dict) else f"no object: {shorten(line)}"


def parse_frame(message: Message) -> Frame:
    """The frame in a sensors message.

    Raises:
        Broken: a field that every story needs is missing or of another type.
    """
    cmd: Any = message.get("cmd")
    require(isinstance(cmd, dict), f"a sensors frame with cmd = {cmd!r}")
    seq, drive_seq = (_whole(name, value) for name, value in (("seq", message.get("seq")), ("cmd.seq", cmd.get("seq"))))
    held: Any
    fans: Any
    enc: Any
    held, fans, enc = cmd.get("held"), message.get("fans"), message.get("enc")
    require(isinstance(held, bool), f"a sensors frame with cmd.held = {held!r}")
    require(is_numbers(fans, 2), f"a sensors frame with fans = {fans!r}")
    require(isinstance(enc, list), f"a sensors frame with enc = {enc!r}")
    return Frame(
        seq,
        _number("t", message.get("t")),
        drive_seq,
        _number("cmd.age", cmd.get("age")),
        _number("cmd.permit_age", cmd.get("permit_age")),
        held,
        (fans[0], fans[1]),
        tuple((sample[0], sample[1], sample[2]) for sample in enc if is_numbers(sample, 3)),
    )


def is_number(value: object) -> bool:
    """Whether it is a finite number; booleans are none."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def is_whole(value: object) -> bool:
    """Whether it is an integer; booleans are none."""
    return isinstance(value, int) and not isinstance(value, bool)


def is_numbers(value: object, count: int) -> bool:
    """Whether it is a list of so many finite numbers."""
    return isinstance(value, list) and len(value) == count and all(map(is_number, value))


def shorten(line: bytes, most: int = 60) -> str:
    """A line for a message."""
    text = line[:most].decode("utf-8", "backslashreplace")
    return text if len(line) <= most else text + "..."


def _number(name: str, value: Any) -> float:
    require(is_number(value), f"a sensors frame with {name} = {value!r}")
    return float(value)


def _whole(name: str, value: Any) -> int:
    require(is_whole(value), f"a sensors frame with {name} = {value!r}")
    return int(value)


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
