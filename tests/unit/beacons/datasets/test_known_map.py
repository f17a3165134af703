"""Maps of beacons that are known before a run: files of them, and what each is refused for."""

from pathlib import Path

import numpy as np
import pytest

from ccatp.beacons.datasets.known_map import FINEST_M, SURVEYED_M, read_known_map
from ccatp.beacons.datasets.reader import read_run
from ccatp.beacons.datasets.sheets import write_beacons
from ccatp.beacons.datasets.tables import RadioDataError
from ccatp.beacons.estimation.recording import Known
from tests.unit.beacons.datasets.sets import BEACONS, csv_lines, world, write_lines

PLACES_M = np.array([*BEACONS.values()])


def test_a_table_has_its_own_sigmas_units_and_heights(tmp_path: Path) -> None:
    lines = ["Anchor ID;X [cm];Y [cm];Z [cm];Sigma [mm]", "A;100;-20,5;250;5", "B;0;0;;"]
    found = read_known_map(write_lines(tmp_path / "a.csv", lines))
    assert found.names == ("A", "B")
    np.testing.assert_allclose(found.places_m, [[1.0, -0.205], [0.0, 0.0]])
    np.testing.assert_array_equal(found.heights_m, [2.5, np.nan])
    sigmas = np.array([0.005, 0.005, SURVEYED_M, SURVEYED_M])
    np.testing.assert_allclose(found.covariance_m2, np.diag(sigmas**2 + FINEST_M**2))


def test_the_survey_of_a_recording_is_a_map(tmp_path: Path) -> None:
    found = read_known_map(write_lines(tmp_path / "a.csv", csv_lines(world(seconds=20.0))))
    assert found.names == tuple(BEACONS)
    np.testing.assert_allclose(found.places_m, PLACES_M)


@pytest.mark.parametrize("size", [2, 3])
def test_a_map_that_was_written_keeps_its_joint_covariance(tmp_path: Path, size: int) -> None:
    rng = np.random.default_rng(1)
    places, root = rng.normal(size=(3, size)), rng.normal(size=(3 * size, 3 * size))
    write_beacons(tmp_path / "m.toml", ["A", "B", "C"], places, root @ root.T, "own")
    found = read_known_map(tmp_path / "m.toml")
    flat = [size * k + axis for k in range(3) for axis in range(2)]
    np.testing.assert_allclose(found.places_m, places[:, :2])
    np.testing.assert_allclose(found.covariance_m2, (root @ root.T)[np.ix_(flat, flat)] + FINEST_M**2 * np.eye(6))
    part = found.of(["C", "nobody", "A"])
    assert part.names == ("C", "A")
    np.testing.assert_allclose(part.covariance_m2[:2, 2:], found.covariance_m2[4:6, :2])
    assert np.isnan(found.heights_m).all() == (size == 2)


def test_the_heights_of_a_map_project_the_ranges(tmp_path: Path) -> None:
    file = write_lines(tmp_path / "mine.csv", [one for one in csv_lines(world()) if not one.startswith("beacon")])
    rows = [f"{name},{x},{y},0.3" for name, (x, y) in BEACONS.items()]
    known = Known(read_known_map(write_lines(tmp_path / "m.csv", ["beacon,x,y,z", *rows])))
    slant = read_run(file, None, None).readings.range_m
    np.testing.assert_allclose(read_run(file, None, None, known=known).readings.range_m, np.sqrt(slant**2 - 0.09))


@pytest.mark.parametrize(
    ("name", "lines", "what"),
    [
        ("m.csv", ["anchor,x", "A,1"], "m.csv: has no header with beacon, x and y"),
        ("m.csv", ["anchor,x,y", "A,1,2", "A,3,4"], "m.csv: holds beacon A twice"),
        ("m.csv", ["anchor,x,y", "A,1,"], "place of A: is no place within"),
        ("m.csv", ["anchor,x,y", "A,1,far"], "m.csv:2: y is 'far', not a number"),
        ("m.csv", ["anchor,x,y", "A,1,2", ",3,4"], "m.csv:3: the place has no name of a beacon"),
        ("m.csv", ["anchor,x,y,sigma", "A,1,2,1e200"], "place of A: its sigma of 1e.200 m is none"),
        ("m.csv", ["anchor,x,y,sigma", "A,1,2,-0.1"], "place of A: its sigma of -0.1 m is none"),
        ("m.csv", ["odom,0,0,0", "odom,1,0,0"], "has no event beacon"),
        ("m.toml", ["[beacons"], "is no map of beacons"),
        ("m.toml", ["frame = 'own'"], "is no map of beacons .*'beacons' is missing"),
        ("m.toml", ["[beacons]"], "holds no beacon"),
        ("m.toml", ["[beacons.A]", "position_m = [1, 2, 3]", "sigma_m = [1, 1]"], "is no map of beacons"),
        (
            "m.toml",
            ["[beacons.A]", "position_m = [1, 2]", "sigma_m = [1, 1]", "[joint]", "covariance_m2 = [[1, 2], [2, 1]]"],
            "negative eigenvalue",
        ),
    ],
)
def test_what_is_no_map_is_one_line(name: str, lines: list[str], what: str, tmp_path: Path) -> None:
    with pytest.raises(RadioDataError, match=rf"{what}.*\(see docs/radio_data\.md\)$"):
        read_known_map(write_lines(tmp_path / name, lines))


def test_a_map_of_other_beacons_is_refused(tmp_path: Path) -> None:
    known = Known(read_known_map(write_lines(tmp_path / "m.csv", ["anchor,x,y", "A,1,2"])))
    file = write_lines(tmp_path / "mine.csv", csv_lines(world(seconds=20.0)))
    with pytest.raises(
        RadioDataError, match="the map has none of its beacons: it has A, the readings are of 6, 7, 8, 9"
    ):
        read_run(file, None, None, known=known)
