"""The data acquisition device on a serial line: encoder counters, edge sensors, battery. Protocol and its host side.

Frames both ways, little endian, at most 264 bytes::

    offset  bytes  field
    0       2      sync: a5 5a
    2       1      version of the protocol: 1
    3       1      type
    4       1      n, length of the payload
    5       2      sequence number, counts the frames of one direction, wraps
    7       n      payload
    7 + n   2      CRC-16/CCITT-FALSE (polynomial 1021, start ffff, "123456789" gives 29b1) of bytes 2 to 6 + n

    type  from    payload
    01    host    identify: empty; the device answers with its identity
    02    host    start: u16 rate, Hz; samples follow at this rate
    03    host    stop: empty; no more samples
    81    device  identity: u16 highest rate, Hz; name, version, serial number, each UTF-8 and closed by a zero byte
    82    device  samples: 1 to 11 samples of 22 bytes, oldest first

    offset  type    field of a sample
    0       u32     time of the device, us, wraps
    4       i32     count of the right encoder, up when the wheel drives the robot forwards, wraps
    8       i32     count of the left encoder
    12      4 u16   edge sensors front left, front right, rear left, rear right: 0 to 65535 for 0 V to full scale
    20      u16     battery behind its divider, the same scale

After power-on or a reset the device sends its identity once and then waits for a start. It sends a samples frame at
least every 0.005 s, because the wheel control needs them, and ignores frames that it does not know. The host treats
every identity as a restart of the device: it sends a start, and its own unwrapped counts continue.
"""

import binascii
import struct
from math import inf
from typing import NamedTuple

from ccatp.config.onboard_models import DaqConfig
from ccatp.links.byte_frames import FrameFinder
from ccatp.onboard.devices.serial_device import Clock, SerialDevice, Sleep
from ccatp.onboard.devices.serial_line import OpenPort
from ccatp.onboard.hardware import HardwareError, state_of_charge, wrapped_change

SYNC, VERSION = b"\xa5\x5a", 1
IDENTIFY, START, STOP, IDENTITY, SAMPLES = 0x01, 0x02, 0x03, 0x81, 0x82
HEADER, CRC, SAMPLE = struct.Struct("<2sBBBH"), struct.Struct("<H"), struct.Struct("<Iii5H")
FULL_SCALE = 65535.0

ASK_S = 0.25  # between two requests for the identity
ANSWER_S = 5.0  # opening the port may reset the device, whose start may take some seconds
BATTERY_S = 1.0  # time constant of the battery's voltage, over which the motors' currents average out

# Of DeviceClock. SLEW: twice the largest error of a clock, 1 %, so that a remaining offset decreases.
SETTLE_S, WINDOW_S, SLEW, JUMP_S = 0.1, 0.2, 0.02, 0.1


class DaqSample(NamedTuple):
    """One sample; counts unwrapped, voltages in V."""

    t_s: float
    right: int
    left: int
    edges_v: tuple[float, float, float, float]


def format_frame(kind: int, seq: int, payload: bytes = b"", version: int = VERSION) -> bytes:
    """A frame as bytes."""
    frame = HEADER.pack(SYNC, version, kind, len(payload), seq & 0xFFFF) + payload
    return frame + CRC.pack(binascii.crc_hqx(frame[2:], 0xFFFF))


class Decoder(FrameFinder):
    """Finds the frames in received bytes.

    Attributes:
        counts: besides those of every protocol ``lost`` (by gaps of the sequence numbers), ``unknown``.
        other_version: protocol version of the newest valid frame if it is not ``VERSION``, otherwise 0.
    """

    START = SYNC

    def __init__(self) -> None:
        super().__init__()
        self._next_seq: int | None = None
        self.other_version = 0

    def feed(self, data: bytes) -> list[tuple[int, bytes]]:
        """Type and payload of each frame that is complete now."""
        found: list[tuple[int, bytes]] = []
        for frame in self.find(data):
            _, version, kind, _, seq = HEADER.unpack_from(frame)
            self.other_version = 0 if version == VERSION else version
            if self.other_version:
                continue
            gap = 0 if self._next_seq is None else (seq - self._next_seq) & 0xFFFF
            self.counts["lost"] += gap if gap < 0x8000 else 0
            self._next_seq = (seq + 1) & 0xFFFF
            found.append((kind, frame[HEADER.size : -CRC.size]))
        return found

    def _size(self, data: bytearray) -> int:
        return HEADER.size + data[4] + CRC.size if len(data) >= HEADER.size else 0

    def _is_right(self, frame: bytes) -> bool:
        (crc,) = CRC.unpack_from(frame, len(frame) - CRC.size)
        return bool(binascii.crc_hqx(frame[2 : -CRC.size], 0xFFFF) == crc)


class DeviceClock:
    """Converts times of the device to the robot's clock, by the lower envelope of the arrival times.

    Arrival time minus device time is the offset of the clocks plus the transport delay, which is never negative. So the
    offset follows the least difference within ``WINDOW_S``, at a rate of at most ``SLEW``: intervals between samples,
    and therefore speeds, are right within 2 %. Times do not decrease and are not later than the arrival.
    """

    def __init__(self) -> None:
        self._last_us: int | None = None
        self._restart()

    def _restart(self) -> None:
        self._device_s = self._slewed_s = 0.0
        self._offset_s = self._least_s = self._least_before_s = inf
        self._window_end_s = SETTLE_S

    def unwrap(self, device_us: int) -> float | None:
        """Device time since its first sample, s; None if it went backwards."""
        step_us = 0 if self._last_us is None else (device_us - self._last_us) & 0xFFFFFFFF
        if step_us >= 0x80000000:
            return None
        self._last_us = device_us
        self._device_s += step_us * 1e-6
        return self._device_s

    def arrive(self, now_s: float) -> bool:
        """Take the arrival time of the newest sample; False while there are too few, or after a jump of the times."""
        difference_s = now_s - self._device_s
        self._least_s = min(self._least_s, difference_s)
        if self._device_s < SETTLE_S:
            self._offset_s, self._slewed_s = self._least_s, self._device_s
            return False
        if self._device_s >= self._window_end_s:
            self._least_before_s, self._least_s = self._least_s, difference_s
            self._window_end_s = self._device_s + WINDOW_S
        aim_s = min(self._least_s, self._least_before_s) - self._offset_s
        if abs(aim_s) > JUMP_S:
            self._restart()
            return False
        limit_s = SLEW * (self._device_s - self._slewed_s)
        self._offset_s += min(limit_s, max(-limit_s, aim_s))
        self._slewed_s = self._device_s
        return True

    def time_s(self, device_s: float, now_s: float) -> float:
        """Convert an unwrapped device time to the robot's clock."""
        return min(now_s, device_s + self._offset_s)


class Daq(SerialDevice):
    """The device.

    Attributes:
        battery_v: voltage of the battery, smoothed; None before the first sample.
        decoder: of the received bytes.
    """

    title, key = "data acquisition device", "devices.daq"
    answer_s = patience_s = ANSWER_S

    def __init__(self, config: DaqConfig, open_port: OpenPort, clock: Clock, sleep: Sleep) -> None:
        super().__init__((config.device, config.baud), open_port, clock, sleep)
        self._config = config
        self._volt = config.full_scale_v / FULL_SCALE
        self._ask_s = self._sample_s = -inf
        self._seq = 0
        self._is_started = False
        self._device_clock = DeviceClock()
        self._counts = [0, 0]
        self._last_counts: tuple[int, int] | None = None
        self._samples: list[DaqSample] = []
        self.battery_v: float | None = None
        self.decoder = Decoder()

    @property
    def is_ready(self) -> bool:
        """It sends samples."""
        return bool(self._samples)

    def open(self) -> None:
        """Open the port and wait for samples. Raises HardwareError."""
        super().open()
        self._samples.clear()  # nobody asked for those of the wait

    def take(self) -> list[DaqSample]:
        """Samples since the last call."""
        samples, self._samples = self._samples, []
        return samples

    def fault(self, now_s: float) -> str:
        """The reason if the newest sample is older than ``timeout_s``, otherwise empty."""
        age_s = now_s - self._sample_s
        return "" if age_s <= self._config.timeout_s else f"no sample for {age_s:.2f} s: {self.why()}"

    def soc(self) -> float:
        """State of charge, 0 to 1; 1 before the first sample."""
        if self.battery_v is None:
            return 1.0
        return state_of_charge(self.battery_v, self._config.battery_empty_v, self._config.battery_full_v)

    def _begin(self, now_s: float) -> None:
        self._ask_s, self._is_started = now_s, False

    def _receive(self, data: bytes, now_s: float) -> None:
        for kind, payload in self.decoder.feed(data):
            self._line.accept(now_s)
            if kind == IDENTITY:
                self._start(payload)
            elif kind == SAMPLES and self._is_started and payload and len(payload) % SAMPLE.size == 0:
                self._samples += self._read_samples(payload, now_s)
            else:
                self.decoder.counts["unknown"] += 1
        is_silent = not self._is_started or now_s - self._sample_s > ASK_S
        if is_silent and now_s >= self._ask_s:
            self._send(IDENTIFY)
            self._ask_s = now_s + ASK_S

    def _stop(self) -> None:
        self._send(STOP)

    def _start(self, payload: bytes) -> None:
        """Handle an identity: start the device; its counts and its clock begin again."""
        fastest_hz = int.from_bytes(payload[:2], "little")
        self._identity = " ".join(payload[2:].decode("utf-8", "replace").split("\0")).strip()
        if fastest_hz < self._config.sample_hz:
            raise HardwareError(
                f"{self._identity} delivers {fastest_hz} samples/s at most; lower devices.daq.sample_hz"
            )
        self._device_clock, self._last_counts, self._is_started = DeviceClock(), None, True
        self._send(START, struct.pack("<H", round(self._config.sample_hz)))

    def _read_samples(self, payload: bytes, now_s: float) -> list[DaqSample]:
        timed = []
        for device_us, right, left, *edges, battery in SAMPLE.iter_unpack(payload):
            device_s = self._device_clock.unwrap(device_us)
            if device_s is None:  # it was reset, and its identity was lost
                self._is_started = False
                return []
            before = self._last_counts or (right, left)
            self._last_counts = right, left
            self._counts = [
                total + wrapped_change(now, last)
                for total, now, last in zip(self._counts, self._last_counts, before, strict=True)
            ]
            timed.append((device_s, self._counts, edges))
            battery_v = battery * self._volt * self._config.battery_ratio
            before_v = battery_v if self.battery_v is None else self.battery_v
            self.battery_v = before_v + (battery_v - before_v) / (BATTERY_S * self._config.sample_hz)
        if not self._device_clock.arrive(now_s):
            return []
        samples = []
        for device_s, (right, left), edges in timed:
            t_s = self._device_clock.time_s(device_s, now_s)
            if t_s > self._sample_s:
                fl, fr, rl, rr = (self._volt * edge for edge in edges)
                samples.append(DaqSample(t_s, right, left, (fl, fr, rl, rr)))
                self._sample_s = t_s
        self._line.recover()
        return samples

    def why(self) -> str:
        """The reason why there are no samples."""
        if self._line.is_open and (version := self.decoder.other_version):
            return f"speaks version {version} of the protocol instead of {VERSION}; install the firmware that fits"
        return super().why()

    def _silence(self) -> str:
        if not self._is_started:
            return "it does not answer; check its firmware, devices.daq.device and devices.daq.baud"
        return "it sends no samples, or has just started"

    def _send(self, kind: int, payload: bytes = b"") -> None:
        self._line.write(format_frame(kind, self._seq, payload))
        self._seq += 1
