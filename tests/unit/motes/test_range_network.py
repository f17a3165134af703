"""The graph of ranges: what is refused, and what the refusals say."""

import numpy as np
import pytest

from ccatp.beacons.cricket.range_network import (
    BadRange,
    Disconnected,
    MoteRange,
    MoteUnderdetermined,
    PairMeans,
    RigidBody,
    UnknownMote,
    build_network,
    graph_pairs,
    list_names,
)
from ccatp.errors import ExitStatus


def row(first: str, second: str, range_m: float = 1.0, sigma_m: float = 0.01) -> MoteRange:
    return MoteRange(first, second, range_m, sigma_m)


def test_motes_come_as_they_are_named() -> None:
    network = build_network([row("B", "A"), row("A", "C")], 2)
    assert network.names == ("B", "A", "C")
    assert network.first.tolist() == [0, 1]
    assert network.loose == (0, 1, 2)


def test_a_mote_that_is_none() -> None:
    with pytest.raises(UnknownMote, match="range A to X: no mote 'X'; there are A, B") as caught:
        build_network([row("A", "X")], 2, ["A", "B"])
    assert caught.value.exit_status == ExitStatus.USAGE


@pytest.mark.parametrize(
    ("bad", "what"),
    [
        (row("A", "B", -0.1), r"A to B: -0.1 m is no distance"),
        (row("A", "B", float("nan")), "nan m is no distance"),
        (row("A", "B", 1.0, 0.0), "sigma of 0 m, must be positive"),
        (row("A", "A"), "from a mote to itself"),
    ],
)
def test_ranges_that_none_can_be(bad: MoteRange, what: str) -> None:
    with pytest.raises(BadRange, match=what):
        build_network([bad], 2)


def test_nothing_to_map() -> None:
    with pytest.raises(MoteUnderdetermined, match="0 ranges among 0 motes"):
        build_network([], 2)


def test_a_graph_in_two_parts() -> None:
    with pytest.raises(Disconnected, match="into 2 parts with no range between them: C, D on one side"):
        build_network([row("A", "B"), row("A", "E"), row("C", "D")], 2)


def test_a_body_joins_its_motes() -> None:
    body = RigidBody("stand", (1, 2), np.array([[0.0, 0.0], [0.3, 0.4]]))
    network = build_network([row("A", "B"), row("C", "D")], 2, ["A", "B", "C", "D"], [body])
    assert graph_pairs(network).tolist() == [[0, 1], [1, 2], [2, 3]]
    assert network.loose == (0, 3)


def test_parts_that_hang_on_known_places_are_no_error() -> None:
    known = np.array([[0.0, 0.0], [1.0, 0.0], [np.nan, np.nan], [0.0, 5.0], [1.0, 5.0], [np.nan, np.nan]])
    rows = [row("a", "c"), row("b", "c"), row("d", "f")]
    assert build_network(rows, 2, list("abcdef"), (), known).count == 6
    known[3] = np.nan
    with pytest.raises(Disconnected, match="into 2 parts"):
        build_network(rows, 2, list("abcdef"), (), known)


def test_means_of_pairs_weigh_by_variance() -> None:
    means = PairMeans(build_network([row("A", "B", 1.0, 0.1), row("B", "A", 2.0, 0.2), row("B", "C")], 2))
    found = means.between(1, 0)
    assert found is not None
    assert found == pytest.approx((1.2, np.sqrt(1.0 / 125.0)))
    assert means.between(0, 2) is None
    assert means.partners(1) == [0, 2]
    assert not means.are_all_linked([0, 1, 2])


def test_long_lists_are_cut() -> None:
    assert list_names([str(number) for number in range(9)]) == "0, 1, 2, 3, 4, 5 and 3 more"
