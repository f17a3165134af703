"""Edge rules over seams and at the rim: what the study `danger` counts."""

from math import radians

import numpy as np
import pytest

from ccatp.config.load import load_config
from ccatp.config.models import Config
from ccatp.core import EdgeSample
from ccatp.links.topics import EstimateMessage
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.studies.campaign import JobOutcome
from ccatp.studies.danger_study import (
    OFF_S,
    RULES,
    combine,
    drive_frame,
    drive_to_rim,
    off_time_rule,
    transit,
)

NOWHERE = EstimateMessage(seq=0, t_s=0.0, x_m=0.0, y_m=0.0, heading_rad=0.0, sigma_m=1e-3, state="driving")


def loaded(mirror: str, world: str = "thesis") -> tuple[Config, Mirror]:
    cfg = load_config(overrides={"run.mirror": mirror, "run.world": world})
    return cfg, build_mirror(cfg.mirror)


def judged(pattern: str) -> bool:
    """The thesis's rule on the front-left sensor's values, one per millisecond."""
    rule = off_time_rule(OFF_S)
    samples = [EdgeSample(1e-3 * k, int(value), 1, 1, 1) for k, value in enumerate(pattern)]
    return any(rule(drive_frame(k, s.t_s, [], [s]), NOWHERE) for k, s in enumerate(samples))


def test_the_thesis_counts_the_time_that_one_sensor_is_off() -> None:
    back_on = "1" + "0" * 90 + "1" + "0" * 90  # the time begins again
    assert [judged(pattern) for pattern in ("1" + "0" * 100, "1" + "0" * 102, back_on)] == [False, True, False]


@pytest.mark.parametrize(
    ("mirror_name", "v_m_s", "angle_deg", "expected"),
    [
        ("fyst-m1", 0.10, 0.0, (False, False)),  # 1.2 mm take 12 ms
        ("thesis-m1", 0.05, 0.0, (True, False)),  # 10 mm take 0.2 s
        ("thesis-m1", 0.20, 0.0, (False, False)),  # 50 ms
        ("thesis-m1", 0.10, 60.0, (True, False)),  # 20 mm on the way
    ],
)
def test_a_seam_is_an_edge_for_a_rule_that_counts_time(
    mirror_name: str, v_m_s: float, angle_deg: float, expected: tuple[bool, bool]
) -> None:
    cfg, mirror = loaded(mirror_name, "hard")
    found = transit(mirror, cfg, v_m_s, radians(angle_deg), np.random.default_rng(1))
    assert found == expected


def test_a_turn_in_place_sweeps_over_the_gap() -> None:
    cfg, mirror = loaded("thesis-m1", "hard")
    found = [transit(mirror, cfg, 0.05, None, np.random.default_rng(seed)) for seed in range(6)]
    thesis, ours = np.sum(found, axis=0)
    assert thesis > 0
    assert ours == 0


def test_a_drive_ends_after_threshold_and_run_down() -> None:
    (cfg, mirror), v_m_s = loaded("fyst-m1"), 0.10
    sensor_m, has_fallen = drive_to_rim(mirror, cfg, v_m_s, 0.0, "thesis", np.random.default_rng(2))
    expected_m = v_m_s * (OFF_S + cfg.sim.robot.wheel_lag_s)
    # The verdict waits for the end of its frame, at most 10 ms, and one sample; 5 % for the slope of the surface.
    assert 0.95 * expected_m < sensor_m < expected_m + v_m_s * 0.012
    assert not has_fallen


def test_the_delay_of_the_link_lets_it_go_further() -> None:
    cfg, mirror = loaded("fyst-m1")
    late, blind = (
        cfg.model_copy(update={"world": cfg.world.model_copy(update={"commands_delay_s": delay_s})})
        for delay_s in (0.1, 1.0)
    )
    near, far = (drive_to_rim(mirror, one, 0.1, 0.0, "shipped", np.random.default_rng(3))[0] for one in (cfg, late))
    assert drive_to_rim(mirror, blind, 0.2, 0.0, "thesis", np.random.default_rng(3))[1]  # it fell
    assert far - near == pytest.approx(0.01, abs=2e-4)  # 0.1 s at 0.1 m/s, on a surface that slopes by up to 10 %


def outcome(false_edges: int, overrun_m: list[float]) -> JobOutcome:
    figures = {"false_edges": false_edges, "falls": 1}
    arrays = {f"{name}_overrun_m": np.array(overrun_m) for name in RULES}
    return JobOutcome({"transits": 10, **dict.fromkeys(RULES, figures)}, arrays)


def test_a_cell_pools_its_jobs() -> None:
    values, arrays = combine({}, [outcome(2, [0.01, 0.02]), outcome(4, [0.03, 0.04])])
    assert values["transits"] == 20
    found = values["thesis"]
    assert found["false_edge_probability"] == pytest.approx(0.3)
    assert (found["false_edge_low"], found["false_edge_high"]) == pytest.approx((0.1455, 0.5190), abs=1e-4)  # Wilson
    assert values["shipped"]["overrun_mean_mm"] == pytest.approx(25.0)
    assert values["shipped"]["overrun_max_mm"] == pytest.approx(40.0)
    assert values["shipped"]["falls"] == 2
    assert arrays["thesis_overrun_m"].tolist() == [0.01, 0.02, 0.03, 0.04]


def test_turns_have_no_overrun() -> None:
    values, arrays = combine({}, [JobOutcome(outcome(1, []).values)])
    assert "overrun_mean_mm" not in values["thesis"]
    assert not arrays
