"""Pure. The inertial unit: acceleration along robot x and angular rate about the normal, with noise and offsets."""

from math import floor

import numpy as np

from ccatp.config.models import WorldConfig
from ccatp.sim.noise import DriftingBias, NoiseStream
from ccatp.sim.plant import Plant
from ccatp.sim.sample_times import SampleTimes

ImuTuple = tuple[float, float, float]

_PER_UNIT = 1e7  # resolution of rates and accelerations: far below every noise, short on the wire


class InertialUnit:
    """Reads ``wz (1 + scale) + bias(t) + noise`` and ``ax + bias(t) + noise``."""

    __slots__ = ("_ax_bias", "_is_drifting", "_noise", "_period_s", "_scale", "_sigma_a", "_sigma_w", "_wz_bias")

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
        self._noise = NoiseStream(noise_rng)
        self._period_s = 1.0 / hz
        self._scale = 1.0 + world.gyroscope_scale_sigma * scale
        self._wz_bias = DriftingBias(
            world.gyroscope_bias_sigma_rad_s * wz_bias, world.gyroscope_bias_walk_rad_s_sqrt_s, wz_walk
        )
        self._ax_bias = DriftingBias(
            world.accelerometer_bias_sigma_m_s2 * ax_bias, world.accelerometer_bias_walk_m_s2_sqrt_s, ax_walk
        )
        self._is_drifting = self._ax_bias.is_drifting or self._wz_bias.is_drifting
        self._sigma_a, self._sigma_w = world.accelerometer_sigma_m_s2, world.gyroscope_sigma_rad_s

    def read(self, plant: Plant, times: SampleTimes) -> list[ImuTuple]:
        """(t, ax, wz) of the frame."""
        noise = self._noise.take(2 * len(times.times_s))
        ax_bias, wz_bias = self._ax_bias, self._wz_bias
        found: list[ImuTuple] = []
        for j, (t, e) in enumerate(zip(times.times_s, times.decays, strict=True)):
            if self._is_drifting:
                ax_bias.step(self._period_s)
                wz_bias.step(self._period_s)
            ax = plant.acceleration_at(e) + ax_bias.value + self._sigma_a * noise[2 * j]
            wz = plant.turn_rate_at(e) * self._scale + wz_bias.value + self._sigma_w * noise[2 * j + 1]
            found.append((t, floor(ax * _PER_UNIT + 0.5) / _PER_UNIT, floor(wz * _PER_UNIT + 0.5) / _PER_UNIT))
        return found
