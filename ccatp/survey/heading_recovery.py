"""Finding a doubtful heading by short legs with a fix at each end."""

from math import cos, sin

from ccatp.config.models import MissionConfig, RobotConfig
from ccatp.core import DeckPose, Stop, StopKind
from ccatp.mirror.mirror import Mirror
from ccatp.survey.planning.legs import build_body, course_of_heading

# There and back, twice: a filter of a heading that was far off needs more than one look.
MOST_LEGS = 4
_STEP_M = 0.01
# A shorter leg says less of the heading than was known before.
_SHORTEST_M = 0.04
# The robot may leave the leg to either side by this many standard deviations of its heading.
_SIGMAS = 2.0
# Of the way at least this part must lead away from the rim.
_LEAVING = 0.5
# A heading that so many times the limit is wrong leads a leg of the survey astray.
_LOST = 2.0


class HeadingRecovery:
    """While the heading is in doubt: which leg, straight ahead or back, shows more of it."""

    def __init__(self, mirror: Mirror, robot: RobotConfig, cfg: MissionConfig) -> None:
        self._mirror, self.limit_rad, self._wanted_m = mirror, cfg.heading_doubt_rad, cfg.alignment_leg_m
        # Whatever the heading, no sensor leaves the mirror.
        self._clearance_m = max(build_body(robot, cfg).turning_depth_m, cfg.leg_clearance_m)

    def is_needed(self, sigma_rad: float) -> bool:
        """Whether the heading is known so badly that no leg of the survey should begin with it."""
        return sigma_rad > _LOST * self.limit_rad

    def plan(self, deck: DeckPose, sigma_rad: float, *, was_reverse: bool) -> Stop | None:
        """The stop of the next leg, ``None`` where there is no room for any.

        It leads back where the last one came from; where there is less room, whichever way has more.
        """
        course = course_of_heading(self._mirror, deck)
        rooms = []
        for is_reverse in (not was_reverse, was_reverse):
            sign = -1.0 if is_reverse else 1.0
            way = sign * cos(course), sign * sin(course)
            rooms.append((self._room_m(deck, way, sigma_rad), is_reverse, way))
        room_m, is_reverse, (cx, cy) = max(rooms, key=lambda room: room[0])
        if room_m < _SHORTEST_M:
            return None
        return Stop(deck.x_m + room_m * cx, deck.y_m + room_m * cy, StopKind.CALIBRATE, reverse=is_reverse)

    def _room_m(self, deck: DeckPose, way: tuple[float, float], sigma_rad: float) -> float:
        rim, spread = self._mirror.rim, _SIGMAS * sigma_rad
        room_m, wanted_m = 0.0, self._wanted_m
        depth_m = rim.signed_distance_m(deck.x_m, deck.y_m)
        while room_m < wanted_m:
            step_m = min(room_m + _STEP_M, wanted_m)
            before_m, depth_m = depth_m, rim.signed_distance_m(deck.x_m + step_m * way[0], deck.y_m + step_m * way[1])
            # Where it could not turn the robot may still leave the rim behind.
            is_leaving = depth_m - before_m > _LEAVING * (step_m - room_m)
            if depth_m < self._clearance_m + spread * step_m and not is_leaving:
                break
            room_m = step_m
        return room_m
