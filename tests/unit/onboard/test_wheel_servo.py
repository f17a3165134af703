"""The speed controller of a wheel against a geared DC motor, and its tuning on free wheels."""

from collections.abc import Callable
from itertools import pairwise
from math import exp, floor, pi

import numpy as np
import pytest

from ccatp.config.load import load_config, load_onboard_config
from ccatp.config.onboard_models import WheelServoConfig
from ccatp.mirror.mirror import build_mirror
from ccatp.onboard.hardware import HardwareError, Readings
from ccatp.onboard.tuning import Tuning, tune
from ccatp.onboard.wheel_servo import WheelServo
from ccatp.sim.hardware import MOTOR_12V, DriveTrain, Motor, SimulatedHardware

DT_S = 0.002
TIME_CONSTANT_S = 0.0157


class Wheel:
    """A motor, its encoder and the servo; steps of ``DT_S``."""

    def __init__(self, load_nm: float = 0.0, **changes: float) -> None:
        self.cfg: WheelServoConfig = load_onboard_config().servo.model_copy(update=changes)
        self.servo, self.load_nm = WheelServo(self.cfg), load_nm
        self.t_s = self.angle_rad = self.rate_rad_s = 0.0
        self.rates: list[float] = []
        self.volts: list[float] = []
        self.is_blocked = False

    def run(self, duration_s: float, set_point_rad_s: float) -> list[float]:
        """True speeds of a time with one set point."""
        start = len(self.rates)
        for _ in range(round(duration_s / DT_S)):
            self.servo.count(self.t_s, floor(self.angle_rad * self.cfg.counts_per_rev / (2.0 * pi)))
            voltage_v = self.servo.step(DT_S, set_point_rad_s)
            end_rad_s = 0.0 if self.is_blocked else MOTOR_12V.steady_rad_s(voltage_v, self.load_nm)
            decay = exp(-DT_S / TIME_CONSTANT_S)
            self.rate_rad_s = 0.0 if self.is_blocked else end_rad_s + (self.rate_rad_s - end_rad_s) * decay
            self.angle_rad += self.rate_rad_s * DT_S
            self.t_s += DT_S
            self.volts.append(voltage_v)
            self.rates.append(self.rate_rad_s)
        return self.rates[start:]


@pytest.mark.parametrize("load_nm", [0.0, 0.066, -0.066])  # M1's steepest slope with a wheel of 30 mm
@pytest.mark.parametrize("speed_rad_s", [0.3, 3.0, -3.0, 8.0])
def test_the_wheel_follows_the_first_order_response(speed_rad_s: float, load_nm: float) -> None:
    wheel = Wheel(load_nm)
    wheel.run(1.0, 0.0)  # the load is taken up
    rates = wheel.run(1.0, speed_rad_s)
    wanted = [speed_rad_s * (1.0 - exp(-k * DT_S / wheel.cfg.response_s)) for k in range(len(rates))]
    # At rest friction hides up to 1.3 V of the load, so that much is wrong when a wheel starts with the load.
    assert max(abs(a - b) for a, b in zip(rates, wanted, strict=True)) < 0.1 * abs(speed_rad_s) + 0.7
    assert sum(rates[-100:]) / 100 == pytest.approx(speed_rad_s, abs=0.02)


@pytest.mark.parametrize("load_nm", [0.0, 0.066])
def test_a_stop_does_not_swing_back(load_nm: float) -> None:
    wheel = Wheel(load_nm)
    wheel.run(1.0, 3.0)
    wheel.run(0.8, 0.0)
    at_rest_rad = wheel.angle_rad
    rates = wheel.rates[-round(0.8 / DT_S) :]
    assert min(rates) > -0.15
    wheel.run(2.0, 0.0)
    assert wheel.angle_rad == pytest.approx(at_rest_rad, abs=0.005)  # 0.15 mm at the wheel


def test_voltage_and_its_slope_are_limited() -> None:
    wheel = Wheel(max_v=6.0, slew_v_s=300.0)
    wheel.run(0.2, 8.0)
    wheel.run(0.2, -8.0)
    assert max(map(abs, wheel.volts)) == 6.0
    assert max(abs(b - a) for a, b in pairwise([0.0, *wheel.volts])) <= 300.0 * DT_S + 1e-9


def test_a_voltage_at_its_limit_winds_nothing_up() -> None:
    wheel = Wheel(max_v=6.0)  # enough for 5 of the 8 rad/s
    wheel.run(3.0, 8.0)
    rates = wheel.run(0.6, 1.0)
    assert rates[-1] == pytest.approx(1.0, abs=0.2)
    assert min(rates) > 0.5


def test_a_blocked_wheel_is_stalled_while_it_has_full_voltage() -> None:
    wheel = Wheel()
    wheel.is_blocked = True
    wheel.run(0.4, 3.0)
    assert not wheel.servo.is_stalled
    wheel.run(1.5, 3.0)
    assert wheel.servo.is_stalled
    wheel.run(1.0, 0.0)
    assert not wheel.servo.is_stalled


def test_speed_is_that_of_the_window_and_old_or_equal_times_are_ignored() -> None:
    servo = WheelServo(load_onboard_config().servo.model_copy(update={"counts_per_rev": 2.0 * pi * 100.0}))
    for k in range(20):
        servo.count(0.001 * k, 5 * k)
    assert servo.rate_rad_s == pytest.approx(50.0)
    servo.count(0.019, 1000)
    servo.count(0.001, 1000)
    assert servo.rate_rad_s == pytest.approx(50.0)


def test_after_a_release_nothing_of_before_pushes() -> None:
    wheel = Wheel()
    wheel.run(0.5, 3.0)
    for _ in range(20):  # braked by other means
        wheel.servo.count(wheel.t_s, floor(wheel.angle_rad * wheel.cfg.counts_per_rev / (2.0 * pi)))
        wheel.servo.release()
        wheel.t_s += DT_S
    assert wheel.servo.step(DT_S, 0.0) == 0.0


# -- tuning of free wheels ---------------------------------------------------------------------------------------------

CFG = load_onboard_config().servo


class Lifted:
    """A robot whose wheels are free, and its time."""

    def __init__(self, motor: Motor = MOTOR_12V) -> None:
        cfg = load_config()
        rng = np.random.default_rng(1)
        train = DriveTrain(CFG.loop_hz, CFG.counts_per_rev, motor, is_lifted=True)
        self.hardware = SimulatedHardware(cfg, build_mirror(cfg.mirror), rng, train)
        self.now_s = 0.0

    def sleep(self, wait_s: float) -> None:
        self.now_s += wait_s

    def tune(self, change: Callable[[Readings], Readings] = lambda readings: readings) -> Tuning:
        read = self.hardware.read
        self.hardware.read = lambda now_s: change(read(now_s))  # type: ignore[method-assign]
        return tune(self.hardware, CFG, lambda: self.now_s, self.sleep)


def test_friction_slope_and_time_constant_of_the_motor_are_found() -> None:
    lifted = Lifted()
    found = lifted.tune()
    for wheel in (found.right, found.left):
        assert wheel.static_v == pytest.approx(MOTOR_12V.friction_nm * MOTOR_12V.volt_per_nm, abs=0.05)
        assert wheel.volt_per_rad_s == pytest.approx(MOTOR_12V.volt_per_rad_s, rel=0.01)
        assert wheel.time_constant_s == pytest.approx(lifted.hardware.world.wheels.lag_s, abs=0.01)
        assert wheel.residual_v < 0.05
    assert found.deviation_rad_s < 0.15
    assert found.overshoot_share < 0.1
    assert lifted.hardware.voltages_v == (0.0, 0.0)
    assert set(found.values) <= set(type(CFG).model_fields)


def test_gains_that_it_proposes_follow_a_weaker_motor_as_well() -> None:
    weak = MOTOR_12V._replace(stall_nm=0.5 * MOTOR_12V.stall_nm, friction_nm=0.5 * MOTOR_12V.friction_nm)
    found = Lifted(weak).tune()
    assert found.right.volt_per_rad_s == pytest.approx(weak.volt_per_rad_s, rel=0.01)
    assert found.deviation_rad_s < 0.2


def turned(readings: Readings, right: int, left: int) -> Readings:
    return readings._replace(counts=[(t, right * (r or 0), left * (q or 0)) for t, r, q in readings.counts])


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (
            lambda r: turned(r, -1, 1),
            "the right wheel turns against its voltage: exchange forward_line and reverse_line",
        ),
        (lambda r: turned(r, 1, 0), "the left wheel hardly turns: look at the motor's supply"),
        (lambda r: turned(r, 1, 2), "one of them rubs, or its motor or gear is another one"),
        (lambda r: r._replace(faults={"encoder_left": "no sample for 0.1 s"}), "encoder_left: no sample for 0.1 s"),
    ],
)
def test_what_is_wrong_with_a_wheel_is_said_and_the_motors_brake(
    change: Callable[[Readings], Readings], says: str
) -> None:
    lifted = Lifted()
    with pytest.raises(HardwareError, match=says):
        lifted.tune(change)
    assert lifted.hardware.voltages_v == (0.0, 0.0)
