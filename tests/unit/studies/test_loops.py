"""The studies `loops` and `danger`: margins against closed forms, edge rules over seams and at the rim."""

import json
import sys
from math import atan, degrees, inf, pi, radians, sqrt
from pathlib import Path

import control
import numpy as np
import pytest

from ccatp.config.load import load_config
from ccatp.config.models import Config, PidConfig
from ccatp.control.line import LegView, line_rate
from ccatp.core import EdgeSample
from ccatp.links.topics import EstimateMessage
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.studies import loops
from ccatp.studies.campaign import CampaignError, JobOutcome
from ccatp.studies.danger_study import OFF_S, RULES, combine, drive_frame, drive_to_rim, off_time_rule, transit
from ccatp.studies.loops import Loop, margins, open_loop

LAG_S, FRAME_S = 0.08, 0.01
CFG = load_config()


def gains(kp: float, ki: float, kd: float) -> PidConfig:
    return PidConfig(kp=kp, ki=ki, kd=kd, derivative_filter_s=0.02, integral_limit=1.0)


FORWARD, ANGULAR = gains(0.5, 0.5, 0.0), gains(0.1, 0.05, 0.01)


def loop(pid: PidConfig, plant: str, lag_s: float = LAG_S, frames: int = 0) -> Loop:
    return open_loop("test", "forward", pid, plant, lag_s, frames, FRAME_S)


def test_the_true_plant_has_the_integrator() -> None:
    # |L| = 1: w^4 (1 + T^2 w^2) = 0.25 (w^2 + 1); phase -180 + atan(w) - atan(T w).
    found = margins(loop(FORWARD, "true"))
    w = found.gain_crossover_rad_s
    assert w**4 * (1.0 + (LAG_S * w) ** 2) == pytest.approx(0.25 * (w * w + 1.0), rel=1e-9)
    assert found.phase_rad == pytest.approx(atan(w) - atan(LAG_S * w), abs=1e-9)
    assert degrees(found.phase_rad) == pytest.approx(35.0, abs=0.1)
    assert degrees(margins(loop(ANGULAR, "true")).phase_rad) == pytest.approx(24.2, abs=0.1)


@pytest.mark.parametrize("plant", ["printed", "true"])
@pytest.mark.parametrize("pid", [FORWARD, ANGULAR, gains(3.0, 0.0, 0.0), gains(8.0, 0.0, 0.5)])
@pytest.mark.parametrize("frames", [0, 4])
def test_the_same_margins_as_python_control(pid: PidConfig, plant: str, frames: int) -> None:
    one = loop(pid, plant, frames=frames)
    found = margins(one)
    gain, phase_deg, _, at_phase, at_gain, _ = control.stability_margins(loops.system(one))
    assert degrees(found.phase_rad) == pytest.approx(phase_deg, abs=1e-3)  # what the Pade approximant leaves
    if found.gain_crossover_rad_s < inf:  # python-control has nan where there is none
        assert found.gain_crossover_rad_s == pytest.approx(at_gain, rel=1e-6)
    assert np.isnan(at_gain) == (found.gain_crossover_rad_s == inf)
    if frames and found.phase_crossover_rad_s < 50.0:  # beyond, the approximant is none
        assert found.gain_db == pytest.approx(20.0 * np.log10(gain), abs=1e-3)
        assert found.phase_crossover_rad_s == pytest.approx(at_phase, rel=1e-4)


def test_a_delay_costs_its_phase_and_no_more_than_the_delay_margin() -> None:
    free, late = margins(loop(FORWARD, "true")), margins(loop(FORWARD, "true", frames=4))
    assert free.phase_rad - late.phase_rad == pytest.approx(free.gain_crossover_rad_s * 4 * FRAME_S, rel=1e-9)
    frames = free.delay_s / FRAME_S
    assert margins(loop(FORWARD, "true", frames=int(frames))).is_stable
    assert not margins(loop(FORWARD, "true", frames=int(frames) + 1)).is_stable


def test_the_gain_margin_is_where_the_closed_loop_tips_over() -> None:
    late = loop(gains(8.0, 0.0, 0.5), "true", frames=4)
    factor = 10.0 ** (margins(late).gain_db / 20.0)
    inner, outer = loops.root_locus(late, np.array([0.99 * factor, 1.01 * factor]))
    assert inner.real.max() < 0.0 < outer.real.max()


def test_overshoot_of_a_second_order_loop() -> None:
    # K / (s (T s + 1)), damping zeta = 1 / (2 sqrt(K T)): overshoot exp(-pi zeta / sqrt(1 - zeta^2)).
    kp = 25.0
    zeta = 0.5 / sqrt(kp * LAG_S)
    found = loops.overshoot(loop(gains(kp, 0.0, 0.0), "true"))
    assert found == pytest.approx(np.exp(-pi * zeta / sqrt(1.0 - zeta * zeta)), abs=1e-3)  # the grid of the step


def test_every_set_of_gains_is_analysed() -> None:
    found = {(one.gains, one.axis, one.plant) for one in loops.loops_of(CFG)}
    for name, gain_set in CFG.control.gain_sets.items():
        assert (name, "forward", "true") in found
        assert ((name, "angular", "printed") in found) == (not gain_set.shaped)
        assert ((name, "steering", "true") in found) == gain_set.shaped
    assert {one.delay_frames for one in loops.loops_of(CFG)} == {0, 2, 4}
    assert next(one.lag_s for one in loops.limit_of(CFG)) == 0.5 * CFG.robot.wheel_lag_s


def test_steering_is_the_regulator_on_the_line() -> None:
    pid, v = loops.steering(CFG.limits, CFG.control), CFG.limits.v_max_m_s
    weights = CFG.control.cross_track_gain_rad_m2, CFG.control.heading_weight_1_s2
    assert -line_rate(LegView(1.0, 0.0, 1.0, 1.0), v, *weights) == pytest.approx(pid.kp)
    assert -line_rate(LegView(1.0, 1.0, 0.0, 1.0), v, *weights) * v == pytest.approx(pid.ki)


def test_the_files(tmp_path: Path) -> None:
    sets = {"thesis": CFG.control.gain_sets["thesis"]}
    part = CFG.model_copy(update={"control": CFG.control.model_copy(update={"gain_sets": sets})})
    result = loops.run(part, tmp_path)
    assert json.loads((tmp_path / "result.json").read_text()) == result
    assert result["study"] == "loops"
    assert len(result["cells"]) == len((tmp_path / "table.md").read_text().splitlines()) - 2 == 22
    assert result["cells"][0]["gain_margin_db"] is None
    names = {f"{kind}_thesis_{axis}.png" for kind in ("bode", "rlocus") for axis in ("forward", "angular")}
    assert {path.name for path in tmp_path.glob("*.png")} == names
    with np.load(tmp_path / "result.npz") as arrays:
        assert arrays["magnitude"].shape == (12, arrays["omega_rad_s"].size) == arrays["phase_rad"].shape


def test_without_python_control(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "control", None)
    with pytest.raises(CampaignError, match=r"install ccatp\[tune\]"):
        loops.system(loop(FORWARD, "true"))


# -- edge rules over seams and at the rim ------------------------------------------------------------------------------

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
