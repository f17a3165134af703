"""The expected time of a survey: as simulated surveys take, and the order that keeps the budget."""

from functools import cache
from typing import Any

import pytest

from ccatp.config.load import load_config
from ccatp.mirror.mirror import build_mirror
from ccatp.studies.sil_run import rehearse
from ccatp.survey.forecast import TimeForecast, forecast_time
from ccatp.survey.planning.route import ORDERS, plan_survey
from tests.support.cases import slow_case


@cache
def forecast(**settings: Any) -> TimeForecast:
    cfg = load_config(None, {f"run.{key}" if "." not in key else key: value for key, value in settings.items()})
    mirror = build_mirror(cfg.mirror)
    return forecast_time(cfg, mirror, plan_survey(cfg, mirror, ORDERS[cfg.run.order](mirror, cfg.run.panels)))


# Means of twenty whole surveys, and the range of those of the optimised order: docs/measurements/results.md.
@pytest.mark.parametrize(
    ("world", "order", "least_s", "most_s"),
    [("hard", "thesis", 3730, 3730), slow_case("extreme", "thesis", 3836, 3836), ("hard", "optimised", 2900, 3100)],
)
def test_it_is_near_what_whole_surveys_took(world: str, order: str, least_s: float, most_s: float) -> None:
    found = forecast(mirror="thesis-m1", world=world, order=order)
    assert 0.99 * least_s <= found.expected_s <= 1.01 * most_s  # ten percent of what slip and delays add


def test_it_is_near_what_a_panel_takes() -> None:
    settings: dict[str, object] = {"run.mirror": "fyst-m2", "run.panels": 1, "run.world": "hard"}
    taken_s = rehearse(load_config(None, settings)).mission_time_s
    assert forecast(mirror="fyst-m2", panels=1, world="hard").expected_s == pytest.approx(taken_s, rel=0.03)


def test_the_order_that_keeps_the_hour_is_named() -> None:
    found = forecast(mirror="thesis-m1", world="hard")
    assert (found.is_within, found.better) == (False, "optimised")
    assert found.problem.startswith("order thesis takes about 62 min")
    assert found.problem.endswith("more than run.budget_s (60 min 00 s)")
    assert found.advice.startswith('run.order = "optimised" takes about 50 min')
    named = forecast(mirror="thesis-m1", world="hard", order="optimised")
    assert (named.is_within, named.other_s, named.warning) == (True, {}, "")
    assert named.expected_s == found.other_s["optimised"]


def test_the_slip_that_the_localizer_expects_counts_where_the_world_has_less() -> None:
    calm = forecast(mirror="thesis-m1")
    slipping = forecast(mirror="thesis-m1", order="optimised", **{"localizer.full_state.slip_mean": 0.05})
    assert (calm.is_within, calm.slip) == (True, 0.015)
    assert (slipping.slip, slipping.expected_s > forecast(mirror="thesis-m1", order="optimised").expected_s) == (
        0.05,
        True,
    )


def test_where_no_order_keeps_it_this_is_said() -> None:
    found = forecast(mirror="thesis-m1", budget_s=600.0, panels=40)
    assert found.better is None
    assert found.advice == "no order keeps it: measure fewer panels (run.panels), or raise run.budget_s"


def test_a_time_within_the_budget_has_no_advice() -> None:
    found = forecast(mirror="fyst-m2", panels=2)
    assert (found.problem, found.advice, found.better, found.warning) == ("", "", None, "")
