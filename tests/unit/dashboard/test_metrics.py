"""What Prometheus reads."""

from typing import Any

import pytest

from ccatp.config.load import load_config
from ccatp.mirror.mirror import build_mirror
from ccatp.report.dashboard.metrics import metrics_text
from ccatp.report.dashboard.survey_view import SurveyView
from ccatp.survey.state import MissionState
from tests.unit.dashboard.prometheus import parse

GROUND = {"title": "fyst-m1", "states": [str(state) for state in MissionState]}
NOTHING: dict[str, Any] = {
    "is_sim": False, "trouble": "main was never heard of", "links": [], "restarts": {"main": 0, "danger": 2},
    "mission": None, "verdict": None, "robot": None, "pose": None,
}  # fmt: skip
ALL: dict[str, Any] = NOTHING | {
    "trouble": "",
    "links": [
        {"name": "main loop", "phase": "joined", "age_s": 0.05, "is_well": True},
        {"name": "robot", "phase": "no frame yet", "age_s": None, "is_well": False},
    ],
    "mission": {
        "state": "driving", "total": 693, "done": 12, "skipped": 1, "elapsed_s": 61.5, "eta_s": 3000.0,
        "missed_deadlines": 2, "worst_lateness_ms": 21.0,
    },
    "verdict": {"code": 1, "severity": 2},
    "robot": {
        "charge": 0.93, "fans": [0.8, 0.75], "is_held": True, "drive_age_s": 0.01, "permit_age_s": 0.02,
        "faults": ["stall"],
    },
    "pose": {"covariance_m2": (9e-6, 0.0, 16e-6)},
}  # fmt: skip


def test_all_of_it() -> None:
    metrics = parse(metrics_text(ALL, GROUND, 3))
    values = {name: metric.samples for name, metric in metrics.items()}
    assert values["ccatp_up"] == {"": 1.0}
    assert values["ccatp_points"] == {'state="planned"': 693.0, 'state="measured"': 12.0, 'state="skipped"': 1.0}
    assert values["ccatp_mission_state"]['state="driving"'] == 1.0
    assert sum(values["ccatp_mission_state"].values()) == 1.0
    assert values["ccatp_link_up"] == {'link="main loop"': 1.0, 'link="robot"': 0.0}
    assert values["ccatp_link_age_seconds"] == {'link="main loop"': 0.05}
    assert values["ccatp_process_restarts_total"] == {'process="main"': 0.0, 'process="danger"': 2.0}
    assert values["ccatp_fan_duty_ratio"] == {'side="left"': 0.8, 'side="right"': 0.75}
    assert values["ccatp_position_sigma_meters"][""] == pytest.approx(0.005)
    assert values["ccatp_frame_lag_seconds"] == {"": 0.021}
    assert values["ccatp_wheels_held"] == {"": 1.0}
    assert values["ccatp_dashboard_pages"] == {"": 3.0}
    assert metrics["ccatp_late_frames_total"].kind == "counter"


def test_what_is_not_known_is_left_out() -> None:
    metrics = parse(metrics_text(NOTHING, GROUND, 0))
    assert set(metrics) == {"ccatp_info", "ccatp_up", "ccatp_process_restarts_total", "ccatp_dashboard_pages"}
    assert metrics["ccatp_up"].samples == {"": 0.0}


def test_a_name_with_everything_that_has_to_be_escaped() -> None:
    labels = next(iter(parse(metrics_text(NOTHING, GROUND | {"title": 'a"b\\c\nd'}, 0))["ccatp_info"].samples))
    assert labels.startswith(r'mirror="a\"b\\c\nd",')


def test_the_state_of_a_real_view() -> None:
    cfg = load_config(None, {"run.panels": 1})
    view = SurveyView(build_mirror(cfg.mirror), cfg, is_sim=True)
    assert parse(metrics_text(view.status_data(1.0), GROUND, 0))["ccatp_up"].samples == {"": 0.0}


@pytest.mark.parametrize(
    "text",
    [
        "x 1", "x 1\n", "# TYPE x gauge\nx 1\n", "# HELP x y\n# TYPE x gauge\nx one\n",
        "# HELP x y\n# TYPE x gauge\ny 1\n", '# HELP x y\n# TYPE x gauge\nx{a="b} 1\n',
        "# HELP x y\n# TYPE x gauge\nx 1\nx 1\n", "# HELP x y\n# TYPE x counter\nx 1\n",
        "# HELP x y\n# TYPE x thing\nx 1\n", "# HELP x y\n# TYPE x gauge\n",
    ],
)  # fmt: skip
def test_the_reader_is_strict(text: str) -> None:
    with pytest.raises(ValueError, match=r"help|type|sample|twice|counter|line|float"):
        parse(text)
