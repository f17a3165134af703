"""Ranges between Cricket motes from the serial lines of their listeners, recorded or read live."""

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from ccatp.beacons.config.models import CricketConfig
from ccatp.beacons.cricket.measured_map import MeasuredRanges
from ccatp.beacons.cricket.range_network import MoteRange, TdoaError, delay_at, pair_range
from ccatp.beacons.datasets.tables import RadioDataError
from ccatp.beacons.links.cricket_lines import ASK_REPORT, LineReader, MoteReport, Pulse, Senders
from ccatp.config.files import read_input
from ccatp.onboard.devices.linux import open_serial
from ccatp.onboard.devices.serial_line import SerialPort
from ccatp.onboard.hardware import HardwareError

BAUD = 115200
_MOST_BYTES = 50_000_000
_WAIT_S = 0.02
_MANY = 0.1  # share of the samples that are damaged or repeated, which is reported


class Listened(NamedTuple):
    """What one listener received; ``report``: its newest one; ``useless``: damaged and repeated samples."""

    name: str
    pulses: list[Pulse]
    report: MoteReport
    useless: int


def listen(source: str, seconds: float, open_port: Callable[[str, int, str], SerialPort] = open_serial) -> Listened:
    """The pulses of a listener, ``PATH`` or ``NAME=PATH``: a recorded file, or ``seconds`` of a device.

    Without a name it is the space id that the mote reports, its unique id, or the name of the file. Raises
    RadioDataError: it cannot be read, or has no pulse.
    """
    name, _, text = source.rpartition("=")
    path = Path(text)
    reader = LineReader()
    if path.is_char_device():
        pulses = _live(text, seconds, reader, open_port)
    else:
        try:
            data = read_input(path, _MOST_BYTES)
        except FileNotFoundError as error:
            raise RadioDataError(path, "no such file") from error
        except OSError as error:
            raise RadioDataError(path, f"cannot be read: {error.strerror or error}") from error
        pulses = [*reader.feed(data), *reader.finish()]
    report, counts = reader.report, reader.counts
    if not pulses:
        seen = f"{counts['silent']} radio messages without a pulse, {counts['garbled']} damaged samples"
        raise RadioDataError(path, f"has no pulse of a Cricket mote; {seen}, {counts['other']} other lines")
    useless = counts["garbled"] + counts["duplicates"]
    return Listened(name or report.space or report.unique_id or path.stem, pulses, report, useless)


def _live(
    device: str, seconds: float, reader: LineReader, open_port: Callable[[str, int, str], SerialPort]
) -> list[Pulse]:
    pulses: list[Pulse] = []
    try:
        port = open_port(device, BAUD, "--cricket")
        try:
            with suppress(OSError):  # it may only send
                port.write(ASK_REPORT)
            end_s = time.monotonic() + seconds
            while time.monotonic() < end_s:
                pulses += reader.feed(port.read(4096))
                time.sleep(_WAIT_S)
        finally:
            port.close()
    except OSError as error:
        raise RadioDataError(Path(device), f"cannot be read: {error.strerror or error}") from error
    except HardwareError as error:
        raise RadioDataError(Path(device), str(error).removeprefix(f"{device}: ")) from error
    return pulses


def ranges_of(cfg: CricketConfig, listened: Sequence[Listened]) -> tuple[MeasuredRanges, list[str]]:
    """A range for each sender and listener from its delays, with the speed of sound at the listener's temperature.

    Also gives warnings. Raises RadioDataError: two motes have one name, or a temperature is impossible.
    """
    names = [one.name for one in listened]
    if again := next((name for name in names if names.count(name) > 1), None):
        raise RadioDataError(Path(again), "is the name of two listeners; give them names: --cricket NAME=PATH")
    senders = Senders()
    for one in listened:
        if one.report.unique_id is not None:
            senders.listeners[one.report.unique_id] = one.name
        for pulse in one.pulses:
            senders.count(pulse)
    rows, warnings = list[MoteRange](), list[str]()
    for one in listened:
        received, useless = _received(one, senders)
        if useless > _MANY * (one.useless + len(one.pulses)):
            warnings.append(f"{one.name}: {useless} samples are damaged or repeat a time stamp, and are not used")
        temperatures_c = [pulse.temperature_c for pulse in one.pulses if pulse.temperature_c is not None]
        unreported_c = next(iter(temperatures_c), one.report.temperature_c)
        if unreported_c is None:
            unreported_c = cfg.air.temperature_c
            warnings.append(f"{one.name} reports no temperature: {unreported_c:g} C of cricket.air is used")
        try:
            rows += [_range(cfg, (sender, one.name), pulses, unreported_c) for sender, pulses in received.items()]
        except TdoaError as error:
            raise RadioDataError(Path(one.name), str(error)) from error
    if senders.twins:
        raise RadioDataError(Path(min(senders.twins)), "is the space id of several motes; give each another one (P SP)")
    return MeasuredRanges(tuple(rows), {}, {}), warnings


def _received(one: Listened, senders: Senders) -> tuple[dict[str, list[Pulse]], int]:
    """The pulses of each sender, and the number of samples of which none can be used."""
    received: dict[str, list[Pulse]] = {}
    useless = one.useless
    for pulse in one.pulses:
        if (sender := senders.name_of(pulse)) is None:
            useless += 1
        elif sender != one.name:  # it was a beacon before, under its own name
            received.setdefault(sender, []).append(pulse)
    return received, useless


def _range(cfg: CricketConfig, pair: tuple[str, str], pulses: Sequence[Pulse], unreported_c: float) -> MoteRange:
    """The range of a pair; ``unreported_c``: temperature before the first report."""
    temperatures_c = [unreported_c if one.temperature_c is None else one.temperature_c for one in pulses]
    mean_c = sum(temperatures_c) / len(temperatures_c)
    delays_s = [delay_at(mean_c, one.delay_s, at_c) for one, at_c in zip(pulses, temperatures_c, strict=True)]
    return pair_range(cfg, pair, delays_s, mean_c)
