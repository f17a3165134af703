"""The configuration of the on-board program: what is refused, and that the shipped one is not."""

import re
from pathlib import Path

import pytest

from ccatp.config.load import load_onboard_config
from ccatp.errors import ConfigError


def test_the_shipped_configuration_holds_and_names_what_is_not_verified() -> None:
    assert load_onboard_config().servo.loop_hz >= 500.0
    text = (Path(__file__).parents[3] / "configs" / "onboard.toml").read_text()
    devices = text[text.index("[devices.bno055]") :]
    for key in ("bus", "axes", "device", "baud", "supply_v", "right", "left", "line"):
        assert re.search(rf"^{key} = .*UNVERIFIED", devices, re.MULTILINE), key


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        ("robot.wheel_radius_m", 0.3, "robot.wheel_radius_m must be between 0.005 and 0.2"),
        ("robot.wheel_base_m", 0.01, "robot.wheel_base_m must be between 0.03 and 1"),
        ("robot.max_wheel_rad_s", 40.0, "robot.max_wheel_rad_s = 40 is 1.2 m/s; the link allows 1"),
        ("robot.edge_sensors_m", [[0.09, -0.08], [0.09, 0.08], [-0.09, 0.08], [-0.09, -0.08]], "is not front-left"),
        ("link.ttl_s", 0.015, "link.ttl_s must last for two frames at least"),
        ("servo.loop_hz", 120.0, "devices.timer.timeout_s = 0.03 brakes a loop with steps of 0.00833333 s"),
        ("servo.max_v", 24.0, "servo.max_v = 24 is more than devices.motors.supply_v = 12"),
        ("servo.static_v", 12.0, "servo.static_v must be below servo.max_v"),
        ("edges.threshold_v", 3.3, "edges.threshold_v and its band must lie between 0 and devices.daq.full_scale_v"),
        ("edges.hysteresis_v", 3.2, "edges.threshold_v and its band must lie between 0"),
        ("devices.daq.battery_empty_v", 12.6, "devices.daq.battery_empty_v must be below"),
        ("devices.bno055.axes", ["x", "y", "w"], "devices.bno055.axes"),
        ("devices.bno055.adress", 0x29, "devices.bno055.adress"),
    ],
)
def test_values_that_do_not_fit_are_refused_with_their_key(key: str, value: object, says: str) -> None:
    with pytest.raises(ConfigError) as refused:
        load_onboard_config(overrides={key: value})
    assert says in str(refused.value)
    assert "\n" not in str(refused.value)
