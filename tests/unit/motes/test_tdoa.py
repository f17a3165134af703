"""Range from delay: the printed example, temperature, what is refused."""

import pytest

from ccatp.beacons.cricket.range_network import Air, TdoaError, range_from_delay, range_sigma, sound_speed

AIR = Air(344.0, 20.0)


def test_the_printed_example() -> None:
    assert range_from_delay(AIR, 0.006, 20.0) == pytest.approx(2.064, abs=1e-12)


def test_sound_is_faster_in_warm_air() -> None:
    # an ideal gas gains 0.6 m/s a kelvin at room temperature; c(0 C) = 344 sqrt(273.15 / 293.15)
    assert sound_speed(AIR, 21.0) - sound_speed(AIR, 20.0) == pytest.approx(0.587, abs=1e-3)
    assert sound_speed(AIR, 0.0) == pytest.approx(332.06, abs=0.01)


def test_repeats_lessen_noise_but_not_the_thermometer() -> None:
    assert range_sigma(0.006, 5.0, 0.0, 20.0, 9) == pytest.approx(0.002)
    # one kelvin of 293.15: half a part in 293 of 5 m, however often it is repeated
    assert range_sigma(0.006, 5.0, 1.0, 20.0, 10**9) == pytest.approx(5.0 / (2.0 * 293.15), rel=1e-4)


@pytest.mark.parametrize("delay_s", [-1e-6, float("inf"), float("nan")])
def test_impossible_delays(delay_s: float) -> None:
    with pytest.raises(TdoaError, match="cannot arrive before the message"):
        range_from_delay(AIR, delay_s, 20.0)


def test_a_broken_thermometer() -> None:
    with pytest.raises(TdoaError, match="temperature of 851 C is outside"):
        sound_speed(AIR, 851.0)
