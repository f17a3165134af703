"""Motion of the wheels while the encoders give no samples, predicted from the drives that are in force.

A wheel is a first-order servo: ``T dw/dt + w = u``, so its follow error ``d = integral of u - angle`` is ``T w``. Over
a time t with a constant set point ``d' = u T + (d - u T) exp(-t/T)`` and ``turn = u t - (d' - d)``. While there are
samples the follow error is measured, and T is learned from it. So the angle at which a wheel comes to rest after its
set point is zero does not depend on T at all; T matters only while the wheel runs down or up.

What is not known, as the covariance of both angles' errors since the begin of the gap:

* the moment at which a set point acts, within the step of the control loop, times its change;
* the follow error at its begin (dead time of the control loop, readings of the angles): it appears with the share
  1 - exp(-t/T);
* the load of a wheel (slope, friction): a real servo follows its set point only to a share of the travel, which is
  learned from d - T w since the last rest; within the gap the rate is wrong by twice this share, and the servo may
  correct the shortfall or not. It is in part the same for both wheels, so the share is learned for their mean and for
  their difference, each in the direction of its wheel, and apart for legs and turns;
* T: its learned standard deviation, times the change of the follow error with T;
* the moment at which a robot held its wheels by a rule of its own, see ``SetPoints``;
* the set points, where they are not known: anything from the recent rate on to an immediate stop.
"""

from math import copysign, exp, sqrt
from typing import NamedTuple

from ccatp.control.wheel_motion import SetPoints
from ccatp.rest import NO_MOTION_RAD

# A drive acts in the next step of the control loop, which has 500 Hz or more: uniform over 2 ms.
_DEAD_TIME_S = 0.0006
# Standard deviation of a lag that was never measured: the worlds draw it uniformly from 20 % to both sides.
_LAG_SPREAD = 0.2 / sqrt(3.0)
# A lag is never known better than to this part: servo and load are not exactly of first order.
_LEAST_LAG_SPREAD = 0.005
_RATE_SIGMA_RAD_S = 0.05  # of the rate by which the follow error is divided: two counts in 40 ms, smoothed
# Share of its travel by which a servo under load is off: before any motion, the least, and the travel that shows it.
_LOAD_SHARE, _LEAST_LOAD_SHARE, _LOADED_RAD = 0.02, 2e-4, 1.0
# Motion over which the share is averaged, some legs; and for how much of it the value before any motion counts.
_LOAD_MEMORY_S, _LOAD_PRIOR_S = 3.0, 0.1
_FAST_RAD_S = 0.5  # a slower wheel shows nothing of its lag
_ALIKE_S = 1.0  # for about so long a servo deviates from first order in the same way
# After this time without a drive the robot stands: time-to-live of the last drive, and run-down of the wheels.
_STANDS_AFTER_S = 0.4


class CoastedMotion(NamedTuple):
    """Turns of the wheels in a frame without samples, rad, and the growth of the covariance of their errors, rad^2."""

    right_rad: float
    left_rad: float
    right_rad2: float
    left_rad2: float
    both_rad2: float  # covariance of right and left


WheelInput = SetPoints | CoastedMotion | None
"""Input of a localizer about the wheels besides samples: set points, or in a replay the motion predicted then."""


class LoadShares(NamedTuple):
    """Variance of the share of travel by which wheels fall short: ``mean`` of both, ``half`` of their difference.

    ``seen``: weight of the motion from which it is known, rad^4 s. The error of a share falls with the travel, its
    variance with the fourth power of it.
    """

    mean: float = 0.5 * _LOAD_SHARE**2
    half: float = 0.5 * _LOAD_SHARE**2
    seen: float = _LOAD_PRIOR_S * _LOADED_RAD**4

    @property
    def one(self) -> float:
        """Of one wheel."""
        return self.mean + self.half

    @property
    def both(self) -> float:
        """Covariance of both wheels, each in its own direction."""
        return self.mean - self.half

    def learned(self, dt_s: float, travel_rad: float, mean_rad2: float, half_rad2: float) -> "LoadShares":
        """With the squares of the shortfalls after a travel, in ``dt_s`` of motion."""
        travel2, least2 = travel_rad * travel_rad, 0.5 * _LEAST_LOAD_SHARE**2
        new = dt_s * travel2 * travel2
        seen = self.seen * max(1.0 - dt_s / _LOAD_MEMORY_S, 0.0) + new
        mean = self.mean + new / seen * (mean_rad2 / travel2 - self.mean)
        half = self.half + new / seen * (half_rad2 / travel2 - self.half)
        return LoadShares(max(mean, least2), max(half, least2), seen)


class WheelCoast:
    """Follows the set points of both wheels, and predicts the wheels without samples.

    ``gap_s``: length of the present gap, 0 while there are samples; ``has_moved``: the wheels turned in it; ``rates``:
    mean rates of the wheels in its last frame, rad/s.
    """

    def __init__(self, wheel_lag_s: float) -> None:
        self.gap_s = 0.0
        self._lag_s = wheel_lag_s
        self._spread2 = (_LAG_SPREAD * wheel_lag_s) ** 2
        self._least2 = (_LEAST_LAG_SPREAD * wheel_lag_s) ** 2
        self._follows = [0.0, 0.0]  # follow errors of the right and the left wheel, rad
        self._travels = [0.0, 0.0]  # of the set points since the last rest, rad
        self._shares = {False: LoadShares(), True: LoadShares()}  # of legs, and of turns
        self._is_turn = False
        self._is_known = self.has_moved = True  # the follow errors are measured
        self.begin(0.0, 0.0, 0.0, is_resting=True)

    def stand(self) -> None:
        """The wheels stand, and their set points are zero."""
        self._follows = [0.0, 0.0]
        self._travels = [0.0, 0.0]
        self._is_known = True

    def follow(self, dt_s: float, set_points: WheelInput, right_rad: float, left_rad: float) -> None:
        """Take a frame with samples: the set points of the wheels, and what they turned."""
        if set_points is None or set_points[2] or set_points[3]:
            self._is_known = False
            return
        follows, travels = self._follows, self._travels
        travels[0] += abs(set_points[0]) * dt_s
        travels[1] += abs(set_points[1]) * dt_s
        follows[0] += set_points[0] * dt_s - right_rad
        follows[1] += set_points[1] * dt_s - left_rad

    def learn(self, dt_s: float, right_rad_s: float, left_rad_s: float) -> None:
        """Learn the lag from the rates of the wheels, ``dt_s`` after the last call."""
        if not self._is_known or dt_s <= 0.0:
            return
        of_rate = (self._lag_s * _RATE_SIGMA_RAD_S) ** 2
        rates, is_turn = (right_rad_s, left_rad_s), right_rad_s * left_rad_s < 0.0
        shortfalls = [follow - self._lag_s * rate for follow, rate in zip(self._follows, rates, strict=True)]
        travel = 0.5 * (self._travels[0] + self._travels[1])
        if travel > _LOADED_RAD and min(abs(right_rad_s), abs(left_rad_s)) >= _FAST_RAD_S:
            right, left = (
                copysign(shortfalls[0], shortfalls[0] * right_rad_s),
                copysign(shortfalls[1], shortfalls[1] * left_rad_s),
            )
            # The error of the lag is the same for both wheels, that of the rates is not.
            mean2 = (0.5 * (right + left)) ** 2 - 0.5 * of_rate - self._spread2 * right_rad_s * right_rad_s
            half2 = (0.5 * (right - left)) ** 2 - 0.5 * of_rate
            self._shares[is_turn] = self._shares[is_turn].learned(dt_s, travel, mean2, half2)
        for rate, off, travel in zip(rates, shortfalls, self._travels, strict=True):
            if -_FAST_RAD_S < rate < _FAST_RAD_S:
                continue
            load = self._shares[is_turn].one * travel * travel
            noise = _ALIKE_S / dt_s * ((_DEAD_TIME_S * rate) ** 2 + of_rate + load)
            gain = self._spread2 * rate / (self._spread2 * rate * rate + noise)
            self._lag_s = max(self._lag_s + gain * off, 1e-3)
            self._spread2 = max((1.0 - gain * rate) * self._spread2, self._least2)

    def begin(self, right_rad_s: float, left_rad_s: float, reading_rad2: float, *, is_resting: bool) -> None:
        """Begin a gap at these rates of the wheels; ``reading_rad2``: variance of an angle's reading."""
        # right, left, both
        self._first2 = [0.0, 0.0, 0.0]
        self._shown2 = [0.0, 0.0, 0.0]
        self._first_set: tuple[float, float] | None = None
        self._by_lag = (0.0, 0.0)
        self._largest = 0.0
        self._largest_step = 0.0  # square of the largest change of the set points in the gap
        self._coasted = [0.0, 0.0]
        self._is_turn = right_rad_s * left_rad_s < 0.0
        self._kept = 1.0
        self._free = (right_rad_s, left_rad_s)
        self.rates = right_rad_s, left_rad_s
        self.has_moved = False
        if is_resting:
            return
        lag_s, first2, follows, shares = self._lag_s, self._first2, self._follows, self._shares[self._is_turn]
        kept = [0.0, 0.0]
        for k, rate in enumerate(self._free):
            # Two estimates of the follow error: the measured one, and lag times rate.
            shortfall2 = shares.one * self._travels[k] ** 2
            own = (_DEAD_TIME_S * rate) ** 2 + 2.0 * reading_rad2 + shortfall2
            of_rate = self._spread2 * rate * rate + (lag_s * _RATE_SIGMA_RAD_S) ** 2
            kept[k] = of_rate / (own + of_rate) if self._is_known else 0.0
            follows[k] += (1.0 - kept[k]) * (lag_s * rate - follows[k])
            first2[k] = kept[k] * own + shortfall2 if self._is_known else of_rate + shortfall2
        shortfall2 = shares.both * self._travels[0] * self._travels[1]
        first2[2] = self._sign() * shortfall2 * (1.0 + sqrt(kept[0] * kept[1]))

    def _sign(self) -> float:
        """Of the product of both wheels' directions."""
        return -1.0 if self._is_turn else 1.0

    def advance(
        self, dt_s: float, set_points: WheelInput, *, is_right: bool = True, is_left: bool = True
    ) -> CoastedMotion:
        """Take a frame in which the right, the left, or both wheels have no samples."""
        before_s, self.gap_s = self.gap_s, self.gap_s + dt_s
        if isinstance(set_points, CoastedMotion):
            found = set_points
        elif set_points is None:
            found = self._advance_unknown(before_s)
        else:
            found = self._advance(dt_s, set_points)
        right_rad, left_rad, right_rad2, left_rad2, both_rad2 = found
        self.rates = right_rad / dt_s, left_rad / dt_s
        self.has_moved = self.has_moved or abs(right_rad) + abs(left_rad) > NO_MOTION_RAD
        if not (is_right and is_left):
            right_rad2, left_rad2, both_rad2 = is_right * right_rad2, is_left * left_rad2, 0.0
        return CoastedMotion(right_rad, left_rad, right_rad2, left_rad2, both_rad2)

    def _advance(self, dt_s: float, set_points: SetPoints) -> CoastedMotion:
        lag_s, follows, turns, changes = self._lag_s, self._follows, [0.0, 0.0], [0.0, 0.0]
        keep = exp(-dt_s / lag_s)
        self._first_set = first_set = self._first_set or set_points[:2]
        for k in (0, 1):
            u, follow = set_points[k], follows[k]
            off = follow - u * lag_s
            follows[k] = u * lag_s + off * keep
            turns[k] = u * dt_s - (follows[k] - follow)
            changes[k] = keep * self._by_lag[k] + u * (1.0 - keep) + off * keep * dt_s / (lag_s * lag_s)
        self._by_lag = right, left = changes[0], changes[1]
        # Errors with one cause for the whole gap: where they become smaller again, the variance stays.
        size = right * right + left * left
        grown = self._spread2 * (size - self._largest) / size if size > self._largest else 0.0
        self._largest = max(size, self._largest)
        # Likewise the dead time of the set points that change in the gap.
        steps = set_points[0] - first_set[0], set_points[1] - first_set[1]
        size = steps[0] * steps[0] + steps[1] * steps[1]
        late = _DEAD_TIME_S**2 * (size - self._largest_step) / size if size > self._largest_step else 0.0
        self._largest_step = max(size, self._largest_step)
        self._kept *= keep
        shown = (1.0 - self._kept) ** 2
        # A wrong rate is wrong in the whole gap, so that its error grows with the travel and not with its root.
        coasted = self._coasted
        coasted[0] += abs(turns[0])
        coasted[1] += abs(turns[1])
        if turns[0] and turns[1]:
            self._is_turn = turns[0] * turns[1] < 0.0
        shares = self._shares[self._is_turn]
        pairs = (shares.one, 0, 0), (shares.one, 1, 1), (self._sign() * shares.both, 0, 1)
        before, stops = self._shown2, set_points[2:]
        self._shown2 = [
            shown * first2 + 4.0 * share * coasted[i] * coasted[j]
            for first2, (share, i, j) in zip(self._first2, pairs, strict=True)
        ]
        return CoastedMotion(
            *turns,
            *(
                grown * changes[i] * changes[j] + late * steps[i] * steps[j] + now - old + stops[i] * stops[j]
                for now, old, (_, i, j) in zip(self._shown2, before, pairs, strict=True)
            ),
        )

    def _advance_unknown(self, before_s: float) -> CoastedMotion:
        """Set points that are not known: anything from the rate before the gap to an immediate stop is as likely."""
        self._is_known = False
        begin_s, end_s = min(before_s, _STANDS_AFTER_S), min(self.gap_s, _STANDS_AFTER_S)
        right, left = self._free
        way_s, spread_s2 = 0.5 * (end_s - begin_s), (end_s * end_s - begin_s * begin_s) / 12.0
        self._follows = [0.0, 0.0]
        return CoastedMotion(
            *(way_s * right, way_s * left),
            *(spread_s2 * right * right, spread_s2 * left * left, spread_s2 * right * left),
        )

    def end(self) -> None:
        """Samples come again; until the next rest the follow errors are those of the prediction."""
        self.gap_s = 0.0
        if self.has_moved:
            self._is_known = False
