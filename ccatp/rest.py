"""At rest: the definitions, each with its limit. docs/glossary.md has the words.

No other module has such a limit of its own. The times for which a limit must hold belong to its users, and the limits
of a measurement are keys of the configuration (``control.settle_*``, ``localizer.full_state.rest_*``).
"""

WHEEL_STANDS_RAD_S = 0.02
"""A wheel stands: the mean of its rate in a frame is below this, 0.6 mm/s at the rim.

Twenty times the noise of an encoder sample (thesis table 2.1), an eightieth of the rate at 0.05 m/s.
"""

LOADED_WHEEL_STANDS_RAD_S = 0.05
"""A held wheel stands on a slope: it carries the robot, and the load turns it more slowly than this."""

ROBOT_TURNS_RAD_S = 0.02
"""The robot turns: its yaw rate by the wheels, averaged over some frames, is at least this."""

AT_REST_M_S = 5e-4
"""The robot is at rest: its centre, or the rim of a wheel, is slower than this over several frames.

Ten times what the noise of the encoders gives over ``health.stall_time_s``.
"""

ALMOST_AT_REST_M_S = 0.002
ALMOST_AT_REST_RAD_S = 0.01
"""The robot is almost at rest: commanded to stand and slower than this, it travels less than 0.2 mm until it stands."""

NO_MOTION_M = 2e-5
NO_MOTION_RAD = 1e-4
"""A step of the odometry without motion: less travel, and less turn of the robot or of a wheel (3 um at the rim)."""
