"""An operator's commands to a mission among beacons, and what it does without verdicts."""

import sqlite3
from math import cos, hypot, inf, pi, radians, sin
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from ccatp.beacons.conditions import RADIO_SILENT
from ccatp.beacons.config.models import RadioConfig
from ccatp.beacons.estimation.motion import Increment, Steering
from ccatp.beacons.links.messages import (
    BeaconFrame,
    MoteBurst,
    RadioSample,
    RadioScan,
    decode_beacon_frame,
    with_extras,
)
from ccatp.beacons.mission import RULES, BeaconMission, WaypointArrival, check_beacon_robot, permitted, wheel_rates
from ccatp.beacons.modes import VISITING, Working
from ccatp.beacons.navigation import BeaconMeasurements, MeasurementReader, PoseBelief, SelfMap, packets_of
from ccatp.beacons.records.store import BeaconStore, BeaconStoreError
from ccatp.beacons.records.summary import BeaconSummary
from ccatp.beacons.safety.rules import BeaconSafetyRules, ObstacleBuffer
from ccatp.beacons.sim.radio_world import RadioWorld
from ccatp.beacons.sim.robot import BeaconRobot
from ccatp.beacons.steering import HALT, SteeringCommand
from ccatp.beacons.studies.mote_navigation import BeaconSilResult, BeaconSilWorld
from ccatp.conditions import text_of
from ccatp.conditions.danger import ENCODERS_STALE
from ccatp.core import NO_CAUSE, Cause, EventCode, Severity, Verdict
from ccatp.errors import ConfigError
from ccatp.links.robot_codec import BadLine, decode_from_robot
from ccatp.links.robot_messages import Sensors
from ccatp.links.topics import EstimateMessage
from ccatp.survey.engagement import Engagement, Event, enter
from ccatp.survey.events import DONE, HELD, Abort, Fault, Pause, Resume, StopHere
from tests.support.scenario import radio_config_of

FREE = Verdict.normal(0, 0.0)
DENIED = RADIO_SILENT.found("radio", 8.0, 7.0).verdict(0, 0.0, EventCode.NORMAL)


def play(stage: BeaconSilWorld, until_s: float = 1e9) -> BeaconSilWorld:
    """Serve frames until a time, or the end."""
    while not stage.is_over and stage.robot.t_s < until_s:
        stage.frame()
    return stage


def target_distances(found: BeaconSilResult) -> np.ndarray[Any, np.dtype[np.float64]]:
    """True distance of the robot's origin from the target, one a frame."""
    return np.array([hypot(row[2] - row[5], row[3] - row[6]) for row in found.truth])


def moved_m(found: BeaconSilResult, from_s: float, until_s: float) -> float:
    """How far the robot really went between two times."""
    places = np.array([row[2:4] for row in found.truth if from_s <= row[1] <= until_s])
    return float(np.hypot(*np.diff(places, axis=0).T).sum())


@pytest.fixture
def stage() -> BeaconSilWorld:
    return play(BeaconSilWorld(radio_config_of("zigbee")), until_s=10.0)


def test_pause_holds_until_resume(stage: BeaconSilWorld) -> None:
    assert stage.mission.handle(Pause(Cause("operator"))) is None
    play(stage, until_s=15.0)
    assert stage.mission.state.is_paused
    assert set(stage.found.speeds_m_s[101:]) == {0.0}
    assert stage.mission.handle(Resume()) is None
    play(stage, until_s=16.0)
    assert stage.mission.state.mode is VISITING


def test_abort_goes_to_the_start_also_out_of_a_pause(stage: BeaconSilWorld) -> None:
    stage.mission.handle(Pause(Cause("operator")))
    assert stage.mission.handle(Abort(Cause("operator"))) is None
    assert play(stage).result().outcome == "aborted, at base"


def test_stop_ends_it_where_it_is_and_then_it_takes_no_commands(stage: BeaconSilWorld) -> None:
    assert stage.mission.handle(StopHere()) is None
    stage.frame()
    assert stage.mission.state.mode is DONE
    assert stage.result().outcome == "stopped"
    over = "the mission is over"
    for event in (Pause(Cause("")), Abort(Cause("")), StopHere()):
        assert stage.mission.handle(event) == over


def test_what_holds_the_robot_says_when_it_continues() -> None:
    frame = BeaconMeasurements(0.0, (), BeaconFrame())

    def after(state: Engagement, verdict: Verdict | None, *, goes_on: bool) -> Engagement:
        state = RULES.react(state, frame, verdict)
        assert (state.mode is not HELD) is goes_on
        return state

    state = Engagement(Working(VISITING))
    assert RULES.handle(state, Resume())[1] == "the mission is not held but visiting"
    state = after(state, DENIED, goes_on=False)
    assert RULES.handle(state, Resume())[1] == "the cause persists: no beacon is received"
    state = after(state, FREE, goes_on=True)
    state = after(enter(state, Event.GO_ON, Working(VISITING)), None, goes_on=False)
    assert text_of(state.cause) == "no fresh verdict from the danger loop"
    state, _ = RULES.handle(after(state, FREE, goes_on=True), Fault(Cause("lost")))
    assert state.is_faulted
    state = after(state, FREE, goes_on=False)  # a fault waits for an operator
    state, refusal = RULES.handle(state, Resume())
    assert refusal is None
    after(state, FREE, goes_on=True)


NO_FORWARD = Verdict(0, 0.0, EventCode.NEAR_EDGE, NO_CAUSE, "", 0.0, 0.0, False, True, True)
NOTHING = Verdict(0, 0.0, EventCode.NEAR_EDGE, NO_CAUSE, "", 0.0, 0.0, False, False, False)


@pytest.fixture
def cfg() -> RadioConfig:
    return radio_config_of("zigbee")


def frame_of(robot: BeaconRobot) -> tuple[Sensors, BeaconFrame]:
    line = robot.delivered_line.strip()
    sensors = decode_from_robot(line)
    assert isinstance(sensors, Sensors)
    return sensors, decode_beacon_frame(line)


@pytest.mark.parametrize(
    ("wanted", "verdict", "sent"),
    [
        (SteeringCommand(0.1, 0.2, 0.0), FREE, SteeringCommand(0.1, 0.2, 0.0)),
        (SteeringCommand(0.1, 0.2, 0.0), NO_FORWARD, SteeringCommand(-0.05, 0.0, 0.0)),
        (SteeringCommand(-0.1, 0.2, 0.0), NO_FORWARD, SteeringCommand(-0.1, 0.2, 0.0)),
        (SteeringCommand(0.1, 0.2, 0.0), NOTHING, HALT),
        (SteeringCommand(-0.1, 0.2, 0.0), NOTHING, HALT),
        (SteeringCommand(0.0, 0.2, 0.3), NOTHING, SteeringCommand(0.0, 0.0, 0.0)),
        (SteeringCommand(float("nan"), 0.0, 0.0), FREE, HALT),
    ],
)
def test_nothing_is_sent_that_is_not_permitted(
    wanted: SteeringCommand, verdict: Verdict, sent: SteeringCommand
) -> None:
    assert permitted(wanted, verdict, 0.05) == sent


def test_wheel_rates_of_both_vehicles(cfg: RadioConfig) -> None:
    rate = 0.1 / cfg.robot.wheel_radius_m
    assert wheel_rates(SteeringCommand(0.1, 0.2, 0.0), cfg) == (rate, rate, 0.2)
    turning = cfg.model_copy(update={"vehicle": cfg.vehicle.model_copy(update={"kind": "differential"})})
    right, left, steer = wheel_rates(SteeringCommand(0.1, 0.0, 0.5), turning)
    assert steer is None
    assert right - left == pytest.approx(0.5 * cfg.vehicle.track_m / cfg.robot.wheel_radius_m)


def test_echoes_stay_where_they_are_while_the_robot_moves() -> None:
    memory = ObstacleBuffer((0.0, pi / 2), 1.0, 20.0)
    memory.see(0.0, (0.5, 3.0))
    assert memory.nearest_m(0.0, 0.1) == pytest.approx(0.5)
    memory.roll(0.2, 0.0, 0.0)
    assert memory.nearest_m(0.0, 0.1) == pytest.approx(0.3)
    memory.roll(0.0, 0.0, pi)  # turned round: it is behind now
    assert memory.nearest_m(0.0, 0.1) == inf
    assert memory.nearest_m(pi, 0.1) == pytest.approx(0.3)
    memory.see(20.5, (3.0, 3.0))
    assert memory.nearest_m(pi, 0.1) == inf  # forgotten


def test_the_course_of_a_steered_vehicle_is_where_its_front_wheel_points() -> None:
    memory = ObstacleBuffer((0.0,), 2.0, 20.0)
    memory.see(0.0, (1.0,))
    memory.roll(1.0, pi / 2, 0.0)  # sideways, as wheels at a right angle would
    assert memory.nearest_m(-pi / 4, 0.01) == pytest.approx(2.0**0.5)


def test_wheels_steering_and_scans_are_read_from_the_link(cfg: RadioConfig) -> None:
    robot = BeaconRobot(cfg, RadioWorld(cfg))
    robot.join("controller")
    reader = MeasurementReader(cfg)
    reader.read(*frame_of(robot))
    robot.drive(1, 1.0, 1.0, None, 0.3)
    robot.advance()
    (wheels,) = reader.read(*frame_of(robot)).wheels
    assert isinstance(wheels, Steering)
    assert wheels.interval_s == pytest.approx(0.1)
    assert wheels.speed_m_s == pytest.approx(cfg.robot.wheel_radius_m, abs=5 * cfg.sim.vehicle.speed_sigma_m_s)
    assert wheels.steer_rad == pytest.approx(0.3, abs=5 * cfg.sim.vehicle.steer_sigma_rad)


def test_a_scan_on_the_link_keeps_its_directions() -> None:
    cfg = radio_config_of("zigbee", sim__radio__scan="reflector", observation__every_steps=1)
    world = RadioWorld(cfg)
    robot = BeaconRobot(cfg, world)
    robot.advance()
    scan = MeasurementReader(cfg).read(*frame_of(robot)).extras.scan
    assert scan is not None
    step = 2 * pi / cfg.scan.readings
    directions = [round(direction_rad / step, 6) for _, direction_rad, _ in packets_of(scan)]
    assert directions == 4 * list(range(cfg.scan.readings))
    assert len(robot.delivered_line) < 8192


def test_steering_needs_the_permit_to_turn(cfg: RadioConfig) -> None:
    robot = BeaconRobot(cfg, RadioWorld(cfg))
    robot.join("controller")
    robot.join("monitor")
    for seq, steer, turn, is_held in ((1, 0.2, True, False), (2, 0.2, False, True), (3, 0.0, False, False)):
        robot.permit(seq, True, True, turn)
        robot.drive(seq, 1.0, 1.0, None, steer)
        robot.advance()
        assert robot.rules.is_held is is_held


def test_a_drive_outlives_its_time_to_live_by_nothing(cfg: RadioConfig) -> None:
    robot = BeaconRobot(cfg, RadioWorld(cfg))
    robot.join("controller")
    robot.drive(1, 1.0, 1.0)
    held = []
    for _ in range(4):
        robot.advance()
        held.append(robot.rules.is_held)
    assert held == [False, False, True, True]


def test_extra_keys_out_of_range_are_a_bad_line(cfg: RadioConfig) -> None:
    line = with_extras(BeaconRobot(cfg, RadioWorld(cfg)).delivered_line, BeaconFrame(distances=[1.0, 2.0]))
    assert decode_beacon_frame(line.strip()).distances == [1.0, 2.0]
    with pytest.raises(BadLine, match="distances"):
        decode_beacon_frame(line.strip().replace(b"2.0", b"-2.0"))


def test_the_danger_rules_find_the_target_by_its_level() -> None:
    cfg = radio_config_of("follow")
    danger, robot = BeaconSafetyRules(cfg), BeaconRobot(cfg, RadioWorld(cfg))
    sensors, _ = frame_of(robot)
    for level_dbm, is_near in ((-36.0, False), (-28.0, True)):  # at 1 m, at 0.4 m
        scan = RadioScan(0.0, radians(9.0), {"target": [level_dbm, None], "beacon1": [-50.0]})
        danger.reset()
        verdict = danger.step(sensors, BeaconFrame(scan=scan), None)
        assert (verdict.signal == "target") is is_near
        assert verdict.forward is not is_near
        assert verdict.reverse


def test_no_frame_means_no_permit(cfg: RadioConfig) -> None:
    verdict = BeaconSafetyRules(cfg).stale(7, 1.5)
    assert (verdict.forward, verdict.reverse, verdict.turn) == (False, False, False)


@pytest.mark.parametrize(
    ("system", "keys", "what"),
    [
        (
            "zigbee", {"vehicle__wheelbase_m": 0.5, "vehicle__kind": "differential"},
            r"vehicle\.wheelbase_m is 0\.5 here and 0\.35 there.*kind is differential",
        ),
        ("follow", {}, "the distance sensors look elsewhere"),
        ("mirror", {}, "says nothing of its vehicle"),
    ],
)  # fmt: skip
def test_another_robot_is_refused(system: str, keys: dict[str, Any], what: str, cfg: RadioConfig) -> None:
    hello = BeaconRobot(cfg, RadioWorld(cfg)).hello(boot=1, nonce="0" * 32, auth="none", lockstep=True)
    check_beacon_robot(cfg, hello)
    if system == "mirror":
        hello.robot.vehicle = None
    with pytest.raises(ConfigError, match=what):
        check_beacon_robot(cfg if system == "mirror" else radio_config_of(system, **keys), hello)


def test_a_summary_without_truth_holds_what_needs_none(cfg: RadioConfig) -> None:
    book = BeaconSummary(cfg, has_truth=False)
    navigator = BeaconMission(cfg).navigator
    book.beacons, book.score = {"beacon1": (0.1, 0.2, 0.01, 0.0, 0.01)}, (2.0, 2)
    book.readings, book.notes = (1, 0), navigator.notes
    summary = book.build(1.0)
    assert summary["trajectory_rmse_m"] is None
    assert summary["position_error_m"]["max"] is None
    assert summary["beacons"]["rmse_m"] is None
    assert summary["beacons"]["mapped"] == 1
    assert summary["consistency"]["nis_mean"] == 1.0
    assert (summary["consistency"]["readings"], summary["consistency"]["refused"]) == (1, 0)


def test_readings_are_counted_and_not_their_values(cfg: RadioConfig) -> None:
    """A level with a bearing is one reading of two values, whether it is used or refused."""
    navigator = BeaconMission(cfg).navigator
    readings = [RadioSample(0.1 * k, "beacon4", -43.0, 0.785) for k in range(1, 60)]
    wild = RadioSample(6.0, "beacon4", -100.0, -2.3)
    for one in (*readings, wild):
        navigator.take(BeaconMeasurements(one.t_s, (), BeaconFrame(radio=[one])))
    score = navigator.score
    assert 20 < score.used < len(readings)  # the first ones wait until they place the radio
    assert score.nis_size == 2 * score.used
    assert score.refused == 1


def test_the_store_keeps_what_was_reached(cfg: RadioConfig, tmp_path: Path) -> None:
    path = tmp_path / "mission.sqlite"
    store = BeaconStore(path, {"system": "zigbee"}, cfg.workspace.waypoints_m, 2)
    store.record_arrival(3.5, 5, WaypointArrival(1, 1, (2.2, 0.8), PoseBelief((2.1, 0.8, 0.0), np.eye(3))))
    store.record_event(4.0, "warning", "held: no beacon is received")
    store.close()
    with sqlite3.connect(path) as db:
        reached = db.execute("SELECT number, lap, waypoint, reached_s FROM waypoint WHERE reached_s NOTNULL").fetchall()
        assert reached == [(5, 1, 1, 3.5)]
        assert db.execute("SELECT count(*) FROM waypoint").fetchone() == (8,)
        assert db.execute("SELECT text FROM event").fetchall() == [("held: no beacon is received",)]
    db.close()
    with pytest.raises(BeaconStoreError, match="holds a mission already"):
        BeaconStore(path, {}, (), 0)
    with pytest.raises(BeaconStoreError, match="cannot be made"):
        BeaconStore(tmp_path / "nowhere" / "mission.sqlite", {}, (), 0)


def test_pulses_of_unknown_motes_are_not_used() -> None:
    own = SelfMap(radio_config_of("cricket").cricket)
    own.take(MoteBurst(0.0, "stranger", "N1-1", 20.0, [0.01]))
    own.take(MoteBurst(0.0, "N1-1", "robot", 20.0, [0.01]))
    assert own.places is None
    assert not own.is_done


SILENCE = {"type": "radio_loss", "at_s": 20.0, "for_s": 20.0, "beacons": []}
THING = {"type": "obstacle", "at_s": 0.0, "for_s": 40.0, "x_m": 2.0, "y_m": 0.8, "radius_m": 0.15}
COMING = {"type": "target_approach", "at_s": 30.0, "for_s": 6.0, "speed_m_s": 0.08}
FASTER = {**COMING, "for_s": 8.0, "speed_m_s": 0.12}


def test_silence_of_all_radios_holds_the_robot_until_they_are_received_again() -> None:
    cfg = radio_config_of("zigbee", sim__incidents=[SILENCE])
    found = play(BeaconSilWorld(cfg)).result()
    held = [t_s for t_s, state in zip(found.times_s, found.states, strict=True) if state == "held"]
    # The last scan before the silence is at 18 s, the first after it at 42 s.
    assert held[0] == pytest.approx(18.0 + cfg.danger.radio_timeout_s, abs=0.2)
    assert held[-1] == pytest.approx(42.0, abs=0.2)
    assert moved_m(found, held[0] + 0.1, held[-1]) == 0.0
    assert found.outcome == "complete"
    assert found.summary["danger"] == {"radio": 1}


@pytest.mark.parametrize(
    ("keys", "cause"),
    [
        ({"sim__incidents": [{**SILENCE, "for_s": 1e4}]}, "no beacon is received, for more than 30 s"),
        (
            {"mission__time_limit_s": 60.0, "sim__incidents": [{**THING, "for_s": 1e4}]},
            "the mission takes longer than mission.time_limit_s",
        ),
    ],
)
def test_what_lasts_needs_an_operator(keys: dict[str, Any], cause: str) -> None:
    stage = play(BeaconSilWorld(radio_config_of("zigbee", mission__laps=1, **keys)))
    assert stage.mission.state.is_faulted
    assert text_of(stage.mission.state.cause).startswith(cause)
    assert (stage.found.verdicts[-1].severity is Severity.FAULT) == ("received" in cause)
    assert not (stage.result().summary["obstacles"] or {}).get("touched")


def test_one_radio_less_is_no_silence() -> None:
    silence = {**SILENCE, "beacons": ["beacon1"]}
    found = play(BeaconSilWorld(radio_config_of("zigbee", mission__laps=1, sim__incidents=[silence]))).result()
    assert found.outcome == "complete"
    assert found.summary["danger"] == {}


def test_a_thing_in_the_way_is_not_run_into_without_avoidance() -> None:
    cfg = radio_config_of("zigbee", mission__laps=1, sim__incidents=[THING])
    found = play(BeaconSilWorld(cfg)).result()
    near = [verdict for verdict in found.verdicts if verdict.code is EventCode.NEAR_EDGE]
    assert near
    assert {verdict.signal for verdict in near} == {"obstacle"}
    assert min(row[7] for row in found.truth if row[7] is not None) > 0.0
    assert found.outcome == "complete"  # once it is taken away


def test_the_robot_backs_off_from_a_target_that_comes() -> None:
    cfg = radio_config_of("follow", mission__follow_s=45.0, sim__incidents=[COMING], sim__obstacles=[])
    found = play(BeaconSilWorld(cfg)).result()
    distances, speeds = target_distances(found), np.array(found.speeds_m_s)
    during = (np.array(found.times_s) > 30.0) & (np.array(found.times_s) < 40.0)
    assert cfg.danger.target_m < distances[during].min() < cfg.follow.safe_distance_m
    assert speeds[during].min() == pytest.approx(-cfg.follow.back_speed_m_s)
    assert "target" not in found.summary["danger"]  # it began early enough


def test_no_motion_towards_a_target_that_comes_faster_than_the_robot_backs() -> None:
    cfg = radio_config_of("follow", mission__follow_s=45.0, sim__incidents=[FASTER], sim__obstacles=[])
    found = play(BeaconSilWorld(cfg)).result()
    distances, speeds = target_distances(found), np.array(found.speeds_m_s)
    assert distances.min() < cfg.danger.target_m
    assert "target" in found.summary["danger"]
    assert (speeds[distances < 0.9 * cfg.danger.target_m] <= 0.0).all()


def silent_target(**when: float) -> RadioConfig:
    incident = {"type": "radio_loss", "beacons": ["target"], **when}
    return radio_config_of("follow", mission__follow_s=30.0, sim__incidents=[incident])


def test_a_mission_whose_radio_is_never_received_is_not_complete() -> None:
    found = play(BeaconSilWorld(silent_target(at_s=0.0, for_s=1e4))).result()
    assert (found.outcome, found.states[-1]) == ("", "held")
    assert found.cause == "the followed radio target was not received for 40 s"
    assert found.times_s[-1] < 41.0


def test_only_time_in_which_the_radio_is_received_counts_as_followed() -> None:
    stage = BeaconSilWorld(silent_target(at_s=10.0, for_s=25.0))
    play(stage, until_s=34.0)
    assert stage.mission.done == pytest.approx(20, abs=1)  # the radio counts as lost 10 s after its last reading
    assert play(stage).result().outcome == "complete"
    assert stage.robot.t_s == pytest.approx(45.0, abs=1.0)


def test_a_map_that_gets_no_further_readings_is_a_fault_that_names_a_pair() -> None:
    found = play(BeaconSilWorld(radio_config_of("cricket", listener__mapping_rounds=20))).result()
    assert found.states[-1] == "held"
    assert found.cause == (
        "the motes do not map themselves: A and B have 40 of 60 readings of each other, and no further one for 30 s"
    )
    found = play(BeaconSilWorld(radio_config_of("cricket", listener__mapping_rounds=30))).result()
    assert "phase 2 expects an error of 0.1" in found.cause


@pytest.mark.parametrize(("wrong_in", "is_faulted"), [(1, True), (3, False)])
def test_an_estimate_that_most_readings_contradict_is_a_fault(wrong_in: int, is_faulted: bool) -> None:
    stage = BeaconSilWorld(radio_config_of("cricket"))
    mission, navigator = stage.mission, stage.mission.navigator
    while navigator.is_mapping:
        stage.frame()
    t_s, used = stage.robot.t_s, navigator.score.used
    x_m, y_m, _ = navigator.belief.pose
    name, (mote_x_m, mote_y_m, *_) = min(navigator.beacons.items())
    delay_s = hypot(x_m - mote_x_m, y_m - mote_y_m) / 344.0
    for k in range(60):
        burst = MoteBurst(t_s, name, "robot", 20.0, [delay_s + (0.003 if k % wrong_in == 0 else 0.0)])  # 1 m
        mission.step(BeaconMeasurements(t_s, (), BeaconFrame(motes=[burst])), 0.1, FREE)
    assert mission.state.is_faulted is is_faulted
    assert navigator.score.used > used or wrong_in == 1
    if is_faulted:
        assert "of the last 40 readings contradict the estimated place" in text_of(mission.state.cause)


@pytest.mark.parametrize("system", ["cricket", "zigbee"])
def test_samples_of_wheels_and_motes_count_at_their_own_times(system: str) -> None:
    """The wheels are sampled 0.07 s before the frame, a mote 0.03 s before it; the robot drives at 0.3 m/s."""
    stage = BeaconSilWorld(radio_config_of(system, vehicle__kind="differential"))
    navigator = stage.mission.navigator
    while navigator.is_mapping:
        stage.frame()
    begun_s, speed, rate = stage.robot.t_s, 0.3, 0.2
    x_m, y_m, heading = navigator.belief.pose
    motes = sorted(navigator.beacons.items())

    def pose(t_s: float) -> tuple[float, float, float]:
        now = heading + rate * (t_s - begun_s)
        r = speed / rate
        return x_m + r * (sin(now) - sin(heading)), y_m - r * (cos(now) - cos(heading)), now

    last_s = begun_s
    for k in range(1, 41):
        t_s = begun_s + 0.1 * k
        end_s, heard_s = t_s - 0.07, t_s - 0.03
        wheels = Increment(end_s, end_s - last_s, speed * (end_s - last_s), rate * (end_s - last_s))
        last_s = end_s
        bursts = []
        if motes:
            name, (mote_x_m, mote_y_m, *_) = motes[k % len(motes)]
            there = pose(heard_s)
            delay_s = hypot(there[0] - mote_x_m, there[1] - mote_y_m) / 344.0
            bursts = [MoteBurst(heard_s, name, "robot", 20.0, [delay_s])]
        navigator.take(BeaconMeasurements(t_s, (wheels,), BeaconFrame(motes=bursts)))
        if k > 1:  # before, wheel samples do not reach back as long
            assert navigator.belief.pose == pytest.approx(pose(t_s), abs=1e-3)  # 1 mm of the 21 mm since the wheels
    assert navigator.score.refused == 0


def test_fire_sends_the_robot_to_its_start() -> None:
    stage = play(BeaconSilWorld(radio_config_of("zigbee")), until_s=30.0)
    assert stage.danger.emergency("fire", "a") is None
    found = play(stage).result()
    assert found.outcome == "aborted, at base"
    assert found.states[-2] == "returning"
    start = stage.robot.world.pose
    assert np.hypot(start.x_m - 0.8, start.y_m - 0.8) < 0.15 + 0.2  # arrival radius, and the pose's error


def test_nothing_moves_in_an_earthquake_and_then_the_robot_returns() -> None:
    stage = play(BeaconSilWorld(radio_config_of("zigbee")), until_s=20.0)
    stage.danger.emergency("earthquake", "a")
    play(stage, until_s=30.0)
    assert stage.mission.state.mode == "held"
    assert stage.mission.handle(Resume()) == "emergency: earthquake: nothing moves until that is cleared"
    assert stage.danger.clear("a", at_base_or_held=True) is None
    found = play(stage).result()
    assert moved_m(found, 20.3, 30.0) == 0.0
    assert found.outcome == "aborted, at base"


def test_a_pose_too_uncertain_holds_until_readings_help() -> None:
    cfg = radio_config_of("zigbee", start__position_sigma_m=0.6, danger__hold_limit_s=600.0)
    stage = play(BeaconSilWorld(cfg), until_s=10.0)
    assert stage.mission.state.mode == "held"
    assert text_of(stage.mission.state.cause) == "the position is too uncertain"


def test_silent_encoders_hold_a_robot_among_beacons(cfg: RadioConfig) -> None:
    rules, robot = BeaconSafetyRules(cfg), BeaconRobot(cfg, RadioWorld(cfg))
    robot.join("controller")
    limit_s, verdicts = cfg.danger.stale_after_s, []
    for _ in range(40):
        robot.advance()
        sensors, extras = frame_of(robot)
        if sensors.t > 1.0:
            sensors = replace(sensors, enc=[])
        estimate = EstimateMessage(
            seq=sensors.seq, t_s=sensors.t, x_m=0.0, y_m=0.0, heading_rad=0.0, sigma_m=0.1, state="visiting"
        )
        verdicts.append((sensors.t, rules.step(sensors, extras, estimate)))
    for t_s, verdict in verdicts:
        assert (text_of(verdict.cause) == ENCODERS_STALE.message) is (t_s > 1.0 + limit_s + 1e-9), t_s
    last = verdicts[-1][1]
    assert (last.forward, last.reverse, last.turn) == (False, False, False)


def test_wheels_are_read_again_after_the_clock_of_a_robot_was_set_back(cfg: RadioConfig) -> None:
    rules, reader, robot = BeaconSafetyRules(cfg), MeasurementReader(cfg), BeaconRobot(cfg, RadioWorld(cfg))
    robot.join("controller")
    times_s: list[float] = []
    for k in range(40):
        robot.advance()
        sensors, extras = frame_of(robot)
        if k >= 20:  # as a clock that was set back by a second
            enc = [sample._replace(t_s=sample.t_s - 1.0) for sample in sensors.enc]
            steer = [sample._replace(t_s=sample.t_s - 1.0) for sample in extras.steer]
            sensors, extras = replace(sensors, t=sensors.t - 1.0, enc=enc), replace(extras, steer=steer)
        rules.step(sensors, extras, None)
        times_s.append(sum(wheel.interval_s for wheel in reader.read(sensors, extras).wheels))
    assert times_s[21:] == pytest.approx([cfg.run.step_s] * 19)
    assert times_s[5:20] == pytest.approx([cfg.run.step_s] * 15)
