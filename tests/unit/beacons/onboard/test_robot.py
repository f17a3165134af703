"""The robot among beacons over fake devices: rules of the link, holds, scans, frames, and a whole mission."""

import json
from collections.abc import Callable
from typing import Any

import pytest

from ccatp.beacons.links.messages import decode_beacon_frame
from ccatp.beacons.sim.robot import build_beacon_robot
from ccatp.beacons.studies.mote_navigation import BeaconSilResult, BeaconSilWorld
from ccatp.links.robot_codec import MAX_LINE_BYTES, decode_from_robot
from ccatp.links.robot_messages import Sensors
from tests.support.beacon_rig import SLOWER, BeaconRig, DrivenRobot, onboard_config, pioneer_config

CFG = pioneer_config("zigbee")


class Driver:
    """A client with both keys, which answers each frame."""

    def __init__(self, **settings: Any) -> None:
        self.rig = BeaconRig(CFG, onboard_config(CFG, **({"scan__every_s": 0.0} | settings)))
        self.robot = DrivenRobot(self.rig)
        self.robot.join("controller")
        self.robot.join("monitor")
        self.rates = (1.0, 1.0)
        self.frames: list[dict[str, Any]] = []

    def run(self, frames: int) -> list[dict[str, Any]]:
        for _ in range(frames):
            seq = self.robot.seq + 1
            self.robot.permit(seq, True, True, True)
            self.robot.drive(seq, *self.rates)
            self.robot.advance()
            line = self.robot.delivered_line
            assert isinstance(decode_from_robot(line.rstrip()), Sensors)
            decode_beacon_frame(line.rstrip())
            assert len(line) <= MAX_LINE_BYTES
            self.frames.append(json.loads(line))
        return self.frames[-frames:]

    def moves(self) -> bool:
        """Whether the wheels turn in the end."""
        return bool(abs(self.run(10)[-1]["enc"][-1][1]) > 0.2)


@pytest.fixture
def driver() -> Driver:
    return Driver()


def test_frames_show_wheels_sonars_and_battery(driver: Driver) -> None:
    frame = driver.run(20)[-1]
    assert frame["enc"][-1][1:] == pytest.approx([1.0, 1.0], abs=0.5)  # noise of the simulated odometry, 0.1 rad/s
    assert frame["distances"] == [3.0] * 8
    assert frame["soc"] == pytest.approx(0.88, abs=0.01)
    assert not frame["cmd"]["held"]
    assert frame["faults"] == []
    hello = driver.robot.hello(boot=1, nonce="0" * 32, auth="none", lockstep=False)
    assert hello.robot.vehicle is not None
    assert (hello.robot.vehicle.kind, hello.frame_hz) == ("differential", 10.0)


def test_both_keys_and_a_steering_angle(driver: Driver) -> None:
    robot = driver.robot
    assert driver.moves()
    assert robot.drive(robot.seq + 9, 1.0, 1.0, None, 0.0)
    assert not robot.drive(robot.seq + 10, 1.0, 1.0, None, 0.3)
    for _ in range(5):
        robot.advance()
    assert robot.rules.is_held  # nothing newer came
    assert driver.rig.base.velocity == 0.0


Change = Callable[[Driver], object]


def _stop_sonar(driver: Driver) -> None:
    driver.rig.base.numbers = [0, 1, 2, 3, 4, 5, 6]


@pytest.mark.parametrize(
    ("change", "repair", "faults"),
    [
        (lambda d: setattr(d.rig.base, "is_mute", True), lambda d: setattr(d.rig.base, "is_mute", False),
         ["encoder_left", "encoder_right"]),
        (lambda d: d.rig.base.unplug(), lambda d: d.rig.base.plug(), ["edge", "encoder_left", "encoder_right"]),
        (_stop_sonar, lambda d: setattr(d.rig.base, "numbers", None), ["edge"]),
    ],
)  # fmt: skip
def test_without_base_or_sonars_the_wheels_are_held_until_they_work(
    driver: Driver, change: Change, repair: Change, faults: list[str]
) -> None:
    assert driver.moves()
    change(driver)
    frame = driver.run(15)[-1]
    assert frame["cmd"]["held"]
    assert set(faults) <= set(frame["faults"])
    repair(driver)
    driver.run(60)
    assert driver.moves()


@pytest.mark.parametrize("change", [{"stalls": [True, False]}, {"bumpers": [1, 0]}])
def test_a_stall_holds_the_wheels_until_a_drive_of_zero(driver: Driver, change: dict[str, Any]) -> None:
    assert driver.moves()
    driver.rig.base.__dict__.update(change)
    assert driver.run(5)[-1]["faults"] == ["stall"]
    driver.rig.base.__dict__.update(stalls=[False, False], bumpers=[0, 0])
    assert driver.run(5)[-1]["cmd"]["held"]
    driver.rates = (0.0, 0.0)
    assert driver.run(2)[-1]["faults"] == []
    driver.rates = (-1.0, -1.0)
    assert driver.moves()


def test_the_robot_stands_in_a_scan_and_then_goes_on() -> None:
    driver = Driver(scan__every_s=1.0)
    frames = driver.run(200)
    scans = [frame for frame in frames if "scan" in frame]
    assert scans
    assert set(scans[0]["scan"]["levels"]) == {"beacon1", "beacon2", "beacon3", "beacon4"}
    assert {len(levels) for levels in scans[0]["scan"]["levels"].values()} == {40}
    index = frames.index(scans[0])
    assert all(frame["cmd"]["held"] for frame in frames[index - 80 : index])
    assert any(not frame["cmd"]["held"] for frame in frames[index : index + 15])
    # While radios were asked the wheels did not turn.
    assert all(abs(frame["enc"][-1][1]) < 0.05 for frame in frames[index - 80 : index])


def test_a_robot_that_is_pushed_in_a_scan_gives_no_scan() -> None:
    driver = Driver(scan__every_s=1.0)
    driver.run(40)
    scanner = driver.rig.hardware.scanner
    assert scanner is not None
    assert scanner.is_scanning
    driver.rig.base.counts[0] += 5000.0
    driver.run(2)
    assert scanner.silence == "the newest scan gave nothing: the robot moved"
    assert not any("scan" in frame for frame in driver.run(60))


def test_a_late_loop_is_held_for_that_step(driver: Driver) -> None:
    assert driver.moves()
    driver.robot._steps += 60  # of 10 ms: longer than the watchdog of the base
    driver.robot.control(driver.rig.time.now_s + 0.6)
    assert driver.robot.rules.is_held
    assert driver.robot.late_steps == 1


def test_pulses_that_came_while_the_loop_stood_are_not_taken_for_new_ones() -> None:
    cfg = pioneer_config("cricket")
    rig = BeaconRig(cfg, onboard_config(cfg, devices__listeners__devices={"robot": "/dev/mote"}))
    robot, mote = DrivenRobot(rig), rig.listeners["robot"]
    rig._listener = None
    robot.advance()
    robot._motes.clear()
    before = robot.dropped_samples
    for late_s, taken in ((0.01, 1), (0.3, 0), (0.01, 1)):
        mote.pulse("1:25:61:61:b:0:0:42", "A", 0.005)
        rig.time.now_s += late_s
        robot.control(rig.time.now_s)
        assert len(robot._motes) == taken
        robot._motes.clear()
    assert robot.dropped_samples == before + 1


def test_only_a_radio_module_and_only_a_base() -> None:
    driver = Driver(devices__radio__is_used=False, devices__dish__is_used=False)
    assert driver.moves()
    driver = Driver(devices__base__is_used=False, devices__dish__is_used=False, scan__every_s=1.0)
    frames = driver.run(30)
    assert all(frame["cmd"]["held"] for frame in frames)
    (levels, *_) = [frame["radio"] for frame in frames if "radio" in frame]
    assert {beacon for _, beacon, _, _ in levels} == {"beacon1", "beacon2", "beacon3", "beacon4"}
    assert all(bearing is None for *_, bearing in levels)


def mission(system: str, *, overrides: dict[str, Any], driven: dict[str, Any]) -> tuple[BeaconSilResult, ...]:
    """The same mission of the simulated robot, and through drivers and fake devices."""
    simulated = BeaconSilWorld(cfg := pioneer_config(system, **overrides), build_beacon_robot(cfg))
    cfg = pioneer_config(system, **(overrides | driven))
    through = BeaconSilWorld(cfg, DrivenRobot(BeaconRig(cfg)))
    results = []
    for stage in (simulated, through):
        while not stage.is_over:
            stage.frame()
        results.append(stage.result())
    return tuple(results)


def position_m(result: BeaconSilResult) -> float:
    return float(result.summary["position_error_m"]["rmse"])


def test_a_lap_among_radios_through_the_drivers_is_as_good_as_simulated() -> None:
    simulated, driven = mission("zigbee", overrides={"mission__laps": 1}, driven={})
    assert simulated.outcome == driven.outcome == "complete"
    # Both use the same noise; standing in scans draws other numbers. A pose is good to 5 cm at the start.
    assert position_m(driven) < position_m(simulated) + 0.03
    assert driven.summary["beacons"]["mapped"] == 4
    assert driven.summary["beacons"]["rmse_m"] < 0.25


@pytest.mark.slow
def test_a_radio_is_followed_through_the_drivers() -> None:
    simulated, driven = mission("follow", overrides={}, driven=SLOWER)
    assert simulated.outcome == driven.outcome == "complete"
    assert position_m(driven) < position_m(simulated) + 0.03
    assert driven.summary["target"]["distance_min_m"] > 0.4


@pytest.mark.slow
def test_motes_guide_the_robot_through_their_serial_lines() -> None:
    simulated, driven = mission("cricket", overrides={}, driven={})
    assert simulated.outcome == driven.outcome == "complete"
    assert driven.summary["beacons"]["mapped"] == 6
    assert position_m(driven) < position_m(simulated) + 0.006  # 20 ms of delay between pulses and wheels at 0.3 m/s
