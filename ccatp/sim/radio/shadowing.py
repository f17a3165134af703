"""Pure. Static shadowing: the part of a signal strength that belongs to the places of both radios."""

from math import tau

import numpy as np
from numpy.typing import NDArray

_WAVES = 600  # the fourth moment is that of a Gaussian to within 1 / _WAVES


class ShadowingField:
    """A Gaussian random field over the places of receiver and sender, drawn once.

    Its covariance is sigma^2 exp(-d_receiver / L) exp(-d_sender / L), the exponential law of Gudmundson (1991) at both
    ends. It is a sum of plane waves whose wave vectors are drawn from the spectrum of exp(-d / L) in the plane,
    proportional to (1 + (k L)^2)^(-3/2): the share of wave numbers below k is 1 - (1 + (k L)^2)^(-1/2).

    Args:
        sigma_db: standard deviation.
        length_m: L.
        rng: of the draw.
    """

    def __init__(self, sigma_db: float, length_m: float, rng: np.random.Generator) -> None:
        self._amplitude_db = sigma_db * np.sqrt(2.0 / _WAVES)
        self._phases = rng.uniform(0.0, tau, _WAVES)
        self._waves = np.hstack([_wave_vectors(length_m, rng), _wave_vectors(length_m, rng)])

    def at(self, receiver_m: tuple[float, float], sender_m: tuple[float, float]) -> float:
        """Gain over the path loss between two places, dB."""
        if not self._amplitude_db:
            return 0.0
        return float(self._amplitude_db * np.cos(self._waves @ (*receiver_m, *sender_m) + self._phases).sum())


def _wave_vectors(length_m: float, rng: np.random.Generator) -> NDArray[np.float64]:
    share = rng.uniform(0.0, 1.0, _WAVES)
    number = np.sqrt((1.0 - share) ** -2.0 - 1.0) / length_m
    angle = rng.uniform(0.0, tau, _WAVES)
    return np.column_stack([number * np.cos(angle), number * np.sin(angle)])
