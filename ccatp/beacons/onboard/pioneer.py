"""The Pioneer base: handshake, speeds, odometry, sonars, battery, stall, bumpers, and its own watchdog.

The base halts its wheels when it has received no command for the time of its watchdog, which is a parameter in its
flash memory: the program reads it and refuses a base that waits longer than the configuration allows. With the next
command the base resumes its last motion, so the program begins each handshake with ``STOP``. Speeds are sent
as travel (mm/s) and turn (degrees/s), which are finer than ``VEL2`` (20 mm/s); what rounding leaves over is added to
the next command.
"""

from collections import deque
from math import inf, pi

from ccatp.beacons.config.onboard_models import BaseDeviceConfig, BeaconBodyConfig
from ccatp.beacons.links.arcos_packets import (
    CLOSE,
    CONFIG,
    ENABLE,
    ENCODER,
    OPEN,
    RVEL,
    SETA,
    SETRA,
    SONAR,
    STANDARD_PACKETS,
    SYNC0,
    SYNC2,
    VEL,
    PacketReader,
    Standard,
    format_command,
    format_greeting,
    parse_encoders,
    parse_names,
    parse_settings,
    parse_standard,
)
from ccatp.beacons.onboard.recognition import BeaconDevice
from ccatp.onboard.devices.serial_device import Clock, Sleep
from ccatp.onboard.devices.serial_line import OpenPort
from ccatp.onboard.hardware import HardwareError, state_of_charge, wrapped_change

ASK_S = 0.25  # between two packets of the handshake
CLOSED_S = 1.0  # that the base needs after the end of a session
_CONFIGURES, _RUNS = SYNC2 + 1, SYNC2 + 2  # stages after those of the handshake
_DEGREE_RAD = pi / 180.0
SEND_S = 0.05  # between two commands with the same set points
_ENABLE_S = 1.0  # in which the base enables its motors
_OTHER_SCALE = 0.1  # of TicksMM: wheels that were measured differ less
_DISAGREES = 0.5  # of the base's own speed, by which the encoders may differ from it
_FAST_MM_S = 60.0  # speeds above are compared
_CONTINUOUS = 2
_IMPOSSIBLE = 3.0  # times the highest set point: no wheel turns so fast, a count was damaged
_JUMPS, _JUMPS_S = 4, 10.0  # so many within this time are a fault; counts that are set to others give three
_NEAREST_S = 0.05  # between two counts: those that were delayed on their way arrive together

WheelSpeeds = tuple[float, float | None, float | None]  # time; mean speed of the right and left wheel since the last


class PioneerBase(BeaconDevice):
    """The base.

    Attributes:
        stall: reason while a wheel is stalled or a bumper pressed; empty otherwise.
        soc: state of charge, 0 to 1.
        reader: of the received bytes.
    """

    title, key = "base", "devices.base"

    def __init__(
        self, config: BaseDeviceConfig, body: BeaconBodyConfig, open_port: OpenPort, clock: Clock, sleep: Sleep
    ) -> None:
        super().__init__((config.device, config.baud), open_port, clock, sleep)
        self._config = config
        self._radius_m, self._track_m = body.wheel_radius_m, body.track_m
        self._impossible_rad_s = _IMPOSSIBLE * body.max_wheel_rad_s
        self._jumps_s: deque[float] = deque(maxlen=_JUMPS)
        self.reader = PacketReader()
        self._stage = self._attempts = SYNC0
        self._settings: deque[tuple[int, int]] = deque()  # commands that are not sent yet
        self._ask_s = self._enable_s = self._standard_s = self._counts_s = -inf
        self._last: tuple[int, int] | None = None  # counts at the newest sample of the wheels,
        self._last_s = -inf  # and their time
        self._new_counts: tuple[int, int] | None = None
        self._samples: list[WheelSpeeds] = []
        self._rates = 0.0, 0.0  # newest, right and left
        self._own_mm_s = 0.0, 0.0  # the same by the base
        self._rest = [0.0, 0.0]
        self._set_points, self._sent_s = (0.0, 0.0), -inf
        self._ranges: dict[int, tuple[float, float]] = {}  # time, m
        self._doubts = 0
        self.stall = ""
        self.soc = 1.0

    @property
    def is_ready(self) -> bool:
        """It sends its packets, and its watchdog is short enough."""
        has_begun = self._stage == _RUNS and not self._settings
        return self._line.is_open and has_begun and self._counts_s > -inf and self._standard_s > -inf

    # -- in time ------------------------------------------------------------------------------------------------------

    def _begin(self, now_s: float) -> None:
        super()._begin(now_s)
        self.reader = PacketReader()
        self._restart(now_s)

    def _restart(self, now_s: float) -> None:
        self._stage = self._attempts = SYNC0
        self._ask_s, self._last = now_s, None
        self._standard_s = self._counts_s = -inf
        self._ranges = {}
        self._settings.clear()

    def _stop(self) -> None:
        stage, self._stage = self._stage, SYNC0
        if stage == _RUNS:
            self._line.write(format_command(VEL, 0) + format_command(RVEL, 0) + format_command(CLOSE))

    def _receive(self, data: bytes, now_s: float) -> None:
        super()._receive(data, now_s)
        for packet in self.reader.feed(data):
            self._line.accept(now_s)
            self._take_packet(packet, now_s)
        if self._new_counts is not None:  # of several packets in one reading the last one: nobody knows their times
            self._take_counts(self._new_counts, now_s)
            self._new_counts = None
        if self._stage < _RUNS and now_s >= self._ask_s:
            self._ask_s = now_s + ASK_S
            if self._stage == SYNC0:  # or what follows it, in a handshake that another program has begun
                self._line.write(format_greeting(self._attempts % _CONFIGURES))
                self._attempts += 1
            else:
                self._line.write(format_command(CONFIG if self._stage == _CONFIGURES else self._stage))
        elif self._stage == _RUNS and now_s - self._line.valid_s > CLOSED_S:
            self._restart(now_s)  # it was switched off, or restarted
        elif self._settings:  # one in each step: the base may lose commands that follow each other within 5 ms
            self._line.write(format_command(*self._settings.popleft()))

    def _take_packet(self, packet: bytes, now_s: float) -> None:
        kind, config = packet[0], self._config
        if self._stage <= SYNC2:
            if kind in STANDARD_PACKETS:  # the session of a program that died is still open
                self._line.write(format_command(CLOSE))
                self._stage, self._ask_s = SYNC0, now_s + CLOSED_S
            elif self._stage <= kind <= SYNC2:
                if kind == SYNC2:
                    name, base, model = parse_names(packet)
                    self._identity = f"{base} {model} {name}".strip()
                    self._line.write(format_command(OPEN))
                self._stage = kind + 1
                self._ask_s = now_s
        elif self._stage == _CONFIGURES and (settings := parse_settings(packet)) is not None:
            watchdog_s, counts_per_mm = settings
            if counts_per_mm is not None and abs(config.counts_per_mm / counts_per_mm - 1.0) > _OTHER_SCALE:
                raise HardwareError(
                    f"{self._identity}: its TicksMM is {counts_per_mm}; correct devices.base.counts_per_mm, "
                    f"which is {config.counts_per_mm:g}"
                )
            if not 0.0 < watchdog_s <= config.most_watchdog_s:
                raise HardwareError(
                    f"{self._identity}: its watchdog is {watchdog_s:g} s; set WatchDog of the base to at most "
                    f"{1e3 * config.most_watchdog_s:.0f} ms"
                )
            self._identity += f", watchdog {watchdog_s:g} s"
            acceleration = round(1e3 * config.acceleration_m_s2)
            turn = round(config.turn_acceleration_rad_s2 / _DEGREE_RAD)
            self._settings += (
                (SETA, acceleration), (SETA, -acceleration), (SETRA, turn), (SETRA, -turn),
                (SONAR, 1), (ENCODER, _CONTINUOUS), (ENABLE, 1),
            )  # fmt: skip
            self._stage, self._enable_s = _RUNS, now_s + _ENABLE_S
        elif (standard := parse_standard(packet)) is not None:
            self._take_standard(standard, now_s)
        elif (counts := parse_encoders(packet)) is not None:
            self._new_counts = counts

    def _take_standard(self, standard: Standard, now_s: float) -> None:
        config = self._config
        self._standard_s = now_s
        for number, range_mm in standard.sonars:
            self._ranges[number] = now_s, 1e-3 * range_mm
        self.soc = state_of_charge(standard.battery_v, config.battery_empty_v, config.battery_full_v)
        stalled = [side for side, is_stalled in zip(("left", "right"), standard.stalls, strict=True) if is_stalled]
        pressed = [side for side, bits in zip(("front", "rear"), standard.bumpers, strict=True) if bits]
        self.stall = f"{stalled[0]} wheel stalled" if stalled else f"{pressed[0]} bumper pressed" if pressed else ""
        if not standard.is_enabled and now_s >= self._enable_s:
            # An operator has pressed STOP: only an operator switches the motors on again.
            self.stall = "its motors are off; press MOTORS on the base"
        self._own_mm_s = standard.right_mm_s, standard.left_mm_s

    def _compare(self) -> None:
        """Count how often the encoders contradict the base's own speeds: a wrong sign or scale.

        Once for new counts: after a stall of this program several packets of speeds come in one reading.
        """
        for rate, own_mm_s in zip(self._rates, self._own_mm_s, strict=True):
            if abs(own_mm_s) > _FAST_MM_S:
                is_off = abs(1e3 * self._radius_m * rate - own_mm_s) > _DISAGREES * abs(own_mm_s)
                self._doubts = min(self._doubts + 1, 40) if is_off else 0

    def _take_counts(self, counts: tuple[int, int], now_s: float) -> None:
        """The mean speeds since the newest sample; counts without one are kept for the next: no travel is lost."""
        self._counts_s = now_s
        self._line.recover()
        if self._last is None:
            self._last, self._last_s = counts, now_s
            return
        interval_s = now_s - self._last_s
        if interval_s < _NEAREST_S:
            return
        per_rad_s = 1e3 * self._radius_m * self._config.counts_per_mm * interval_s
        left, right = (wrapped_change(now, before) / per_rad_s for now, before in zip(counts, self._last, strict=True))
        is_possible = max(abs(left), abs(right)) <= self._impossible_rad_s
        if not is_possible:
            self._jumps_s.append(now_s)
            if interval_s <= self._config.timeout_s:
                return
        self._last, self._last_s = counts, now_s
        if is_possible:
            self._rates = right, left
            self._samples.append((now_s, right, left))
            self._compare()

    # -- the robot ----------------------------------------------------------------------------------------------------

    def take(self) -> list[WheelSpeeds]:
        """Speeds of the wheels since the last call, oldest first."""
        samples, self._samples = self._samples, []
        return samples

    def drive(self, right_rad_s: float, left_rad_s: float, now_s: float) -> None:
        """Set the speeds of the wheels; each command also restarts the base's watchdog. Raises HardwareError."""
        set_points = right_rad_s, left_rad_s
        if self._stage != _RUNS or self._settings or (set_points == self._set_points and now_s - self._sent_s < SEND_S):
            return
        self._set_points, self._sent_s = set_points, now_s
        wanted = (
            500.0 * self._radius_m * (right_rad_s + left_rad_s),
            self._radius_m * (right_rad_s - left_rad_s) / self._track_m / _DEGREE_RAD,
        )
        if not any(set_points):
            self._rest = [0.0, 0.0]
        sent = [round(value + rest) for value, rest in zip(wanted, self._rest, strict=True)]
        self._rest = [value + rest - whole for value, rest, whole in zip(wanted, self._rest, sent, strict=True)]
        try:
            self._line.write(format_command(VEL, sent[0]) + format_command(RVEL, sent[1]))
        except OSError as error:
            raise HardwareError(f"base: {error}") from None

    def distances_m(self, now_s: float) -> list[float] | None:
        """Readings of the sonars of the configuration, in its order; None while one of them is missing."""
        config, found = self._config, list[float]()
        for number in config.sonars:
            read_s, range_m = self._ranges.get(number, (-inf, 0.0))
            if now_s - read_s > config.sonar_timeout_s:
                return None
            found.append(min(range_m, config.sonar_max_m))
        return found

    def fault(self, now_s: float) -> str:
        """The reason why the wheels cannot be measured or driven; empty if they can."""
        age_s = now_s - max(min(self._counts_s, self._standard_s), -1e6)
        if self._stage != _RUNS or age_s > self._config.timeout_s:
            return f"no packet for {age_s:.2f} s: {self.why()}" if self._counts_s > -inf else self.why()
        if len(self._jumps_s) == _JUMPS and now_s - self._jumps_s[0] < _JUMPS_S:
            return "the encoders show impossible speeds; check their cables, and devices.base.counts_per_mm"
        if self._doubts >= 10:
            return "the encoders contradict the speeds of the base; correct devices.base.counts_per_mm"
        return ""
