import numpy as np
import pytest

from ccatp.mirror.mirror import Mirror
from ccatp.survey.planning.escape import find_escape
from ccatp.survey.planning.legs import build_body, build_places, sensor_depths
from ccatp.survey.planning.search import SearchNode
from tests.support.cases import slow_case
from tests.support.scenario import config_of, mirror_of

ALONG_RAD = np.radians([-3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0])


@pytest.mark.parametrize("name", ["fyst-m1", "fyst-m2", "thesis-m1", "thesis-m2"])
@pytest.mark.parametrize("depth_m", [0.101, slow_case(0.102), 0.105, slow_case(0.11)])
def test_a_robot_that_stands_beside_the_rim_gets_away_without_a_sensor_near_it(name: str, depth_m: float) -> None:
    """The lowest row of points is 0.106 m from the rim; a robot that stops 6 mm too low has room to turn for 7 deg."""
    cfg, mirror = config_of(name), mirror_of(name)
    body = build_body(cfg.robot, cfg.mission)
    x_m, y_m = _beside_the_rim(mirror, depth_m)
    (place,) = build_places(mirror, body, np.array([x_m]), np.array([y_m]))
    x, y = np.array(x_m), np.array(y_m)
    for course_rad in ALONG_RAD[sensor_depths(mirror, body, x, y, ALONG_RAD) >= body.turn_clearance_m]:
        escape = find_escape(mirror, body, SearchNode(place, course_rad, 0.0), cfg.limits)
        turn = np.linspace(course_rad, escape.course_rad, 50)
        assert sensor_depths(mirror, body, x, y, turn).min() >= body.turn_clearance_m - 1e-5  # between two courses
        assert escape.place.depth_m >= body.turning_depth_m


def _beside_the_rim(mirror: Mirror, depth_m: float) -> tuple[float, float]:
    """A place at this distance above the middle of the lowest edge of the rim, which runs along x."""
    vertices = mirror.rim.vertices
    y_m = vertices[:, 1].min()
    x_m = vertices[np.isclose(vertices[:, 1], y_m), 0].mean()
    return float(x_m), float(y_m + depth_m)
