"""From voltages of an edge sensor to bits."""

from math import nan

import pytest

from ccatp.config.onboard_models import EdgeThresholdConfig
from ccatp.onboard.edge_threshold import EdgeThreshold

ABOVE = EdgeThresholdConfig(threshold_v=1.5, hysteresis_v=0.4, debounce_s=0.002, is_panel_above=True)


def bits(cfg: EdgeThresholdConfig, *voltages: float) -> list[int]:
    """Readings at 1 kHz."""
    sensor = EdgeThreshold(cfg)
    return [sensor.read(0.001 * k, voltage_v) for k, voltage_v in enumerate(voltages)]


@pytest.mark.parametrize(
    ("voltages", "expected"),
    [
        ((2.0, 2.0), [1, 1]),  # the first sample decides at once
        ((1.6, 1.6, 1.8), [0, 0, 0]),  # within the band it is no panel until it was above it
        ((2.0, 1.4, 1.31, 1.29), [1, 1, 1, 0]),  # hysteresis
        ((2.0, 0.5, 2.0, 2.0, 2.0), [1, 0, 0, 0, 1]),  # to no panel at once, back after 2 ms
        ((2.0, 0.5, 2.0, 0.5, 2.0, 2.0, 2.0), [1, 0, 0, 0, 0, 0, 1]),  # a flicker begins the 2 ms again
        ((nan, 2.0), [0, 0]),
        ((2.0, nan, 2.0), [1, 0, 0]),
    ],
)
def test_threshold_hysteresis_and_debouncing(voltages: tuple[float, ...], expected: list[int]) -> None:
    assert bits(ABOVE, *voltages) == expected


def test_a_sensor_that_gives_less_over_a_panel() -> None:
    below = ABOVE.model_copy(update={"is_panel_above": False})
    assert bits(below, 1.0, 1.6, 1.71) == [1, 1, 0]
    assert bits(below, 2.0) == [0]
