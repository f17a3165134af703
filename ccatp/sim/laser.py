"""The simulated laser metrology: lengths with noise, error flags, motion tolerance.

The noise of a length is a function of (seed, time of the puck, channel) alone, not of earlier requests: a second
client, a repeated request or another order of channels never changes the lengths of a survey.
"""

import math
from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np

from ccatp.config.models import SimEtalonConfig
from ccatp.core import FloatArray, Vector3
from ccatp.links.multiline import FLAGS, ChannelRecord, Environment

# Air on a high site. Lengths are already corrected for refraction, so they do not depend on it.
AIR = Environment(temperature_c=-5.0, pressure_hpa=525.0, humidity_pct=30.0)

_INTENSITY = (400, 2000)  # least and largest counts of a good return; arbitrary units
_LENGTH_DECIMALS = 6  # of a millimetre: a thousandth of the smallest noise that matters
_WORD = 2**64 - 1
SEED_STREAM = 2
"""The laser's stream of random numbers: with the run's seed it makes the seed of its generator."""


class PuckTruth(msgspec.Struct, frozen=True, rename={"t_s": "t", "position_m": "puck"}):
    """Centre of the puck, world frame, and its largest distance from there within the last measuring time."""

    t_s: float
    position_m: Vector3
    moved_m: float


class EtalonModel:
    """Channels that measure the puck from known collimators, world frame, shape (k, 3); ``rng`` is drawn from once.

    Raises ``ValueError`` if the numbers of channels and collimators differ.
    """

    def __init__(
        self, cfg: SimEtalonConfig, channels: Sequence[int], collimators_m: FloatArray, rng: np.random.Generator
    ) -> None:
        if np.shape(collimators_m) != (len(channels), 3):
            raise ValueError(f"{len(channels)} channels, collimators of shape {np.shape(collimators_m)}")
        self._cfg = cfg
        rows: list[list[float]] = np.asarray(collimators_m, dtype=np.float64).tolist()
        self._collimators = dict(zip(channels, rows, strict=True))
        self._key = int(rng.integers(2**63))
        self.blocked: set[int] = set()
        self.flags: dict[int, set[str]] = {}  # further error flags to raise, out of FLAGS, by channel
        self.faults: tuple[Any, ...] = ()  # of a plan, signal "laser"
        self._held: dict[Any, Any] = {}  # by fault, what it keeps from its begin
        self.laser_ready = True  # while false, each record carries ``laser_temp_error``
        self.environment = AIR

    @property
    def channels(self) -> tuple[int, ...]:
        """The installed channels."""
        return tuple(self._collimators)

    def records(self, channels: Sequence[int], puck: PuckTruth | None) -> tuple[ChannelRecord, ...]:
        """One record per requested channel, in the order of the request.

        The length is |puck - collimator| plus noise of sigma = length_sigma_m + length_sigma_per_m * length. A channel
        that is not installed gives ``daq_error`` and the length 0, a blocked one ``beam_break`` and the length 0, a
        puck that moved further than the tolerance ``motion_tolerance_error``. Without ``puck`` each record is that of a
        channel that is not installed.
        """
        return tuple(self._record(channel, puck) for channel in channels)

    def _record(self, channel: int, puck: PuckTruth | None) -> ChannelRecord:
        collimator = self._collimators.get(channel)
        if puck is None or collimator is None:
            return self._format(channel, 0.0, {"daq_error"})
        flags = set(self.flags.get(channel, ()))
        if not puck.moved_m <= self._cfg.motion_tolerance_m:
            flags.add("motion_tolerance_error")
        if not self.laser_ready:
            flags.add("laser_temp_error")
        if channel in self.blocked:
            return self._format(channel, 0.0, flags | {"beam_break"})
        active = [(key, one) for key, one in enumerate(self.faults) if one.is_active(puck.t_s)]
        position_m = puck.position_m
        at_m = collimator
        for key, fault in active:
            if fault.type == "at_rest":
                position_m = self._held.setdefault(key, position_m)
            if fault.type == "moved" and fault.channel == channel:
                at_m = [place + move for place, move in zip(at_m, fault.by_m, strict=True)]
        length_m = math.dist(at_m, position_m)
        sigma_m = self._cfg.length_sigma_m + self._cfg.length_sigma_per_m * length_m
        error_m = sigma_m * self._noise(puck.t_s, channel)
        found_m = length_m + error_m
        for key, fault in active:
            if getattr(fault, "channel", channel) in (None, channel):
                found_m = self._with_fault(fault, (key, channel), puck.t_s, found_m, error_m)
        return self._format(channel, found_m, flags)

    def _with_fault(self, fault: Any, key: tuple[int, int], t_s: float, length_m: float, error_m: float) -> float:
        match fault.type:
            case "offset":
                return length_m + float(fault.offset_m)
            case "drift":
                return length_m + float(fault.rate_m_s) * (t_s - float(fault.at_s))
            case "scale_drift":
                return length_m * (1.0 + float(fault.rate_1_s) * (t_s - float(fault.at_s)))
            case "scaled":
                return length_m * float(fault.factor)
            case "rounded":
                return round(length_m / float(fault.to_m)) * float(fault.to_m)
            case "frozen":
                return float(self._held.setdefault(key, length_m))
            case "noisy":
                return length_m + (float(fault.factor) - 1.0) * error_m
        return length_m

    def _noise(self, t_s: float, channel: int) -> float:
        """Standard normal number, a function of this channel and this time (rounded to a microsecond)."""
        # A counter-based generator: the key selects the stream, a high word of the counter the time; the low words
        # count the draws.
        counter = np.array([0, 0, round(t_s * 1e6) & _WORD, 0], dtype=np.uint64)
        key = np.array([self._key, channel], dtype=np.uint64)
        return float(np.random.Generator(np.random.Philox(counter=counter, key=key)).standard_normal())

    def _format(self, channel: int, length_m: float, flags: set[str]) -> ChannelRecord:
        air = self.environment.temperature_c, self.environment.pressure_hpa, self.environment.humidity_pct
        low, high = _INTENSITY if length_m and "intensity_error" not in flags else (0, 0)
        length_mm, raised = round(length_m * 1e3, _LENGTH_DECIMALS), (int(name in flags) for name in FLAGS)
        return ChannelRecord(channel, length_mm, low, high, *air, *raised)
