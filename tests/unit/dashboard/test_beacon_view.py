"""The page of a mission among beacons, from messages in virtual time."""

import json
from typing import Any

import msgspec
import pytest

from ccatp.beacons.mission import BeaconState
from ccatp.config.beacon_models import RadioConfig
from ccatp.config.load import load_radio_config
from ccatp.errors import ConfigError
from ccatp.links.topics import (
    BeaconArrival,
    BeaconMapMessage,
    BeaconPlaces,
    BeaconTrack,
    BeaconTruth,
    RobotShape,
    Scene,
)
from ccatp.report.beacon_record import expected_rms_m, true_rms_m
from ccatp.report.dashboard.beacon_view import BeaconView, beacon_ground, worst_sigma_m
from ccatp.report.dashboard.view import MEASURED, PLANNED

ELLIPSE = (0.8, 0.8, 4e-4, 0.0, 4e-4)


def config(system: str = "zigbee", **keys: object) -> RadioConfig:
    return load_radio_config(None, {"system": system, **keys})


@pytest.fixture
def view() -> BeaconView:
    return BeaconView(config(), is_sim=True)


def told_map(t_s: float = 1.0, **fields: Any) -> BeaconMapMessage:
    known: dict[str, Any] = {
        "seq": 10, "t_s": t_s, "system": "zigbee", "pose": (0.8, 0.8, 0.0), "pose_ellipse": ELLIPSE,
        "beacons": {"a": (0.3, 0.0, 0.03, 0.0, 0.01), "b": (3.0, 0.4, 0.02, 0.0, 0.02)}, "target": None,
        "obstacles": [], "waypoints": [(0.8, 0.8), (2.2, 0.8)], "next_waypoint": 1, "distances": [1.5, 0.7],
        "nis_sum": 0.0, "nis_size": 0, "refused": 0, "notes": {},
    }  # fmt: skip
    return BeaconMapMessage(**(known | fields))


def arrival(waypoint: int, lap: int = 0) -> BeaconArrival:
    return BeaconArrival(seq=1, t_s=1.0, waypoint=waypoint, lap=lap, place=(0.8, 0.8), estimate=ELLIPSE)


def encoded(data: dict[str, Any]) -> dict[str, Any]:
    """As a page gets it."""
    decoded: dict[str, Any] = json.loads(msgspec.json.encode(data))
    return decoded


def test_waypoints_are_done_one_after_the_other_and_anew_in_the_next_lap(view: BeaconView) -> None:
    view.receive(arrival(0), 0.0)
    view.receive(arrival(1), 0.0)
    assert view.news(0.0)["points"] == [[0, MEASURED, None], [1, MEASURED, None]]
    assert view.news(0.0)["points"] == []
    view.receive(arrival(0, lap=1), 0.0)
    assert view.news(0.0)["points"] == [[0, MEASURED, None], *([k, PLANNED, None] for k in (1, 2, 3))]
    assert view.everything(0.0)["points"] == [[0, MEASURED, None]]


def test_the_map_against_what_is_expected_and_what_is_true(view: BeaconView) -> None:
    view.receive(BeaconPlaces(seq=0, t_s=0.0, places={"a": (0.0, 0.0), "b": (3.0, 0.0)}), 0.0)
    view.receive(told_map(), 0.0)
    view.receive(told_map(1.5, nis_sum=6.0, nis_size=4, refused=2), 0.0)
    series = view.news(0.0)["series"]
    # Root mean squares of 0.3 and 0.4 m, and of variances of 0.04 for each place, in mm.
    assert series["map"] == [(1.5, pytest.approx(353.55), pytest.approx(200.0))]
    assert series["nis"] == [(1.5, 6.0, 4)]
    assert series["clearance"] == [(1.5, 0.7)]
    view.receive(told_map(2.0, nis_sum=7.0, nis_size=6, refused=2), 0.0)
    assert view.news(0.0)["series"]["nis"] == [(2.0, 1.0, 2)]
    view.receive(told_map(2.5), 0.0)  # of another main loop: it begins anew
    assert "nis" not in view.news(0.0)["series"]


def test_facts(view: BeaconView) -> None:
    assert view.everything(0.0)["facts"] == []
    view.receive(told_map(nis_sum=6.0, nis_size=4, refused=2), 0.0)
    assert dict(view.everything(0.0)["facts"]) == {
        "beacons on the map": "2",
        "error of the map, expected": "200.0 mm",
        "readings used, refused": "4, 2",
        "mean NIS": "1.50",
        "to the waypoint": "1.40 m",
        "lap": "1 of 2",
    }


def test_a_target_is_followed() -> None:
    view = BeaconView(config("follow"), is_sim=True)
    target = (1.8, 0.8, 0.01, 0.0, 0.01)
    for t_s in (1.0, 1.5):
        view.receive(told_map(t_s, target=target, beacons={"target": target}, waypoints=[], next_waypoint=-1), 0.0)
    told = view.news(0.0)
    assert told["series"]["target"] == [(1.5, 1.0, 0.6)]
    assert "map" not in told["series"]  # the one that moves is none of the map
    assert dict(told["facts"])["distance to the target"] == "1.00 m"


def test_the_error_against_the_truth_is_the_worst_of_each_second(view: BeaconView) -> None:
    rows: Any = [(k, 0.1 * k, 1.0, 2.0, 0.0, 4e-4, 0.0, 1e-4, 0.0, 0.0, 1e-4, 1.0, 2.0) for k in (10, 15, 20)]
    view.receive(BeaconTrack(seq=20, t_s=2.0, rows=rows), 0.0)
    true: Any = [(k, 0.1 * k, 1.0, 2.01, 0.0, None, None, None) for k in (10, 15, 20)]
    view.receive(BeaconTruth(seq=20, t_s=2.0, rows=true), 0.0)
    assert view.news(0.0)["series"]["error"] == [(1.0, pytest.approx(10.0), pytest.approx(60.0))]


def test_the_scene_without_what_the_page_draws_itself(view: BeaconView) -> None:
    kinds = ("robot", "trail", "waypoint", "beacon", "obstacle")
    view.receive(BeaconPlaces(seq=0, t_s=0.0, places={"a": (0.0, 1.0)}), 0.0)
    view.receive(Scene(seq=1, t_s=1.0, shapes=[RobotShape(kind, kind, 1.0, 1.0) for kind in kinds]), 0.0)
    told = encoded(view.news(0.0))
    assert [shape["kind"] for shape in told["shapes"]] == ["true", "beacon", "obstacle"]
    assert told["shapes"][0]["y_m"] == 1.0
    assert [link["name"] for link in told["links"]] == ["main loop", "danger loop", "robot"]  # no laser


def test_the_path_comes_with_the_map(view: BeaconView) -> None:
    for t_s, x_m in ((1.0, 0.8), (1.5, 0.801), (2.0, 0.9)):  # nobody sees a millimetre
        view.receive(told_map(t_s, pose=(x_m, 0.8, 0.0)), 0.0)
    assert view.everything(0.0)["path"] == [(0.8, 0.8), (0.9, 0.8)]


def test_figures() -> None:
    assert expected_rms_m({}) is None
    assert true_rms_m({"a": ELLIPSE}, {}) is None
    assert worst_sigma_m(1.0, 0.0, 4.0) == pytest.approx(2.0)
    assert worst_sigma_m(2.0, 1.0, 2.0) == pytest.approx(3.0**0.5)


@pytest.mark.parametrize("system", ["zigbee", "follow", "cricket"])
def test_the_ground(system: str) -> None:
    cfg = config(system)
    told = encoded(beacon_ground(cfg, is_sim=True, needs_token=True))
    assert told["needs_token"] is True
    assert told["rim"][2] == list(cfg.workspace.size_m)
    assert told["states"] == [str(state) for state in BeaconState]
    is_following = system == "follow"
    names = [] if is_following else [f"waypoint {k + 1}" for k in range(len(cfg.workspace.waypoints_m))]
    assert [point[0] for point in told["points"]] == names
    assert ("target" in told["plots"]) is is_following
    assert told["words"]["unit"] == ("seconds" if is_following else "waypoints")


def test_a_page_beyond_this_machine_wants_a_token() -> None:
    with pytest.raises(ConfigError, match=r"dashboard\.host = \"0\.0\.0\.0\" is beyond this machine"):
        config(**{"dashboard.host": "0.0.0.0"})
