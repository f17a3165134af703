"""Pure. The inertial unit: acceleration along robot x and angular rate about the normal, with noise and offsets."""

from collections.abc import Callable, Iterator
from itertools import chain

import numpy as np

from ccatp.config.models import WorldConfig
from ccatp.sim.noise import BLOCK, WHOLE, DriftingBias
from ccatp.sim.plant import Plant
from ccatp.sim.sample_times import SampleTimes

ImuTuple = tuple[float, float, float]

_PER_UNIT = 1e7  # resolution of rates and accelerations: far below every noise, short on the wire


class InertialUnit:
    """Reads ``ax + bias(t) + noise`` and ``wz (1 + scale) + bias(t) + noise``.

    What is added does not depend on the motion, so it is made ahead in blocks.
    """

    __slots__ = ("_ax_bias", "_next_errors", "_noise", "_scale", "_sigmas", "_wz_bias")

    def __init__(
        self, world: WorldConfig, hz: float, noise_rng: np.random.Generator, bias_rng: np.random.Generator
    ) -> None:
        """Draw scale and biases: three draws, whatever is switched off.

        Args:
            world: their standard deviations and walks, and the white noise.
            hz: rate of the samples.
            noise_rng: generator of the white noise.
            bias_rng: parent of the generators of scale and biases.
        """
        constants, ax_walk, wz_walk = bias_rng.spawn(3)
        scale, wz_bias, ax_bias = constants.standard_normal(3).tolist()
        self._scale = 1.0 + world.gyroscope_scale_sigma * scale
        self._wz_bias = DriftingBias(
            world.gyroscope_bias_sigma_rad_s * wz_bias, world.gyroscope_bias_walk_rad_s_sqrt_s, 1.0 / hz, wz_walk
        )
        self._ax_bias = DriftingBias(
            world.accelerometer_bias_sigma_m_s2 * ax_bias, world.accelerometer_bias_walk_m_s2_sqrt_s, 1.0 / hz, ax_walk
        )
        self._noise = noise_rng
        self._sigmas = world.accelerometer_sigma_m_s2, world.gyroscope_sigma_rad_s
        blocks: Iterator[list[list[float]]] = iter(self._errors, None)
        self._next_errors: Callable[[], list[float]] = chain.from_iterable(blocks).__next__

    def read(self, plant: Plant, times: SampleTimes) -> list[ImuTuple]:
        """(t, ax, wz) of the frame."""
        unit, whole = _PER_UNIT, WHOLE
        found: list[ImuTuple] = []
        for t, e in zip(times.times_s, times.decays):  # noqa: B905 - of one length; bare it compiles to a plain loop
            ax_error, wz_error = self._next_errors()
            ax = plant.acceleration_at(e) + ax_error
            wz = plant.turn_rate_at(e) * self._scale + wz_error
            found.append((t, (ax * unit + whole - whole) / unit, (wz * unit + whole - whole) / unit))
        return found

    def _errors(self) -> list[list[float]]:
        """Bias and noise of the next samples, acceleration and rate in turn."""
        errors = self._noise.standard_normal((BLOCK // 2, 2)) * self._sigmas
        errors[:, 0] += self._ax_bias.ahead(BLOCK // 2)
        errors[:, 1] += self._wz_bias.ahead(BLOCK // 2)
        rows: list[list[float]] = errors.tolist()
        return rows
