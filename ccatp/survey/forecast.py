"""How long a survey is expected to take, and which order of the points keeps the time budget."""

from typing import NamedTuple

from ccatp.config.models import Config
from ccatp.mirror.mirror import Mirror
from ccatp.survey.planning.route import ORDERS, Route, plan_survey
from ccatp.survey.planning.search import path_time

# What a stop adds to the least time, s: settling, and delays and slip on the turn and the leg before it. From twenty
# surveys of thesis-m1 in each world (docs/measurements/results.md): 0.05 s a stop in `thesis`, 0.29 in `hard`, 0.41 in
# `extreme`. Four panels in either order give 0.06, 0.25 and 0.39 s.
_SETTLING_S = 0.05
_DELAYS_PER_STOP = 6.0
_S_PER_SLIP = 4.0
_NO_POINTS = "calibration"


class TimeForecast(NamedTuple):
    """The expected time of a survey, s, with this slip, a share of the wheels' travel.

    ``other_s``: that of every other order, fastest first; empty if the order of the survey keeps the budget.
    """

    order: str
    slip: float
    expected_s: float
    budget_s: float
    other_s: dict[str, float]

    @property
    def is_within(self) -> bool:
        """The chosen order keeps the budget."""
        return self.expected_s <= self.budget_s

    @property
    def better(self) -> str | None:
        """The fastest other order, if it keeps the budget where the chosen one does not."""
        order, time_s = next(iter(self.other_s.items()), ("", self.budget_s))
        return order if order and time_s <= self.budget_s else None

    @property
    def expectation(self) -> str:
        """Order, time and slip."""
        return f"order {self.order} takes about {clock(self.expected_s)} with {self.slip:.1%} slip"

    @property
    def problem(self) -> str:
        """What is wrong, empty if the budget is kept."""
        if self.is_within:
            return ""
        return f"{self.expectation}, more than run.budget_s ({clock(self.budget_s)})"

    @property
    def advice(self) -> str:
        """What keeps the budget, empty if nothing is wrong."""
        if self.is_within:
            return ""
        if self.better is not None:
            return f'run.order = "{self.better}" takes about {clock(self.other_s[self.better])}'
        return "no order keeps it: measure fewer panels (run.panels), or raise run.budget_s"

    @property
    def warning(self) -> str:
        """Problem and advice, empty if the budget is kept."""
        return "" if self.is_within else f"{self.problem}; {self.advice}"


def clock(time_s: float) -> str:
    """A time in minutes and seconds."""
    return f"{int(time_s) // 60} min {int(time_s) % 60:02d} s"


def forecast_time(cfg: Config, mirror: Mirror, route: Route) -> TimeForecast:
    """The expected time of a survey along its route from base; other orders are planned only if it is too long."""
    slip = _slip(cfg)
    expected_s = _expected_s(cfg, mirror, route, slip)
    other_s: dict[str, float] = {}
    if expected_s > cfg.run.budget_s:
        for name, order in ORDERS.items():
            if name not in (cfg.run.order, _NO_POINTS):
                other = plan_survey(cfg, mirror, order(mirror, cfg.run.panels), (), [])
                other_s[name] = _expected_s(cfg, mirror, other, slip)
    by_time = dict(sorted(other_s.items(), key=lambda item: item[1]))
    return TimeForecast(cfg.run.order, slip, expected_s, cfg.run.budget_s, by_time)


def _slip(cfg: Config) -> float:
    """The mean slip of the simulated world, or that which the localizer expects of the robot, if it is larger."""
    return max(0.5 * (cfg.world.slip_min + cfg.world.slip_max), cfg.localizer.full_state.slip_mean)


def _expected_s(cfg: Config, mirror: Mirror, route: Route, slip: float) -> float:
    delay_s = cfg.world.sensors_delay_s + cfg.world.commands_delay_s
    stop_s = _SETTLING_S + _DELAYS_PER_STOP * delay_s + _S_PER_SLIP * slip
    least_s = path_time(route.stops, mirror.base_pose, cfg.limits, mirror, cfg.etalon.measuring_time_s)
    return least_s + stop_s * len(route.stops)
