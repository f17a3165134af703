"""The loops study: margins against closed forms and python-control, files, refusals."""

import json
import sys
from math import atan, degrees, inf, pi, sqrt
from pathlib import Path

import control
import numpy as np
import pytest

from ccatp.config.load import load_config
from ccatp.config.models import PidConfig
from ccatp.control.tracker import LegView, line_rate
from ccatp.studies import loops
from ccatp.studies.campaign import CampaignError
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
