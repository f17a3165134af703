"""Rank and free directions before anything is estimated: chains, ladders, space, bodies, what is known, scale."""

import numpy as np
import pytest

from ccatp.beacons.cricket.map_fit import MapModel
from ccatp.beacons.cricket.range_network import RigidBody
from ccatp.beacons.cricket.rigidity import Freedom, find_freedom, generic_state
from tests.unit.motes.fields import ADJACENT, ALL, HEADS, ZIGZAG, FloatArray, Pairs, near_pairs, network_of

NOWHERE = np.full((6, 2), np.nan)
SURVEYED = NOWHERE.copy()
SURVEYED[0], SURVEYED[1, 1] = HEADS[0], HEADS[1, 1]


def freedom(pairs: Pairs, known_m: FloatArray | None = None, **options: bool) -> Freedom:
    model = MapModel(network_of(HEADS, pairs, known_m=known_m), **options)
    return find_freedom(model, generic_state(model, np.random.default_rng(0)))


def test_a_zigzag_turns_at_its_four_hinges() -> None:
    found = freedom(ZIGZAG, SURVEYED)
    assert (found.unknowns, found.rank, found.deficiency) == (9, 5, 4)
    assert found.frame == ()
    assert found.flexes == (
        "M2, M3, M4, M5 against M0, M1",
        "M3, M4, M5 against M0, M1",
        "M4, M5 against M0, M1",
        "M5 against M0, M1",
    )
    assert [set(part) for part in found.parts] == [{0, 1}, {1, 2}, {2, 3}, {3, 4}, {4, 5}]


@pytest.mark.parametrize("pairs", [ADJACENT, ALL])
def test_nine_pairs_hold_the_field(pairs: Pairs) -> None:
    assert freedom(pairs, SURVEYED).deficiency == 0
    free = freedom(pairs)
    assert (free.deficiency, free.rank) == (0, 9)
    assert free.frame == ("translation along x", "translation along y", "rotation")
    assert free.parts == ((0, 1, 2, 3, 4, 5),)


def test_one_mote_that_hangs_on_one_range() -> None:
    found = freedom([pair for pair in ALL if 5 not in pair] + [(0, 5)])
    assert found.deficiency == 1
    assert found.flexes == ("M5 against M0, M1, M2, M3, M4",)
    assert found.parts == ((0, 1, 2, 3, 4), (0, 5))


def test_a_known_coordinate_leaves_the_rest_of_the_frame() -> None:
    known = NOWHERE.copy()
    known[0, 1] = known[1, 1] = 1.0
    assert freedom(ALL, known).frame == ("translation along x",)
    known = NOWHERE.copy()
    known[2] = (0.0, 4.5)
    assert freedom(ALL, known).frame == ("rotation",)


def test_a_scale_is_taken_for_the_size_of_the_map() -> None:
    found = freedom(ALL, with_scale=True)
    assert found.deficiency == 1
    assert found.calibration == ("range scale: the map takes it up",)
    assert found.flexes == ()
    assert freedom(ALL, with_offset=True).deficiency == 0
    known = NOWHERE.copy()
    known[:3] = HEADS[:3]
    assert freedom(ALL, known, with_scale=True).deficiency == 0


def test_a_ladder_has_nothing_to_spare_for_an_offset() -> None:
    found = freedom(ADJACENT, with_offset=True)
    assert found.deficiency == 1
    assert found.calibration == ("range offset: the map takes it up",)


def test_shapes_of_stands_hold_what_ranges_do_not() -> None:
    local = np.array([[0.0, 0.0], [0.5, 0.0], [0.2, 0.4]])
    places = np.concatenate([local, local + np.array([5.0, 1.0])])
    pairs = [(0, 3), (1, 4), (2, 5)]
    bodies = [RigidBody("a", (0, 1, 2), local), RigidBody("b", (3, 4, 5), local)]
    without = MapModel(network_of(places, [(0, 3), (3, 1), (1, 4), (4, 2), (2, 5)]))
    rng = np.random.default_rng(0)
    assert find_freedom(without, generic_state(without, rng)).deficiency == 4
    with_shapes = MapModel(network_of(places, pairs, bodies=bodies))
    found = find_freedom(with_shapes, generic_state(with_shapes, rng))
    assert (found.unknowns, found.rank, found.deficiency) == (6, 3, 0)


def test_space_asks_for_more() -> None:
    rng = np.random.default_rng(1)
    places = rng.normal(size=(6, 3))
    model = MapModel(network_of(places, near_pairs(places, 99.0)))
    found = find_freedom(model, generic_state(model, rng))
    assert (found.deficiency, len(found.frame)) == (0, 6)
    assert found.frame[3:] == ("rotation 1", "rotation 2", "rotation 3")
    few = MapModel(network_of(places, [pair for pair in near_pairs(places, 99.0) if 5 not in pair] + [(0, 5), (1, 5)]))
    assert find_freedom(few, generic_state(few, rng)).flexes == ("M5 against M0, M1, M2, M3, M4",)


def test_motes_on_a_ceiling_move_across_it_unseen() -> None:
    """Generic places are rigid; those of a plane are not, to first order: an estimate there shows it."""
    rng = np.random.default_rng(2)
    places = np.column_stack([rng.uniform(0.0, 5.0, (6, 2)), np.full(6, 2.5)])
    model = MapModel(network_of(places, near_pairs(places, 99.0)))
    assert find_freedom(model, generic_state(model, rng)).deficiency == 0
    assert find_freedom(model, model.state(places)).deficiency == 3
