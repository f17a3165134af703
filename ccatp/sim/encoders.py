"""Pure. The wheel encoders: either rates with white noise, or angles that are counted.

An encoder that counts floors the wheel's angle to whole counts at each sample and reports the change since the sample
before as a rate, ``rate = counts (2 pi / counts_per_rev) hz``. The sum of rates times the sample period is the counted
angle exactly, so nothing is rounded here. The place of the first count is drawn for each wheel.
"""

from math import pi

import numpy as np

from ccatp.config.models import WorldConfig
from ccatp.sim.noise import WHOLE
from ccatp.sim.plant import Plant
from ccatp.sim.sample_times import SampleTimes

WheelTuple = tuple[float, float, float]

_PER_UNIT = 1e7  # resolution of rates in rad/s: far below every noise, short on the wire
_BLOCK = 4096  # more than two wheels read in a frame


class RateEncoders:
    """Wheel rates with white noise, right and left independent.

    Args:
        sigma_rad_s: its standard deviation.
        rng: the encoders' own generator.
    """

    __slots__ = ("_next", "_noise", "_rng", "_sigma", "_still")

    def __init__(self, sigma_rad_s: float, rng: np.random.Generator) -> None:
        self._rng = rng
        self._sigma = sigma_rad_s * _PER_UNIT
        self._noise: list[float] = []
        self._still: list[float] = []  # what a wheel at rest reads with that noise
        self._next = 0

    def read(self, plant: Plant, times: SampleTimes) -> list[WheelTuple]:
        """(t, right, left) wheel rates of the frame."""
        times_s = times.times_s
        count = len(times_s)
        if self._next + 2 * count > len(self._noise):
            self._draw()
        start = self._next
        middle, self._next = start + count, start + 2 * count
        if plant.are_wheels_still:
            return list(zip(times_s, self._still[start:middle], self._still[middle : self._next], strict=True))
        right_noise, left_noise = self._noise[start:middle], self._noise[middle : self._next]
        right, right_lag, left, left_lag = plant.servo
        unit, whole = _PER_UNIT, WHOLE
        right, right_lag, left, left_lag = right * unit, right_lag * unit, left * unit, left_lag * unit
        found: list[WheelTuple] = []
        for t, e, a, b in zip(times_s, times.decays, right_noise, left_noise):  # noqa: B905 - of one length; bare it compiles to a plain loop
            found.append(
                (
                    t,
                    (right + right_lag * e + a + whole - whole) / unit,
                    (left + left_lag * e + b + whole - whole) / unit,
                )
            )
        return found

    def _draw(self) -> None:
        fresh = self._sigma * self._rng.standard_normal(_BLOCK)
        self._noise = self._noise[self._next :] + fresh.tolist()
        self._still = self._still[self._next :] + (np.floor(fresh + 0.5) / _PER_UNIT).tolist()
        self._next = 0


class CountingEncoders:
    """Rates that are differences of counted angles.

    Args:
        world: counts in a turn.
        hz: rate of the samples.
        frame_s: period of the frames.
        rng: two draws.
    """

    __slots__ = ("_counts", "_frame_s", "_left_phase", "_per_rad", "_right_phase", "_unit")

    def __init__(self, world: WorldConfig, hz: float, frame_s: float, rng: np.random.Generator) -> None:
        self._per_rad = world.encoder_counts_per_rev / (2.0 * pi)
        self._unit = 2.0 * pi / world.encoder_counts_per_rev * hz
        self._frame_s = frame_s
        self._right_phase, self._left_phase = rng.random(2).tolist()
        self._counts = 0.0, 0.0

    def read(self, plant: Plant, times: SampleTimes) -> list[WheelTuple]:
        """(t, right, left) wheel rates of the frame."""
        if plant.are_wheels_still:
            return [(t, 0.0, 0.0) for t in times.times_s]
        # The angle at tau is angle_0 + set tau + lag T (1 - exp(-tau/T)); all in counts, half a one less, so that
        # rounding finds the whole counts below.
        per_rad, unit, whole = self._per_rad, self._unit, WHOLE
        right, left = self._counts
        right_0, left_0 = plant.start_angles_rad
        right_0, left_0 = right_0 * per_rad + self._right_phase - 0.5, left_0 * per_rad + self._left_phase - 0.5
        right_set, right_lag, left_set, left_lag = plant.servo
        right_per_frame, left_per_frame = right_set * per_rad * self._frame_s, left_set * per_rad * self._frame_s
        right_lag, left_lag = right_lag * per_rad * plant.lag_s, left_lag * per_rad * plant.lag_s
        found: list[WheelTuple] = []
        for t, f, e in zip(times.times_s, times.fractions, times.decays):  # noqa: B905 - of one length; bare it compiles to a plain loop
            gone = 1.0 - e
            right_new = right_0 + right_per_frame * f + right_lag * gone + whole - whole
            left_new = left_0 + left_per_frame * f + left_lag * gone + whole - whole
            found.append((t, (right_new - right) * unit, (left_new - left) * unit))
            right, left = right_new, left_new
        self._counts = right, left
        return found
