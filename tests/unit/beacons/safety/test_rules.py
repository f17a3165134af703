"""Danger rules of a robot among beacons: silent radios, old estimates, obstacles where the wheels have carried them."""

from math import pi, radians

import pytest
from msgspec.structs import replace

from ccatp.beacons.config.models import RadioConfig
from ccatp.beacons.links.messages import BeaconFrame, MoteBurst, RadioSample, RadioScan
from ccatp.beacons.safety.rules import BeaconSafetyRules
from ccatp.conditions.danger import ENCODERS_STALE
from ccatp.core import Verdict, WheelSample
from ccatp.links.robot_messages import CommandEcho, Sensors
from ccatp.links.topics import EstimateMessage
from tests.support.scenario import radio_config_of

DT = 0.125  # exact in binary


class Drive:
    """Frames at 8 Hz; what is not given is as in a robot that drives well."""

    def __init__(self, cfg: RadioConfig) -> None:
        self.cfg, self.rules, self.seq = cfg, BeaconSafetyRules(cfg), 0

    def frame(
        self,
        extras: BeaconFrame | None = None,
        right: float | None = 0.0,
        left: float | None = 0.0,
        estimate_age_s: float | None = 0.0,
        sigma_m: float = 0.1,
    ) -> Verdict:
        """The verdict on the next frame; ``estimate_age_s``: None without an estimate."""
        self.seq += 1
        t_s = self.seq * DT
        sensors = Sensors(
            self.seq, t_s, [], [WheelSample(t_s, right, left)], [], None, (0.0, 0.0), 1.0,
            CommandEcho(self.seq, 0.0, 0.0, False), [],
        )  # fmt: skip
        estimate = None
        if estimate_age_s is not None:
            estimate = EstimateMessage(
                seq=self.seq,
                t_s=t_s - estimate_age_s,
                x_m=0.0,
                y_m=0.0,
                heading_rad=0.0,
                sigma_m=sigma_m,
                state="visiting",
            )
        heard = BeaconFrame(radio=[RadioSample(t_s, "beacon1", -50.0, None)])
        return self.rules.step(sensors, heard if extras is None else extras, estimate)


@pytest.fixture
def drive() -> Drive:
    return Drive(radio_config_of("zigbee"))


def test_an_estimate_that_is_too_old_holds_and_one_that_never_came_soon_does(drive: Drive) -> None:
    limit_s = drive.cfg.danger.estimate_timeout_s
    assert not drive.frame(estimate_age_s=limit_s).cause
    old = drive.frame(estimate_age_s=limit_s + 0.01)
    assert (old.cause.condition, any(old.permits)) == ("no_fresh_estimate", False)
    assert old.value == pytest.approx(limit_s + 0.01)
    never = Drive(drive.cfg)
    verdicts = [never.frame(estimate_age_s=None) for _ in range(round(limit_s / DT) + 1)]
    assert [bool(one.cause) for one in verdicts] == [False] * (len(verdicts) - 1) + [True]
    assert verdicts[-1].value == 1e9  # infinite cannot travel


@pytest.mark.parametrize(
    ("extras", "is_reading"),
    [
        (BeaconFrame(), False),
        (BeaconFrame(radio=[RadioSample(0.0, "target", -50.0, None)]), False),  # what is followed moves
        (BeaconFrame(scan=RadioScan(0.0, radians(9.0), {"beacon1": [None, None]})), False),
        (BeaconFrame(scan=RadioScan(0.0, radians(9.0), {"beacon1": [None, -50.0]})), True),
        (BeaconFrame(motes=[MoteBurst(0.0, "mote1", "robot", 20.0, [0.01])]), True),
    ],
)
def test_only_readings_of_what_stands_show_that_the_radios_work(extras: BeaconFrame, is_reading: bool) -> None:
    drive = Drive(radio_config_of("follow"))
    limit_s = drive.cfg.danger.radio_timeout_s
    drive.frame()
    verdicts = [drive.frame(extras) for _ in range(round(limit_s / DT) + 2)]
    silent = [one for one in verdicts if one.signal == "radio"]
    assert bool(silent) is not is_reading
    if silent:
        assert len(silent) == 2
        assert silent[0].value == pytest.approx(limit_s + DT)
        assert not any(silent[0].permits)


def test_a_wheel_that_gives_no_sample_is_silent(drive: Drive) -> None:
    frames = round(drive.cfg.danger.stale_after_s / DT) + 2
    for gap in ({"right": None}, {"left": None}):
        drive = Drive(drive.cfg)
        drive.frame()
        verdicts = [drive.frame(**gap) for _ in range(frames)]  # type: ignore[arg-type]
        assert verdicts[-1].cause == ENCODERS_STALE.cause()
        assert not any(verdicts[-1].permits)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_an_obstacle_is_where_the_wheels_have_carried_the_robot_to(sign: float) -> None:
    """It was seen once; ahead (or, in reverse, behind) motion is barred as soon as dead reckoning is too near."""
    drive = Drive(radio_config_of("zigbee", vehicle__kind="differential"))
    danger, rate = drive.cfg.danger, 2.0
    radius_m, sensors = drive.cfg.robot.wheel_radius_m, drive.cfg.avoidance.sensors_rad
    half_turn = pi * drive.cfg.vehicle.track_m / (2.0 * radius_m * 10 * DT)  # of both wheels, in ten frames
    toward = min(range(len(sensors)), key=lambda k: abs(sensors[k]))
    begin_m = danger.obstacle_m + 0.3
    distances = [begin_m if k == toward else 10.0 for k in range(len(sensors))]
    extras = BeaconFrame(radio=[RadioSample(0.0, "beacon1", -50.0, None)])
    drive.frame(replace(extras, distances=distances))
    if sign < 0.0:
        assert all(all(drive.frame(extras, half_turn, -half_turn).permits) for _ in range(10))
    count = 1
    while drive.frame(extras, sign * rate, sign * rate).signal != "obstacle":
        count += 1
    left_m = begin_m - count * DT * rate * radius_m
    assert left_m < danger.obstacle_m <= left_m + DT * rate * radius_m
    verdict = drive.frame(extras)
    assert tuple(verdict.permits) == ((False, True, True) if sign > 0.0 else (True, False, True))
    for _ in range(10):
        verdict = drive.frame(extras, half_turn, -half_turn)
    assert tuple(verdict.permits) == ((True, False, True) if sign > 0.0 else (False, True, True))
    # It is forgotten after a time.
    for _ in range(round(danger.memory_s / DT)):
        verdict = drive.frame(replace(extras, distances=[10.0] * len(sensors)))
    assert all(verdict.permits)


def test_a_line_without_its_extra_keys_and_a_frame_that_is_not_new_permit_nothing(drive: Drive) -> None:
    drive.frame()
    sensors = Sensors(
        2, 0.2, [], [WheelSample(0.2, 0.0, 0.0)], [], None, (0.0, 0.0), 1.0, CommandEcho(2, 0.0, 0.0, False), []
    )
    estimate = EstimateMessage(seq=2, t_s=0.2, x_m=0.0, y_m=0.0, heading_rad=0.0, sigma_m=0.1, state="visiting")
    assert not any(drive.rules.judge(sensors, b"{", estimate).permits)
    assert all(drive.rules.judge(sensors, b'{"type":"sensors"}', estimate).permits)
    assert not any(drive.rules.judge(sensors, b'{"type":"sensors"}', estimate).permits)  # the same again
    garbled = drive.rules.garbled(2, 0.2, 0.0)
    assert garbled is not None
    assert not any(garbled.permits)


def test_what_was_denied_is_counted_by_its_signal(drive: Drive) -> None:
    drive.frame()
    for _ in range(3):
        drive.frame(sigma_m=drive.cfg.danger.position_sigma_m + 0.01)
    assert drive.rules.counts == {"denied": {"position": 3}}
