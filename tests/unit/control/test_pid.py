"""The PID controller of eq. 3.4."""

import pytest

from ccatp.config.models import PidConfig
from ccatp.control.pid import Pid


def gains(kp: float, ki: float, kd: float, integral_limit: float = 10.0, filter_s: float = 0.0) -> PidConfig:
    return PidConfig(kp=kp, ki=ki, kd=kd, derivative_filter_s=filter_s, integral_limit=integral_limit)


def test_proportional() -> None:
    assert Pid(gains(2.0, 0.0, 0.0), 10.0).step(0.5, 0.01) == pytest.approx(1.0)


def test_integral_counts_seconds_not_steps() -> None:
    outputs = []
    for dt in (0.1, 0.01):
        pid = Pid(gains(0.0, 0.5, 0.0), 10.0)
        for _ in range(round(1.0 / dt)):
            output = pid.step(1.0, dt)
        outputs.append(output)
    assert outputs == pytest.approx([0.5, 0.5])


def test_derivative_of_a_ramp_is_its_slope() -> None:
    pid = Pid(gains(0.0, 0.0, 0.1), 10.0)
    assert pid.step(0.0, 0.01) == 0.0
    assert pid.step(0.02, 0.01) == pytest.approx(0.2)


def test_filtered_derivative_lags() -> None:
    pid = Pid(gains(0.0, 0.0, 0.1, filter_s=0.02), 10.0)
    pid.step(0.0, 0.01)
    assert 0.0 < pid.step(0.02, 0.01) < 0.2


def test_output_is_limited_and_does_not_wind_up() -> None:
    pid = Pid(gains(1.0, 1.0, 0.0), 0.1)
    for _ in range(1000):
        assert pid.step(1.0, 0.01) == 0.1
    # Ten seconds of saturation have left nothing to undo: the output follows the error's sign at once.
    assert pid.step(-0.05, 0.01) < 0.0


def test_integral_limit() -> None:
    pid = Pid(gains(0.0, 1.0, 0.0, integral_limit=0.02), 1.0)
    for _ in range(1000):
        output = pid.step(1.0, 0.01)
    assert output == pytest.approx(0.02)


def test_reset_forgets() -> None:
    pid = Pid(gains(1.0, 1.0, 1.0), 10.0)
    first = pid.step(1.0, 0.01)
    pid.step(2.0, 0.01)
    pid.reset()
    assert pid.step(1.0, 0.01) == first


def test_dt_must_be_positive() -> None:
    with pytest.raises(ValueError, match="dt of a control step must be positive"):
        Pid(gains(1.0, 0.0, 0.0), 1.0).step(1.0, 0.0)
