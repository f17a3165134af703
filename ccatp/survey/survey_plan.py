"""The plan of a survey before it begins, as text and data."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import accumulate, groupby
from typing import Any

from ccatp.config.models import Config
from ccatp.control.grip_model import GripForecast, GripModel
from ccatp.core import PointId, Stop, StopKind
from ccatp.mirror.mirror import Mirror
from ccatp.survey.composition import slowed
from ccatp.survey.forecast import TimeForecast, clock, forecast_time
from ccatp.survey.planning.route import ORDERS, plan_survey
from ccatp.survey.planning.search import leg_lengths, leg_time, stop_times
from ccatp.survey.planning.tour_bound import tour_bound

_SHOWN = 10


@dataclass(frozen=True, slots=True)
class SurveyPlan:
    """The plan of a survey: points in the order of measuring, with those out of reach, and stops.

    ``times_s``: arrival at each stop, from the start. Driving, turning and measuring are least times, rest to rest;
    their sum is the lower bound of the survey's time.
    """

    points: tuple[PointId, ...]
    out_of_reach: tuple[PointId, ...]
    stops: tuple[Stop, ...]
    times_s: tuple[float, ...]
    length_m: float
    driving_s: float
    turning_s: float
    measuring_s: float
    any_order_s: float
    forecast: TimeForecast
    grip: GripForecast

    @property
    def least_s(self) -> float:
        """Lower bound of the survey's time along this route."""
        return self.driving_s + self.turning_s + self.measuring_s


def make_plan(cfg: Config, mirror: Mirror) -> SurveyPlan:
    """Plan a survey as a run would; raises ``PlanError`` if base is not on the mirror or is a dead end."""
    grip = GripModel(cfg.robot).forecast(mirror)
    cfg = slowed(cfg, grip)
    points = ORDERS[cfg.run.order](mirror, cfg.run.panels)
    out_of_reach: list[PointId] = []
    route = plan_survey(cfg, mirror, points, (), out_of_reach)
    stops = route.stops
    lengths_m, times_s = (
        leg_lengths(stops, mirror.base_pose, mirror),
        stop_times(stops, mirror.base_pose, cfg.limits, mirror),
    )
    driving_s = sum(leg_time(length, cfg.limits) for length in lengths_m)
    rests_s = [cfg.etalon.measuring_time_s * stop.is_measured for stop in stops]
    begins_s = accumulate((time_s + rest_s for time_s, rest_s in zip(times_s, rests_s, strict=True)), initial=0.0)
    reached = [point for point in points if point not in set(out_of_reach)]
    return SurveyPlan(
        points=tuple(points),
        out_of_reach=tuple(out_of_reach),
        stops=stops,
        times_s=tuple(begin_s + time_s for begin_s, time_s in zip(begins_s, times_s, strict=False)),
        length_m=sum(lengths_m),
        driving_s=driving_s,
        turning_s=sum(times_s) - driving_s,
        measuring_s=sum(rests_s),
        any_order_s=tour_bound(mirror, reached, cfg.limits, cfg.etalon.measuring_time_s),
        forecast=forecast_time(cfg, mirror, route),
        grip=grip,
    )


def plan_data(cfg: Config, plan: SurveyPlan) -> dict[str, Any]:
    """The plan as data: lengths in m, times in s, points as [row, column, number]."""
    kinds, forecast = [stop.kind for stop in plan.stops], plan.forecast
    return {
        "mirror": cfg.mirror.name,
        "order": cfg.run.order,
        "filter": cfg.run.filter,
        "points": {"total": len(plan.points), "reached": len(plan.points) - len(plan.out_of_reach)},
        "out_of_reach": [list(point) for point in plan.out_of_reach],
        "length_m": round(plan.length_m, 3),
        "lower_bound_s": round(plan.least_s, 3),
        "driving_s": round(plan.driving_s, 3),
        "turning_s": round(plan.turning_s, 3),
        "measuring_s": round(plan.measuring_s, 3),
        "any_order_bound_s": round(plan.any_order_s, 3),
        "expected_s": round(forecast.expected_s, 1),
        "expected_slip": round(forecast.slip, 4),
        "budget_s": cfg.run.budget_s,
        "fits_budget": forecast.is_within,
        "other_orders_s": {name: round(time_s, 1) for name, time_s in forecast.other_s.items()},
        "order_within_budget": cfg.run.order if forecast.is_within else forecast.better,
        "thrust": {
            "least_n": round(plan.grip.least_n, 2),
            "needed_n": round(plan.grip.wanted_n, 2),
            "available_n": plan.grip.thrust_n,
            "safe_speed_m_s": round(plan.grip.safe_speed_m_s, 3),
            "is_held": plan.grip.is_held,
            "is_slow": plan.grip.is_short,
        },
        "via_stops": kinds.count(StopKind.VIA),
        "stops": [
            {
                "t_s": round(time_s, 3),
                "x_m": round(stop.x_m, 4),
                "y_m": round(stop.y_m, 4),
                "kind": stop.kind.value,
                "point": None if stop.point is None else list(stop.point),
                "reverse": stop.reverse,
            }
            for stop, time_s in zip(plan.stops, plan.times_s, strict=True)
        ],
    }


def plan_lines(cfg: Config, plan: SurveyPlan) -> Iterator[str]:
    """The plan as lines for a terminal."""
    forecast = plan.forecast
    vias = sum(stop.kind is StopKind.VIA for stop in plan.stops)
    panels = [panel for panel, _ in groupby(point.panel for point in plan.points)]
    limits = slowed(cfg, plan.grip).limits
    count = len(set(panels))
    of = f"{count} panel{'' if count == 1 else 's'}"
    yield f"{cfg.mirror.name}: {len(plan.points)} points of {of}, order {cfg.run.order}"
    first = " ".join(f"{panel.row}/{panel.col}" for panel in panels[:9])
    yield f"first panels    {first}{' ...' if len(panels) > 9 else ''}"
    yield f"way             {plan.length_m:.1f} m, {len(plan.stops)} stops, {vias} of them only on the way"
    yield (
        f"least time      {clock(plan.least_s)}: {plan.driving_s:.0f} s driving, {plan.turning_s:.0f} s turning, "
        f"{plan.measuring_s:.0f} s measuring"
    )
    yield f"                at {limits.v_max_m_s:g} m/s and {limits.omega_max_rad_s:g} rad/s"
    yield f"expected        {clock(forecast.expected_s)}, with {forecast.slip:.1%} slip"
    yield f"any order       {clock(plan.any_order_s)} at least, through the points that can be reached"
    kept = "kept" if forecast.is_within else f"NOT kept; {forecast.advice}"
    yield f"budget          {clock(forecast.budget_s)}: {kept}"
    yield f"thrust          {plan.grip.text}"
    lost = " ".join("/".join(map(str, point)) for point in plan.out_of_reach[:_SHOWN])
    more = " ..." if len(plan.out_of_reach) > _SHOWN else ""
    yield f"out of reach    {f'{len(plan.out_of_reach)} points: {lost}{more}' if lost else 'none'}"
