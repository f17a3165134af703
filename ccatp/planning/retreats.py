"""Pure. Places to turn near a measurement point at the rim, each one short straight move away from it."""

from math import cos, pi, sin

import numpy as np

from ccatp.mirror.mirror import Mirror
from ccatp.planning.stance import Body, FloatArray, Place

# A shorter move would be steered by the error of the position: 1 mm on 20 mm are the 0.05 rad that need no turn.
_DISTANCES_M = np.r_[20:100:5, 100:301:10] * 1e-3
_SLANTS_RAD = np.radians([0, 2, -2, 4, -4, 6, -6, 8, -8, 10, -10, 12, -12, 14, -14])
_COURSES_RAD = np.radians([0, 90, 180, 270])[:, None] + _SLANTS_RAD  # (sides, slants)


def find_retreats(mirror: Mirror, body: Body, places: list[Place]) -> list[tuple[Place, ...]]:
    """For each place where the robot cannot turn freely the nearest ones around it where it can.

    At most one to each side of the grid of panels, straight or slightly slanted: slanted where the place is in a
    corner, or to move off along the rim.

    Args:
        mirror: the mirror.
        body: the robot and its clearances.
        places: where it may have to turn.

    Returns:
        The retreats of each place; none for one at which the robot can turn.
    """
    near = [k for k, place in enumerate(places) if place.stance is not None]
    x0 = np.array([places[k].x_m for k in near]).reshape(-1, 1, 1, 1)
    y0 = np.array([places[k].y_m for k in near]).reshape(-1, 1, 1, 1)
    depths = mirror.rim.signed_distances_m(
        x0 + _DISTANCES_M * np.cos(_COURSES_RAD)[..., None], y0 + _DISTANCES_M * np.sin(_COURSES_RAD)[..., None]
    )
    found: list[tuple[Place, ...]] = [()] * len(places)
    for k, sides in zip(near, depths, strict=True):
        nearest = [_nearest(places[k], body, *side) for side in zip(sides, _COURSES_RAD, strict=True)]
        found[k] = tuple(retreat for retreat in nearest if retreat is not None)
    return found


def _nearest(place: Place, body: Body, depths: FloatArray, courses_rad: FloatArray) -> Place | None:
    """Nearest place to turn on one side, by the straightest of equally long moves."""
    faced = np.array([place.can_face(course) or place.can_face(course + pi) for course in courses_rad.tolist()])
    is_good = (depths >= body.turning_depth_m) & faced[:, None]
    if not is_good.any():
        return None
    step = int(np.argmax(is_good.any(axis=0)))
    slant = int(np.argmax(is_good[:, step]))
    distance_m, course = float(_DISTANCES_M[step]), float(courses_rad[slant])
    return Place(place.x_m + distance_m * cos(course), place.y_m + distance_m * sin(course), float(depths[slant, step]))
