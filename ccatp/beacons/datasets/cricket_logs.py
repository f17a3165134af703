"""Ranges between Cricket motes from the serial lines of their listeners, recorded or read live."""

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from ccatp.beacons.config.models import CricketConfig
from ccatp.beacons.cricket.measured_map import MeasuredRanges
from ccatp.beacons.cricket.range_network import TdoaError, pair_range
from ccatp.beacons.datasets.tables import RadioDataError
from ccatp.beacons.links.cricket_lines import LineReader, Pulse
from ccatp.config.files import read_input
from ccatp.onboard.devices.linux import open_serial
from ccatp.onboard.devices.serial_line import SerialPort
from ccatp.onboard.hardware import HardwareError

BAUD = 115200
_MOST_BYTES = 50_000_000
_ASK = b"\rG CF\r"  # the mote reports its name and its temperature
_WAIT_S = 0.02


class Listened(NamedTuple):
    """What one listener received."""

    name: str
    pulses: list[Pulse]
    temperature_c: float | None


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
    return Listened(name or report.space or report.unique_id or path.stem, pulses, report.temperature_c)


def _live(
    device: str, seconds: float, reader: LineReader, open_port: Callable[[str, int, str], SerialPort]
) -> list[Pulse]:
    pulses: list[Pulse] = []
    try:
        port = open_port(device, BAUD, "--cricket")
        try:
            with suppress(OSError):  # it may only send
                port.write(_ASK)
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

    Also gives warnings. Raises RadioDataError: two listeners have one name, or a temperature is impossible.
    """
    names = [one.name for one in listened]
    if again := next((name for name in names if names.count(name) > 1), None):
        raise RadioDataError(Path(again), "is the name of two listeners; give them names: --cricket NAME=PATH")
    rows, warnings = [], []
    for one in listened:
        if one.temperature_c is None:
            warnings.append(f"{one.name} reports no temperature: {cfg.air.temperature_c:g} C of cricket.air is used")
        temperature_c = cfg.air.temperature_c if one.temperature_c is None else one.temperature_c
        delays: dict[str, list[float]] = {}
        for pulse in one.pulses:
            delays.setdefault(pulse.sender, []).append(pulse.delay_s)
        for sender, received_s in delays.items():
            if sender == one.name:
                continue  # it was a beacon before, under its own name
            try:
                rows.append(pair_range(cfg, (sender, one.name), received_s, temperature_c))
            except TdoaError as error:
                raise RadioDataError(Path(one.name), str(error)) from error
    return MeasuredRanges(tuple(rows), {}, {}), warnings
