"""The true world among beacons: motion, propagation, shadowing, scans, obstacles, target, noise; and motes."""

from math import hypot, log10, pi
from typing import Any

import numpy as np
import pytest

from ccatp.beacons.config.models import CricketConfig, RadioConfig, SimObstacleConfig
from ccatp.beacons.sim.motes import MoteField, MotePulse, TrueMotes, true_motes, usable_reach
from ccatp.beacons.sim.radio import (
    MovingTarget,
    RadioDraws,
    ShadowingField,
    SimDriveCommand,
    TruePose,
    TrueRadio,
    clearance_m,
    count_between,
    seen_m,
)
from ccatp.beacons.sim.radio_world import RadioWorld
from ccatp.kinematics import wrap_pi
from tests.support.scenario import radio_config_of

BALL = SimObstacleConfig(x_m=1.0, y_m=0.0, radius_m=0.2)


def radio(cfg: RadioConfig, obstacles: tuple[SimObstacleConfig, ...] = ()) -> TrueRadio:
    draws = RadioDraws(np.random.default_rng(1), np.random.default_rng(2))
    return TrueRadio(-33.0, cfg.sim.radio, (3.0, 3.0), obstacles, 40, draws)


def drive(cfg: RadioConfig, command: SimDriveCommand, steps: int) -> RadioWorld:
    world = RadioWorld(cfg)
    for _ in range(steps):
        world.step(command, 0.1, static=False, target=False)
    return world


EXACT = {"sim__vehicle__start_position_offset_m": 0.0, "sim__vehicle__start_heading_offset_rad": 0.0}


@pytest.mark.parametrize(
    ("speed_m_s", "steer_rad", "way_m"),
    [(0.1, 0.3, 0.01), (9.0, 0.0, 0.015)],  # as printed; cut to the limits
)
def test_ackermann_steps(speed_m_s: float, steer_rad: float, way_m: float) -> None:
    world = drive(radio_config_of(**EXACT), SimDriveCommand(speed_m_s, steer_rad, 0.0), 1)
    turn_rad = way_m * np.sin(steer_rad) / 0.35
    wanted = 0.8 + way_m * np.cos(steer_rad), 0.8 + way_m * np.sin(steer_rad), turn_rad
    assert world.pose == pytest.approx(wanted)


def test_differential_drive_goes_along_a_circle() -> None:
    world = drive(
        radio_config_of(vehicle__kind="differential", **EXACT), SimDriveCommand(0.1, 0.0, 0.5), round(2 * pi / 0.05) * 1
    )
    centre = (0.8, 0.8 + 0.1 / 0.5)
    assert hypot(world.pose.x_m - centre[0], world.pose.y_m - centre[1]) == pytest.approx(0.2, abs=1e-6)


def test_slip_and_drift_are_not_in_the_odometry() -> None:
    quiet = {"sim__vehicle__speed_sigma_m_s": 0.0, "sim__vehicle__steer_sigma_rad": 0.0}
    cfg = radio_config_of(**EXACT, **quiet, sim__vehicle__slip=0.05, sim__vehicle__heading_drift_rad_s=0.01)
    world = RadioWorld(cfg)
    frame = world.step(SimDriveCommand(0.1, 0.0, 0.0), 0.1, static=False, target=False)
    assert world.pose.x_m == pytest.approx(0.8 + 0.01 * 0.95)
    assert world.pose.heading_rad == pytest.approx(0.001)
    assert frame.wheels.speed_m_s == 0.1


def test_level_follows_the_log_distance_model() -> None:
    for distance_m in (0.5, 1.0, 3.0):
        (ray,) = radio(radio_config_of()).rays(TruePose(0.0, 0.0, 0.0), (distance_m, 0.0))
        assert ray.level_dbm == pytest.approx(-33.0 - 20.0 * log10(distance_m))


def test_white_noise_has_its_spread_and_steps() -> None:
    one = radio(radio_config_of(sim__radio__resolution_db=0.0))
    levels = [s[0] for _ in range(4000) if (s := one.sight(TruePose(0.0, 0.0, 0.0), (1.0, 0.0)))]
    assert np.mean(levels) == pytest.approx(-33.0, abs=0.12)  # 4 sigma of the mean
    assert np.std(levels) == pytest.approx(2.0, abs=0.1)
    whole = radio(radio_config_of()).sight(TruePose(0.0, 0.0, 0.0), (1.0, 0.0))
    assert whole is not None
    assert whole[0] == round(whole[0])


def test_drawn_bearings_lie_on_steps_of_nine_degrees() -> None:
    one = radio(radio_config_of())
    errors = []
    for _ in range(2000):
        sighting = one.sight(TruePose(0.0, 0.0, 0.3), (0.0, 2.0))
        assert sighting is not None
        steps = sighting[1] / np.radians(9.0)
        assert steps == pytest.approx(round(steps), abs=1e-9)
        errors.append(wrap_pi(sighting[1] - (pi / 2 - 0.3)))
    assert np.degrees(np.std(errors)) == pytest.approx(hypot(18.0, 9.0 / 12**0.5), rel=0.06)


def test_a_turn_of_the_reflector_is_strongest_towards_the_radio() -> None:
    one = radio(radio_config_of(sim__radio__white_sigma_db=0.0))
    levels = np.array(one.scan(TruePose(0.0, 0.0, 0.5), (2.0, 0.0)))
    assert len(levels) == 40
    assert abs(wrap_pi(np.radians(9.0) * levels.argmax() + 0.5)) < np.radians(18.0)  # ties by whole decibels
    assert levels.min() == pytest.approx(levels.max() - 15.0, abs=1.0)


def test_packets_are_lost_at_the_configured_rate_and_below_the_sensitivity() -> None:
    one = radio(radio_config_of(sim__radio__loss_probability=0.3))
    lost = sum(one.scan(TruePose(0.0, 0.0, 0.0), (1.0, 0.0)).count(None) for _ in range(50))
    assert lost == pytest.approx(0.3 * 2000, abs=4 * (2000 * 0.21) ** 0.5)
    weak = radio(radio_config_of(sim__radio__sensitivity_dbm=-20.0))
    assert weak.scan(TruePose(0.0, 0.0, 0.0), (1.0, 0.0)) == 40 * [None]


def test_an_obstacle_in_the_line_of_sight_weakens_and_lets_a_reflection_win() -> None:
    here, there = TruePose(0.0, 0.0, 0.0), (2.0, 0.0)
    free, blocked = radio(radio_config_of()), radio(radio_config_of(), (BALL,))
    assert free.rays(here, there)[0].level_dbm - blocked.rays(here, there)[0].level_dbm == pytest.approx(6.0)
    cfg = radio_config_of(
        sim__radio__multipath_paths=6, sim__radio__multipath_level_db=1.0, sim__radio__obstacle_loss_db=40.0
    )
    sighting = radio(cfg, (BALL,)).sight(here, there)
    assert sighting is not None
    strongest = max(radio(cfg, (BALL,)).rays(here, there)[1:], key=lambda ray: ray.level_dbm)
    assert sighting[0] == pytest.approx(strongest.level_dbm, abs=10.0)
    assert strongest.direction_rad != 0.0


def test_shadowing_stays_and_decorrelates_exponentially() -> None:
    at = [(0.0, 0.0), (0.5, 0.0), (1.5, 0.0)]
    fields = [ShadowingField(5.0, 1.5, np.random.default_rng(seed)) for seed in range(600)]
    values = np.array([[field.at(place, (3.0, 3.0)) for place in at] for field in fields])
    assert fields[0].at(at[1], (3.0, 3.0)) == values[0, 1]
    correlation = values.T @ values / len(fields) / 25.0
    assert correlation[0, 0] == pytest.approx(1.0, abs=0.2)  # 3.5 sigma of 600 draws
    assert correlation[0, 1] == pytest.approx(np.exp(-0.5 / 1.5), abs=0.17)
    assert correlation[0, 2] == pytest.approx(np.exp(-1.0), abs=0.17)
    elsewhere = np.array([field.at(at[0], (3.0, 1.5)) for field in fields])
    assert np.mean(elsewhere * values[:, 0]) / 25.0 == pytest.approx(np.exp(-1.0), abs=0.17)


def test_obstacles_are_seen_between_and_along_rays() -> None:
    here = TruePose(0.0, 0.0, 0.0)
    assert count_between((0.0, 0.0), (2.0, 0.1), [BALL]) == 1
    assert count_between((0.0, 0.0), (0.7, 0.0), [BALL]) == 0
    assert count_between((0.0, 0.5), (2.0, 0.5), [BALL]) == 0
    assert seen_m(here, 0.0, [BALL]) == pytest.approx(0.8)
    assert seen_m(here, pi, [BALL]) == np.inf
    assert seen_m(here, 0.3, [BALL]) == np.inf
    assert clearance_m(here, [BALL]) == pytest.approx(0.8)


def test_a_random_target_keeps_its_speed_and_stays_in_the_room_and_out_of_obstacles() -> None:
    cfg = radio_config_of(sim__target__motion="random", sim__target__speed_m_s=0.1)
    target = MovingTarget(cfg.sim.target, (3.0, 3.0), [BALL], np.random.default_rng(3))
    for _ in range(5000):
        before = target.position_m
        target.step(0.1)
        x, y = target.position_m
        assert 0.0 <= x <= 3.0
        assert 0.0 <= y <= 3.0
        assert hypot(x - BALL.x_m, y - BALL.y_m) >= BALL.radius_m - 1e-9
        assert hypot(x - before[0], y - before[1]) < 0.0101 + 0.02  # a step, and what a wall turns back


def test_a_seed_repeats_itself_and_listening_does_not_change_the_rest() -> None:
    cfg = radio_config_of("follow")
    worlds = [RadioWorld(cfg), RadioWorld(cfg)]
    frames = [
        [world.step(SimDriveCommand(0.1, 0.1, 0.0), 0.1, static=listens, target=True) for _ in range(20)]
        for world, listens in zip(worlds, (True, False), strict=True)
    ]
    assert worlds[0].pose == worlds[1].pose
    assert worlds[0].target_m == worlds[1].target_m
    assert [f.extras.radio[-1] for f in frames[0]] == [f.extras.radio[-1] for f in frames[1]]
    assert len(frames[0][0].extras.radio) == 5
    assert RadioWorld(cfg, seed=2).pose != RadioWorld(cfg).pose


# -- motes: the usable region, flight, echoes, losses, clocks and thermometers -----------------------------------------


def mote_config(**keys: Any) -> CricketConfig:
    return radio_config_of("cricket", **{f"cricket__{name}": value for name, value in keys.items()}).cricket


def field(cfg: CricketConfig, places: list[list[float]], facings: list[list[float]] | None = None) -> MoteField:
    positions = np.array(places)
    turned = np.zeros_like(positions) if facings is None else np.array(facings)
    motes = TrueMotes(tuple(f"M{number}" for number in range(len(places))), positions, turned)
    return MoteField(cfg, motes, np.random.default_rng(1))


def received(cfg: CricketConfig, repeats: int = 1, distance_m: float = 5.0) -> MotePulse:
    (reading,) = field(cfg, [[0.0, 0.0], [distance_m, 0.0]]).listen([(0, 1)], repeats, np.random.default_rng(2))
    return reading


QUIET = {"sim__sigma_m": 0.0}


@pytest.mark.parametrize(
    ("keys", "delay_s"),
    [
        ({}, 5.0 / 344.0),
        ({"sim__temperature_c": 30.0}, 5.0 / 344.0 * np.sqrt(293.15 / 303.15)),
        ({"sim__latency_s": 0.001}, 5.0 / 344.0 + 0.001),
        ({"sim__tick_s": 1e-3}, 0.015),  # 14.53 ms to the nearest
    ],
)
def test_flight_latency_and_clock(keys: dict[str, float], delay_s: float) -> None:
    pulse = received(mote_config(**QUIET, **keys))
    assert pulse.delays_s[0] == pytest.approx(delay_s)
    assert pulse.temperature_c == keys.get("sim__temperature_c", 20.0)


def test_noise_is_that_of_the_configuration() -> None:
    ranges_m = received(mote_config(), 4000).delays_s * 344.0
    assert ranges_m.std() == pytest.approx(0.0066667, rel=0.04)  # 4000 draws: 1.1 %
    assert ranges_m.mean() == pytest.approx(5.0, abs=4e-4)


def test_echoes_are_longer_and_losses_are_missing() -> None:
    reading = received(mote_config(**QUIET, sim__multipath_probability=0.25, sim__loss_probability=0.5), 4000)
    assert len(reading.delays_s) == pytest.approx(2000, abs=130)  # four standard deviations
    excess_m = reading.delays_s * 344.0 - 5.0
    assert excess_m.min() > -1e-9
    echoes = excess_m > 1e-9
    assert echoes.mean() == pytest.approx(0.25, abs=0.04)
    assert excess_m[echoes].mean() == pytest.approx(0.5, abs=0.08)


def test_thermometers_have_errors_of_their_own() -> None:
    motes = field(mote_config(sim__thermometer_sigma_c=2.0), [[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]])
    reported = [one.temperature_c for one in motes.listen([(0, 1), (0, 2), (1, 2)], 1, np.random.default_rng(2))]
    assert reported[0] != reported[1] == reported[2]


def test_the_usable_region() -> None:
    cone = mote_config(transducer__is_omnidirectional=False).transducer
    assert usable_reach(cone, 0.0, 0.0) == 10.0
    assert usable_reach(cone, np.pi / 6.0, 0.0) == pytest.approx(9.5, abs=1e-4)
    assert usable_reach(cone, np.pi / 6.0, np.pi / 6.0) == pytest.approx(9.025, abs=1e-3)
    assert usable_reach(cone, 1.4, 0.0) == 0.0
    assert usable_reach(mote_config().transducer, 3.0, 3.0) == 10.0


def test_motes_hear_each_other_as_they_face() -> None:
    cfg = mote_config(transducer__is_omnidirectional=False)
    facing = field(cfg, [[0.0, 0.0], [5.0, 0.0], [0.0, 3.5]], [[1.0, 0.0], [-1.0, 0.0], [1.0, 0.0]])
    assert facing.receives(0, 1)
    assert not facing.receives(0, 2)  # side by side, both looking across the field
    assert facing.receives(1, 2) == facing.receives(2, 1) is True
    near = field(cfg, [[0.0, 0.0], [0.05, 0.0], [11.0, 0.0]])
    assert not near.receives(0, 1)
    assert not near.receives(0, 2)


def test_layouts() -> None:
    stands = true_motes(mote_config(), np.random.default_rng(0))
    assert stands.positions_m.shape == (20, 2)
    first = stands.positions_m[2:5]
    sides = [np.linalg.norm(first[a] - first[b]) for a, b in ((0, 1), (1, 2), (0, 2))]
    assert sides == pytest.approx([0.5, 0.5, 0.5], abs=1e-6)
    motes = {
        "P": {"place_m": [0.0, 0.0, 2.5], "facing": [0.0, 0.0, -2.0]},
        "Q": {"place_m": [1.0, 0.0, 2.5], "facing": [0.0, 0.0, -1.0]},
    }
    ceiling = true_motes(mote_config(layout="motes", dimension=3, motes=motes), np.random.default_rng(0))
    assert ceiling.names == ("P", "Q")
    assert ceiling.facings[0].tolist() == [0.0, 0.0, -1.0]
    drawn = mote_config(layout="random", random__count=50, random__size_m=[10.0, 4.0])
    field_of = true_motes(drawn, np.random.default_rng(3))
    assert field_of.positions_m.max(axis=0) == pytest.approx([10.0, 4.0], rel=0.1)
    assert (true_motes(drawn, np.random.default_rng(3)).positions_m == field_of.positions_m).all()
