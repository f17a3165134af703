"""Simulated motes: the usable region, flight, echoes, losses, clocks and thermometers."""

from typing import Any

import numpy as np
import pytest

from ccatp.config.beacon_models import CricketConfig
from ccatp.config.load import load_radio_config
from ccatp.sim.motes import MoteField, MotePulse, TrueMotes, true_motes, usable_reach


def config(**keys: Any) -> CricketConfig:
    dotted = {f"cricket.{name.replace('__', '.')}": value for name, value in keys.items()}
    return load_radio_config(None, {"system": "cricket", **dotted}).cricket


def field(cfg: CricketConfig, places: list[list[float]], facings: list[list[float]] | None = None) -> MoteField:
    positions = np.array(places)
    turned = np.zeros_like(positions) if facings is None else np.array(facings)
    motes = TrueMotes(tuple(f"M{number}" for number in range(len(places))), positions, turned)
    return MoteField(cfg, motes, np.random.default_rng(1))


def heard(cfg: CricketConfig, repeats: int = 1, distance_m: float = 5.0) -> MotePulse:
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
    pulse = heard(config(**QUIET, **keys))
    assert pulse.delays_s[0] == pytest.approx(delay_s)
    assert pulse.temperature_c == keys.get("sim__temperature_c", 20.0)


def test_noise_is_that_of_the_configuration() -> None:
    ranges_m = heard(config(), 4000).delays_s * 344.0
    assert ranges_m.std() == pytest.approx(0.0066667, rel=0.04)  # 4000 draws: 1.1 %
    assert ranges_m.mean() == pytest.approx(5.0, abs=4e-4)


def test_echoes_are_longer_and_losses_are_missing() -> None:
    reading = heard(config(**QUIET, sim__multipath_probability=0.25, sim__loss_probability=0.5), 4000)
    assert len(reading.delays_s) == pytest.approx(2000, abs=130)  # four standard deviations
    excess_m = reading.delays_s * 344.0 - 5.0
    assert excess_m.min() > -1e-9
    echoes = excess_m > 1e-9
    assert echoes.mean() == pytest.approx(0.25, abs=0.04)
    assert excess_m[echoes].mean() == pytest.approx(0.5, abs=0.08)


def test_thermometers_have_errors_of_their_own() -> None:
    motes = field(config(sim__thermometer_sigma_c=2.0), [[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]])
    told = [one.temperature_c for one in motes.listen([(0, 1), (0, 2), (1, 2)], 1, np.random.default_rng(2))]
    assert told[0] != told[1] == told[2]


def test_the_usable_region() -> None:
    cone = config(transducer__is_omnidirectional=False).transducer
    assert usable_reach(cone, 0.0, 0.0) == 10.0
    assert usable_reach(cone, np.pi / 6.0, 0.0) == pytest.approx(9.5, abs=1e-4)
    assert usable_reach(cone, np.pi / 6.0, np.pi / 6.0) == pytest.approx(9.025, abs=1e-3)
    assert usable_reach(cone, 1.4, 0.0) == 0.0
    assert usable_reach(config().transducer, 3.0, 3.0) == 10.0


def test_motes_hear_each_other_as_they_face() -> None:
    cfg = config(transducer__is_omnidirectional=False)
    facing = field(cfg, [[0.0, 0.0], [5.0, 0.0], [0.0, 3.5]], [[1.0, 0.0], [-1.0, 0.0], [1.0, 0.0]])
    assert facing.receives(0, 1)
    assert not facing.receives(0, 2)  # side by side, both looking across the field
    assert facing.receives(1, 2) == facing.receives(2, 1) is True
    near = field(cfg, [[0.0, 0.0], [0.05, 0.0], [11.0, 0.0]])
    assert not near.receives(0, 1)
    assert not near.receives(0, 2)


def test_layouts() -> None:
    stands = true_motes(config(), np.random.default_rng(0))
    assert stands.positions_m.shape == (20, 2)
    first = stands.positions_m[2:5]
    sides = [np.linalg.norm(first[a] - first[b]) for a, b in ((0, 1), (1, 2), (0, 2))]
    assert sides == pytest.approx([0.5, 0.5, 0.5], abs=1e-6)
    motes = {
        "P": {"place_m": [0.0, 0.0, 2.5], "facing": [0.0, 0.0, -2.0]},
        "Q": {"place_m": [1.0, 0.0, 2.5], "facing": [0.0, 0.0, -1.0]},
    }
    ceiling = true_motes(config(layout="motes", dimension=3, motes=motes), np.random.default_rng(0))
    assert ceiling.names == ("P", "Q")
    assert ceiling.facings[0].tolist() == [0.0, 0.0, -1.0]
    drawn = config(layout="random", random__count=50, random__size_m=[10.0, 4.0])
    field_of = true_motes(drawn, np.random.default_rng(3))
    assert field_of.positions_m.max(axis=0) == pytest.approx([10.0, 4.0], rel=0.1)
    assert (true_motes(drawn, np.random.default_rng(3)).positions_m == field_of.positions_m).all()
