"""What a mission does when something goes wrong: radios silent, things in the way, a target that comes, emergencies."""

import numpy as np
import pytest

from ccatp.core import EventCode, Severity
from ccatp.studies.mote_navigation import BeaconSilWorld
from tests.unit.beacon_mission.stories import beacon_config, moved_m, play, target_distances

SILENCE = {"type": "radio_loss", "at_s": 20.0, "for_s": 20.0, "beacons": []}
THING = {"type": "obstacle", "at_s": 0.0, "for_s": 40.0, "x_m": 2.0, "y_m": 0.8, "radius_m": 0.15}
COMING = {"type": "target_approach", "at_s": 30.0, "for_s": 6.0, "speed_m_s": 0.08}
FASTER = {**COMING, "for_s": 8.0, "speed_m_s": 0.12}


def test_silence_of_all_radios_holds_the_robot_until_they_are_heard_again() -> None:
    cfg = beacon_config("zigbee", sim__incidents=[SILENCE])
    found = play(BeaconSilWorld(cfg)).result()
    held = [t_s for t_s, state in zip(found.times_s, found.states, strict=True) if state == "held"]
    # The last scan before the silence is at 18 s, the first after it at 42 s.
    assert held[0] == pytest.approx(18.0 + cfg.danger.radio_timeout_s, abs=0.2)
    assert held[-1] == pytest.approx(42.0, abs=0.2)
    assert moved_m(found, held[0] + 0.1, held[-1]) == 0.0
    assert found.outcome == "complete"
    assert found.summary["danger"] == {"radio": 1}


def test_silence_that_lasts_needs_an_operator() -> None:
    silence = {**SILENCE, "for_s": 1e4}
    stage = play(BeaconSilWorld(beacon_config("zigbee", sim__incidents=[silence])))
    assert stage.mission.is_faulted
    assert stage.mission.cause.startswith("no radio is heard for 30 s")
    assert stage.found.verdicts[-1].severity is Severity.FAULT


def test_one_radio_less_is_no_silence() -> None:
    silence = {**SILENCE, "beacons": ["beacon1"]}
    found = play(BeaconSilWorld(beacon_config("zigbee", mission__laps=1, sim__incidents=[silence]))).result()
    assert found.outcome == "complete"
    assert found.summary["danger"] == {}


def test_a_thing_in_the_way_is_not_run_into_without_avoidance() -> None:
    cfg = beacon_config("zigbee", mission__laps=1, sim__incidents=[THING])
    found = play(BeaconSilWorld(cfg)).result()
    near = [verdict for verdict in found.verdicts if verdict.code is EventCode.NEAR_EDGE]
    assert near
    assert {verdict.signal for verdict in near} == {"obstacle"}
    assert min(row[7] for row in found.truth if row[7] is not None) > 0.0
    assert found.outcome == "complete"  # once it is taken away


def test_a_thing_that_stays_ends_at_the_time_limit() -> None:
    thing = {**THING, "for_s": 1e4}
    cfg = beacon_config("zigbee", mission__laps=1, mission__time_limit_s=60.0, sim__incidents=[thing])
    stage = play(BeaconSilWorld(cfg))
    assert stage.mission.is_faulted
    assert "mission.time_limit_s" in stage.mission.cause
    assert not stage.result().summary["obstacles"]["touched"]


def test_the_robot_backs_off_from_a_target_that_comes() -> None:
    cfg = beacon_config("follow", mission__follow_s=45.0, sim__incidents=[COMING], sim__obstacles=[])
    found = play(BeaconSilWorld(cfg)).result()
    distances, speeds = target_distances(found), np.array(found.speeds_m_s)
    during = (np.array(found.times_s) > 30.0) & (np.array(found.times_s) < 40.0)
    assert cfg.danger.target_m < distances[during].min() < cfg.follow.safe_distance_m
    assert speeds[during].min() == pytest.approx(-cfg.follow.back_speed_m_s)
    assert "target" not in found.summary["danger"]  # it began early enough


def test_no_motion_towards_a_target_that_comes_faster_than_the_robot_backs() -> None:
    cfg = beacon_config("follow", mission__follow_s=45.0, sim__incidents=[FASTER], sim__obstacles=[])
    found = play(BeaconSilWorld(cfg)).result()
    distances, speeds = target_distances(found), np.array(found.speeds_m_s)
    assert distances.min() < cfg.danger.target_m
    assert "target" in found.summary["danger"]
    assert (speeds[distances < 0.9 * cfg.danger.target_m] <= 0.0).all()


def test_fire_sends_the_robot_to_its_start() -> None:
    stage = play(BeaconSilWorld(beacon_config("zigbee")), until_s=30.0)
    assert stage.danger.emergency("fire", "a") is None
    found = play(stage).result()
    assert found.outcome == "aborted, at base"
    assert found.states[-2] == "returning"
    start = stage.robot.world.pose
    assert np.hypot(start.x_m - 0.8, start.y_m - 0.8) < 0.15 + 0.2  # arrival radius, and the pose's error


def test_nothing_moves_in_an_earthquake_and_then_the_robot_returns() -> None:
    stage = play(BeaconSilWorld(beacon_config("zigbee")), until_s=20.0)
    stage.danger.emergency("earthquake", "a")
    play(stage, until_s=30.0)
    assert stage.mission.state == "held"
    assert stage.mission.resume() == "emergency: earthquake: nothing moves until that is cleared"
    assert stage.danger.clear("a", at_base_or_held=True) is None
    found = play(stage).result()
    assert moved_m(found, 20.3, 30.0) == 0.0
    assert found.outcome == "aborted, at base"


def test_a_pose_too_uncertain_holds_until_readings_help() -> None:
    cfg = beacon_config("zigbee", start__position_sigma_m=0.6, danger__hold_limit_s=600.0)
    stage = play(BeaconSilWorld(cfg), until_s=10.0)
    assert stage.mission.state == "held"
    assert stage.mission.cause == "the position is too uncertain"
