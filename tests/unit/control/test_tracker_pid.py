"""The PID controller of eq. 3.4."""

from math import cos, exp, sin

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ccatp.config.models import Config, PidConfig, RobotConfig
from ccatp.control.axis import ProfiledAxis, lag_feed_forward
from ccatp.control.pid import Pid, PidState
from ccatp.control.profile import Profile
from ccatp.control.wheel_motion import SentDrives
from ccatp.core import Predicted, Twist
from ccatp.kinematics import wheel_rates


def gains(kp: float, ki: float, kd: float, integral_limit: float = 10.0, filter_s: float = 0.0) -> PidConfig:
    return PidConfig(kp=kp, ki=ki, kd=kd, derivative_filter_s=filter_s, integral_limit=integral_limit)


class KeptPid:
    """A PID with its memory."""

    def __init__(self, gains: PidConfig, limit: float) -> None:
        self._pid, self._memory = Pid(gains, limit), PidState()

    def step(self, error: float, dt_s: float) -> float:
        self._memory, output = self._pid.step(self._memory, error, dt_s)
        return output


def test_integral_counts_seconds_not_steps() -> None:
    outputs = []
    for dt in (0.1, 0.01):
        pid = KeptPid(gains(0.0, 0.5, 0.0), 10.0)
        for _ in range(round(1.0 / dt)):
            output = pid.step(1.0, dt)
        outputs.append(output)
    assert outputs == pytest.approx([0.5, 0.5])


def test_output_is_limited_and_does_not_wind_up() -> None:
    pid = KeptPid(gains(1.0, 1.0, 0.0), 0.1)
    for _ in range(1000):
        assert pid.step(1.0, 0.01) == 0.1
    # Ten seconds of saturation have left nothing to undo: the output follows the error's sign at once.
    assert pid.step(-0.05, 0.01) < 0.0


def test_dt_must_be_positive() -> None:
    with pytest.raises(ValueError, match="dt of a control step must be positive"):
        KeptPid(gains(1.0, 0.0, 0.0), 1.0).step(1.0, 0.0)


DT, LAG, V_MAX, A_MAX = 0.01, 0.08, 0.1, 0.2


class KeptAxis:
    """An axis with the motion under way."""

    def __init__(self, axis: ProfiledAxis) -> None:
        self._axis, self.motion = axis, axis.begin(0.0)

    def begin(self, remaining: float) -> None:
        self.motion = self._axis.begin(remaining)

    def step(self, remaining: float, dt_s: float, speed: float) -> float:
        self.motion, set_point = self._axis.step(self.motion, remaining, dt_s, speed)
        return set_point

    def is_over(self, remaining: float, tolerance: float, speed: float | None) -> bool:
        return self._axis.is_over(self.motion, remaining, tolerance, speed)


@pytest.fixture
def axis(config: Config) -> KeptAxis:
    gains = config.control.gain_sets["shipped"].forward
    return KeptAxis(ProfiledAxis(gains, config.control, V_MAX, A_MAX, LAG))


def driven(axis: KeptAxis, lag_share: float) -> float:
    """Along the plan by half of 0.2 m, with wheels of which only a share reaches the ground."""
    axis.begin(0.2)
    travelled = speed = output = 0.0
    for _ in range(120):
        output = axis.step(0.2 - travelled, DT, speed)
        speed += (output * lag_share - speed) * DT / LAG
        travelled += speed * DT
    return output


def test_on_its_plan_it_asks_for_the_plan_and_the_servos_lag(axis: KeptAxis) -> None:
    axis.begin(0.2)
    # T a on top of the speed, and half a frame of acceleration: (1 - exp(-dt/T))^-1 = T/dt + 1/2 + ...
    assert axis.step(0.2, DT, 0.0) == pytest.approx(A_MAX * (LAG + 0.5 * DT), rel=1e-2)


def test_behind_the_plan_or_slower_than_it_asks_for_more(axis: KeptAxis, config: Config) -> None:
    gains = config.control.gain_sets["shipped"].forward
    outputs = []
    for remaining, speed in ((0.2, 0.0), (0.201, 0.0), (0.2, -0.01)):
        axis.begin(0.2)
        outputs.append(axis.step(remaining, DT, speed))
    assert outputs[1] - outputs[0] == pytest.approx(gains.kp * 0.001)
    assert outputs[2] - outputs[0] == pytest.approx(gains.kd * 0.01)


def test_it_learns_the_share_that_is_lost(axis: KeptAxis) -> None:
    assert driven(axis, 1.0) == pytest.approx(V_MAX, rel=0.01)
    # Within 1.2 s the body comes nearly up to speed; the rest is feedback.
    assert driven(axis, 0.95) == pytest.approx(V_MAX / 0.95, rel=0.015)


def test_the_end_includes_the_travel_while_the_wheels_run_down(axis: KeptAxis) -> None:
    axis.begin(0.0)
    assert axis.is_over(0.0008, 0.0002, 0.01)  # 10 mm/s for 80 ms
    assert not axis.is_over(0.0, 0.0002, 0.01)
    assert axis.is_over(0.0001, 0.0002, None)


def test_an_end_far_off_is_followed_by_another_motion(axis: KeptAxis) -> None:
    axis.begin(0.0)
    durations_s = []
    for remaining in (0.001, -0.02, 0.05):  # the last while one is under way
        axis.step(remaining, DT, 0.0)
        durations_s.append(axis.motion.duration_s)
    further_s = DT + 2.0 * (0.02 / A_MAX) ** 0.5
    assert durations_s == pytest.approx([0.0, further_s, further_s])


def test_trapezoid_takes_the_bang_bang_time() -> None:
    profile = Profile.rest_to_rest(0.22, 0.1, 0.2)
    # d/v + v/a
    assert profile.duration_s == pytest.approx(0.22 / 0.1 + 0.1 / 0.2, abs=1e-12)
    assert profile.at(profile.duration_s) == (0.22, 0.0)


@pytest.mark.parametrize(("v", "a"), [(0.0, 1.0), (1.0, 0.0), (-1.0, 1.0)])
def test_limits_must_be_positive(v: float, a: float) -> None:
    with pytest.raises(ValueError, match="must be positive"):
        Profile.rest_to_rest(1.0, v, a)


@given(st.floats(-5.0, 5.0), st.floats(0.01, 1.0), st.floats(0.05, 4.0), st.floats(0.0, 1.0), st.floats(1e-4, 0.02))
def test_limits_hold_and_velocity_is_the_derivative(d: float, v: float, a: float, part: float, h: float) -> None:
    profile = Profile.rest_to_rest(d, v, a)
    t = part * profile.duration_s
    position, speed = profile.at(t)
    assert abs(speed) <= v * (1.0 + 1e-12)
    assert abs(position) <= abs(d) + 1e-12
    later = profile.at(t + h)
    # The speed changes by at most a h within h, so the mean speed lies within a h of the speed.
    assert abs(later[1] - speed) <= a * h + 1e-12
    assert abs((later[0] - position) / h - speed) <= a * h + 1e-9


def test_feed_forward_inverts_the_servo_lag() -> None:
    lag, dt, now, after = 0.08, 0.01, 0.04, 0.042
    set_point = lag_feed_forward(now, after, dt, lag)
    reached = set_point + (now - set_point) * exp(-dt / lag)
    assert reached == pytest.approx(after, abs=1e-15)
    assert lag_feed_forward(now, after, dt, 0.0) == after


DT_PREDICTION, LAG_PREDICTION = 0.01, 0.08
POSE = (0.1, -0.2, 0.7)


def rolled(commands: list[tuple[float, float]], v: float, omega: float, steps: int = 1000) -> Predicted:
    """Fine Euler steps of the same servo and body."""
    x, y, heading = POSE
    for v_set, omega_set in commands:
        h = DT_PREDICTION / steps
        for _ in range(steps):
            x, y, heading = x + h * v * cos(heading), y + h * v * sin(heading), heading + h * omega
            v, omega = v + h * (v_set - v) / LAG_PREDICTION, omega + h * (omega_set - omega) / LAG_PREDICTION
    return Predicted((x, y, heading), v, omega)


class Sender:
    """Drives given as velocities."""

    def __init__(self, robot: RobotConfig) -> None:
        robot = robot.model_copy(update={"wheel_lag_s": LAG_PREDICTION})
        self.drives = SentDrives(robot, DT_PREDICTION)
        self.ahead, self._geometry = self.drives.ahead, (robot.wheel_radius_m, robot.wheel_base_m)

    def add(self, seq: int, v_m_s: float, omega_rad_s: float) -> None:
        self.drives.add(seq, *wheel_rates(Twist(v_m_s, omega_rad_s), *self._geometry))


@pytest.fixture
def sender(config: Config) -> Sender:
    return Sender(config.robot)


@pytest.fixture
def predictor(sender: Sender) -> Sender:
    for seq in range(1, 7):
        sender.add(seq, 0.01 * seq, 0.1 * seq)
    return sender


def test_without_delay_the_estimate_is_returned_unchanged(predictor: Sender) -> None:
    assert predictor.ahead(POSE, 0.05, 0.3, 6, DT_PREDICTION, False, (0.05, 0.05)) == Predicted(POSE, 0.05, 0.3)


def test_commands_on_the_way_act_for_a_frame_each(predictor: Sender) -> None:
    ahead = predictor.ahead(POSE, 0.05, 0.3, 3, DT_PREDICTION, False)
    expected = rolled([(0.04, 0.4), (0.05, 0.5), (0.06, 0.6)], 0.05, 0.3)
    # Steps of 10 us are good to 1e-6 of the 1.5 mm and 9 mrad travelled; the midpoint rule to less.
    assert ahead.pose == pytest.approx(expected.pose, abs=1e-6)
    assert (ahead.v_m_s, ahead.omega_rad_s) == pytest.approx((expected.v_m_s, expected.omega_rad_s), abs=1e-4)


def test_an_echo_younger_than_a_frame_acts_for_the_rest_of_it(predictor: Sender) -> None:
    fresh = predictor.ahead(POSE, 0.05, 0.3, 6, 0.0, False)
    keep = exp(-DT_PREDICTION / LAG_PREDICTION)
    assert fresh.v_m_s == pytest.approx(0.06 - 0.01 * keep)
    assert predictor.ahead(POSE, 0.05, 0.3, 6, 0.4 * DT_PREDICTION, False).v_m_s < fresh.v_m_s


def test_held_wheels_run_down_whatever_was_sent(predictor: Sender) -> None:
    assert predictor.ahead(POSE, 0.0, 0.0, 2, DT_PREDICTION, True) == Predicted(POSE, 0.0, 0.0)
    assert predictor.ahead(POSE, 0.05, 0.0, 2, DT_PREDICTION, True).v_m_s == pytest.approx(
        0.05 * exp(-4 * DT_PREDICTION / LAG_PREDICTION)
    )


def test_a_new_session_drops_the_sent_drives(predictor: Sender) -> None:
    predictor.add(1, 0.0, 0.0)
    assert predictor.ahead(POSE, 0.0, 0.0, -1, DT_PREDICTION, False) == Predicted(POSE, 0.0, 0.0)
    predictor.add(2, 0.1, 0.0)
    predictor.drives.begin_session(DT_PREDICTION)
    assert predictor.ahead(POSE, 0.0, 0.0, -1, DT_PREDICTION, False) == Predicted(POSE, 0.0, 0.0)


def test_the_reach_is_bounded(sender: Sender) -> None:
    for seq in range(1000):
        sender.add(seq, 0.1, 0.0)
    ahead = sender.ahead((0.0, 0.0, 0.0), 0.1, 0.0, -1, 9.0, False)
    assert ahead.pose[0] == pytest.approx(0.1 * 0.25)  # a quarter of a second: the time-to-live of a drive


def test_a_frame_takes_time(config: Config) -> None:
    with pytest.raises(ValueError, match=r"frame_s = 0\.0: the period of the frames must be positive"):
        SentDrives(config.robot, 0.0)


def test_the_span_begins_with_the_drive_in_force(config: Config) -> None:
    drives = SentDrives(config.robot, DT_PREDICTION)
    for seq, rates in enumerate([(1.0, -1.0), (3.0, -2.0), (2.0, 0.5)]):
        drives.add(seq, *rates)
    assert drives.take_span() == (0.0, 3.0, -2.0, 0.5)
    assert drives.take_span() == (2.0, 2.0, 0.5, 0.5)
    drives.add(3, 0.0, 0.0)
    assert drives.take_span() == (0.0, 2.0, 0.0, 0.5)
