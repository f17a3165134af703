"""Tuning of free wheels against the simulated motors."""

from collections.abc import Callable

import numpy as np
import pytest

from ccatp.config.load import load_config, load_onboard_config
from ccatp.mirror.mirror import build_mirror
from ccatp.onboard.hardware import HardwareError, Readings
from ccatp.onboard.tuning import Tuning, tune
from ccatp.sim.hardware import MOTOR_12V, Motor, SimulatedHardware

CFG = load_onboard_config().servo


class Lifted:
    """A robot whose wheels are free, and its time."""

    def __init__(self, motor: Motor = MOTOR_12V) -> None:
        cfg = load_config()
        rng = np.random.default_rng(1)
        self.hardware = SimulatedHardware(
            cfg, build_mirror(cfg.mirror), rng, loop_hz=CFG.loop_hz, counts_per_rev=CFG.counts_per_rev, motor=motor,
            is_lifted=True,
        )  # fmt: skip
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
