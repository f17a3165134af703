"""Pure. Range from the time between a radio message and an ultrasonic pulse, with the air's temperature in it."""

from math import sqrt
from typing import NamedTuple

ABSOLUTE_ZERO_C = -273.15
COLDEST_C, HOTTEST_C = -60.0, 80.0  # beyond, a thermometer is broken


class TdoaError(ValueError):
    """A delay or a temperature that no range can be made of."""


class Air(NamedTuple):
    """The speed of sound, known at one temperature.

    Attributes:
        sound_speed_m_s: at ``temperature_c``.
        temperature_c: degrees Celsius.
    """

    sound_speed_m_s: float
    temperature_c: float


class MoteRange(NamedTuple):
    """One distance between two motes.

    Attributes:
        first, second: names of the motes.
        range_m: their distance.
        sigma_m: its standard deviation.
    """

    first: str
    second: str
    range_m: float
    sigma_m: float


def sound_speed(air: Air, temperature_c: float) -> float:
    """Speed of sound c = c_0 sqrt(T / T_0), T in kelvin: that of an ideal gas.

    Args:
        air: c_0 and T_0.
        temperature_c: degrees Celsius.

    Raises:
        TdoaError: no temperature of air.
    """
    if not COLDEST_C <= temperature_c <= HOTTEST_C:
        raise TdoaError(f"temperature of {temperature_c:g} C is outside {COLDEST_C:g} to {HOTTEST_C:g} C")
    return air.sound_speed_m_s * sqrt((temperature_c - ABSOLUTE_ZERO_C) / (air.temperature_c - ABSOLUTE_ZERO_C))


def range_from_delay(air: Air, delay_s: float, temperature_c: float) -> float:
    """Distance d = c(T) (t_2 - t_1), Patil et al. eq. 1; the radio message takes no time.

    Args:
        air: what is known of the speed of sound.
        delay_s: arrival of the pulse after that of the message.
        temperature_c: as the listener's thermometer tells.

    Raises:
        TdoaError: a delay that is negative or not finite, or no temperature of air.
    """
    if not 0.0 <= delay_s < float("inf"):
        raise TdoaError(f"delay of {delay_s:g} s: the pulse cannot arrive before the message")
    return sound_speed(air, temperature_c) * delay_s


def range_sigma(
    sigma_m: float, range_m: float, temperature_sigma_c: float, temperature_c: float, repeats: int
) -> float:
    """Standard deviation of the mean of repeated ranges.

    sigma^2 = sigma_1^2 / n + (d sigma_T / (2 T))^2: repeating lessens the noise of a reading, not what a wrong
    thermometer does, dc/c = dT / (2 T).

    Args:
        sigma_m: of one reading.
        range_m: the distance d.
        temperature_sigma_c: of the thermometer.
        temperature_c: T, in degrees Celsius.
        repeats: n.
    """
    scale = temperature_sigma_c / (2.0 * (temperature_c - ABSOLUTE_ZERO_C))
    return sqrt(sigma_m**2 / repeats + (range_m * scale) ** 2)
