"""Lines that a Cricket mote writes to its serial line: what it has received, and what it reports of itself.

A line has one field for each variable; DR is the time of flight in microseconds, DB the distance in the units of the
mote (cm or inches), TM the time between radio message and pulse before corrections, TS the mote's clock in
milliseconds. A line may lack fields: without a pulse it has no DR, and a line may be cut.
"""

import re
from collections import Counter
from typing import NamedTuple

ASK_REPORT = b"\rG CF\r"  # the mote reports its name and its temperature
LONGEST_LINE, LONGEST_NAME = 256, 16  # a space id has at most 8 letters
SLOWEST_M_S, FASTEST_M_S = 300.0, 370.0  # speed of sound between -50 and 70 degrees
LONGEST_FLIGHT_S = 0.045  # after which a mote waits for no pulse
_UNITS_M = (0.01, 0.0254)
_SAMPLE = re.compile(r"(?=VR=|\$Cricket)")
_ID = re.compile(r"[0-9a-f]{1,2}(?::[0-9a-f]{1,2}){7}", re.IGNORECASE)
_REPORT = re.compile(r"(Mode|Unique id|Space id|Local temperature value \(Celsius\)): *([^ ]+)")
_NUMBER = re.compile(r"-?\d+(?:\.\d+)?")
_OLD = {"space": "SP", "id": "ID", "duration": "DR", "time": "TM"}
_FEW, _RARE = 3, 0.01  # times, and share, that damage gives a pair of unique id and space id less often


class Pulse(NamedTuple):
    """A received pulse.

    ``space``: space id of the sender, empty without one. ``stamp_ms``: None without. ``temperature_c``: of the newest
    report of the listener before, None without.
    """

    unique_id: str
    space: str
    delay_s: float
    stamp_ms: int | None
    temperature_c: float | None = None


class MoteReport(NamedTuple):
    """What a mote said of itself; None where it has not."""

    mode: str | None = None
    unique_id: str | None = None
    space: str | None = None
    temperature_c: float | None = None


def full_id(text: str) -> str:
    """A unique id with two digits for each byte."""
    return ":".join(f"{int(part, 16):02x}" for part in text.split(":"))


def parse_pulse(text: str) -> Pulse | None:
    """The pulse of one sample; None without one, or if the sample is cut or contradicts itself.

    The last field may be cut, so it is used for the time stamp only; a distance that contradicts the time of flight
    shows a damaged digit. Raises ValueError: a field that is needed is no number.
    """
    pairs = [field.strip().partition("=") for field in text.strip().split(",")]
    fields = {_OLD.get(name, name): value for name, _, value in pairs}
    is_old, last = "ver" in fields, pairs[-1][0]  # a line of version 1 may end with the time of flight
    if not {"ID", "DR"} <= set(fields) or len(fields.get("SP", "")) > LONGEST_NAME:
        return None
    if not is_old and (last in {"ID", "SP", "DR"} or not _ID.fullmatch(fields["ID"])):
        return None
    delay_s = int(fields["DR"]) / 1e6
    if not 0.0 < delay_s <= LONGEST_FLIGHT_S:
        return None
    if "DB" in fields and last != "DB":
        steps, low_m, high_m = int(fields["DB"]), SLOWEST_M_S * delay_s, FASTEST_M_S * delay_s
        if not any(low_m < (steps + 1.5) * unit_m and (steps - 1.5) * unit_m < high_m for unit_m in _UNITS_M):
            return None
    stamp = fields.get("TS", "")
    unique_id = fields["ID"] if is_old else full_id(fields["ID"])
    return Pulse(unique_id, fields.get("SP", ""), delay_s, int(stamp) if stamp.isdigit() else None)


class Senders:
    """The names of motes: the name as a listener, else the space id, else the unique id.

    A damaged line may have a unique id or a space id that looks right; then it does not fit those of most lines.

    Attributes:
        listeners: names of the motes that listen, by unique id.
        twins: space ids that several motes have.
    """

    def __init__(self) -> None:
        self._spaces: dict[str, Counter[str]] = {}  # received with each unique id
        self._ids: dict[str, Counter[str]] = {}  # received with each space id
        self.listeners: dict[str, str] = {}
        self.twins: set[str] = set()

    def count(self, pulse: Pulse) -> None:
        """Take which ids belong together."""
        if pulse.space:
            self._spaces.setdefault(pulse.unique_id, Counter())[pulse.space] += 1
            self._ids.setdefault(pulse.space, Counter())[pulse.unique_id] += 1

    def name_of(self, pulse: Pulse) -> str | None:
        """The name of the sender of a pulse that was counted; None: it is damaged, or several motes have this name."""
        unique_id, space = pulse.unique_id, pulse.space
        if (name := self.listeners.get(unique_id)) is not None:
            return name
        spaces = self._spaces.get(unique_id, Counter())
        space = space or max(spaces, key=spaces.__getitem__, default="")
        if not space:
            return unique_id
        ids = self._ids[space]
        count = ids[unique_id]
        others = [number for other, number in ids.items() if other != unique_id]
        most = max(others + [number for other, number in spaces.items() if other != space], default=0)
        if count <= most and count < max(_FEW, _RARE * most):
            return None
        if max(others, default=0) >= max(_FEW, _RARE * count):
            self.twins.add(space)
        return None if space in self.twins else space


class LineReader:
    """Collects bytes to lines, and their pulses; a pulse with the mote and time stamp of the one before is dropped.

    Attributes:
        report: what the mote said of itself.
        counts: ``pulses``, ``silent`` (a radio message without a pulse), ``garbled`` (damaged, or without an
            end), ``duplicates``, ``reports`` (lines that say something of the mote), ``other`` lines.
    """

    def __init__(self) -> None:
        self._rest = b""
        self._stamps: dict[str, int] = {}
        self.report = MoteReport()
        self.counts: Counter[str] = Counter(pulses=0, silent=0, garbled=0, duplicates=0, reports=0, other=0)

    def feed(self, data: bytes) -> list[Pulse]:
        """The pulses of each line that is complete now; call ``finish`` at the end of a file."""
        *lines, self._rest = (self._rest + data).replace(b"\r", b"\n").split(b"\n")
        if len(self._rest) > LONGEST_LINE:
            self._rest = b""
            self.counts["garbled"] += 1
        return [pulse for line in lines for pulse in self._read(line)]

    def finish(self) -> list[Pulse]:
        """The pulses of the last line, which no line end closes."""
        rest, self._rest = self._rest, b""
        return self._read(rest)

    def _read(self, line: bytes) -> list[Pulse]:
        text = line.decode("ascii", "replace").replace("\0", "")
        found = []
        for part in _SAMPLE.split(text):  # two samples may share a line when its end was lost
            if part.startswith(("VR=", "$Cricket")):
                found += self._sample(part)
            elif part.strip():
                self._report(part)
        return found

    def _sample(self, part: str) -> list[Pulse]:
        try:
            pulse = parse_pulse(part)
        except ValueError:
            pulse = None
        if pulse is None:
            self.counts["garbled" if "DR=" in part or "TS=" not in part else "silent"] += 1
            return []
        if pulse.stamp_ms is not None:
            if self._stamps.get(pulse.unique_id) == pulse.stamp_ms:
                self.counts["duplicates"] += 1
                return []
            self._stamps[pulse.unique_id] = pulse.stamp_ms
        self.counts["pulses"] += 1
        return [pulse._replace(temperature_c=self.report.temperature_c)]

    def _report(self, part: str) -> None:
        match = _REPORT.search(part)
        if match is None:
            self.counts["other"] += 1
            return
        self.counts["reports"] += 1
        name, value = match.groups()
        if name == "Mode":
            self.report = self.report._replace(mode=value)
        elif name == "Unique id" and _ID.fullmatch(value):
            self.report = self.report._replace(unique_id=full_id(value))
        elif name == "Space id":
            self.report = self.report._replace(space=value)
        else:
            self.report = self.report._replace(temperature_c=float(value) if _NUMBER.fullmatch(value) else None)
