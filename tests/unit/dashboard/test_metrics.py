"""What Prometheus reads."""

from typing import Any

import pytest
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.parser import text_string_to_metric_families

from ccatp.links.topics import DisplayState
from ccatp.report.dashboard.app import StateCollector
from ccatp.report.dashboard.view import NO_LINE, LinkState
from ccatp.survey.state import MissionState

GROUND: dict[str, Any] = {"title": "fyst-m1", "states": [str(state) for state in MissionState]}
NOTHING: dict[str, Any] = {
    "is_sim": False, "trouble": "main has sent no heartbeat", "links": [], "restarts": {"main": 0, "danger": 2},
    "mission": None, "verdict": None, "robot": None, "pose": None, "conditions": [],
}  # fmt: skip
ALL: dict[str, Any] = NOTHING | {
    "trouble": "",
    "conditions": [{"name": "no_way_on", "cause": "no way on: walled in", "advice": "carry it"}],
    "links": [LinkState("main loop", "joined", 0.05, True), LinkState("robot", "no frame yet", None, False)],
    "mission": {
        "state": "driving", "total": 693, "done": 12, "skipped": 1, "elapsed_s": 61.5, "eta_s": 3000.0,
        "missed_deadlines": 2, "worst_lateness_ms": 21.0,
    },
    "verdict": {"code": 1, "severity": 2},
    "robot": {
        "charge": 0.93, "fans": [0.8, 0.75], "is_held": True, "drive_age_s": 0.01, "permit_age_s": 0.02,
        "faults": ["stall"],
    },
    "pose": DisplayState(
        seq=0, t_s=0.0, x_m=1.0, y_m=-2.0, heading_rad=0.5, covariance_m2=(9e-6, 0.0, 16e-6), heading_sigma_rad=0.01,
        nis=2.0, size=2, line=NO_LINE,
    ),
}  # fmt: skip


def parse(text: str) -> dict[str, dict[tuple[str, ...], float]]:
    """Samples by the names of the metrics and the values of their labels."""
    found: dict[str, dict[tuple[str, ...], float]] = {}
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            found.setdefault(sample.name, {})[tuple(sample.labels.values())] = sample.value
    return found


def metrics_of(state: dict[str, Any], pages: int = 0, **ground: Any) -> dict[str, dict[tuple[str, ...], float]]:
    registry = CollectorRegistry()
    registry.register(StateCollector(lambda: state, lambda: pages, GROUND | ground))
    return parse(generate_latest(registry).decode())


def test_all_metrics() -> None:
    found = metrics_of(ALL, 3)
    assert sum(found.pop("ccatp_mission_state").values()) == 1.0
    (mirror, simulation, _) = next(iter(found.pop("ccatp_info")))
    assert (mirror, simulation) == ("fyst-m1", "false")
    assert found.pop("ccatp_position_sigma_meters")[()] == pytest.approx(0.005)
    assert found == {
        "ccatp_up": {(): 1.0},
        "ccatp_points": {("planned",): 693.0, ("measured",): 12.0, ("skipped",): 1.0},
        "ccatp_link_up": {("main loop",): 1.0, ("robot",): 0.0},
        "ccatp_link_age_seconds": {("main loop",): 0.05},
        "ccatp_process_restarts_total": {("main",): 0.0, ("danger",): 2.0},
        "ccatp_elapsed_seconds": {(): 61.5},
        "ccatp_remaining_seconds": {(): 3000.0},
        "ccatp_late_frames_total": {(): 2.0},
        "ccatp_frame_lag_seconds": {(): 0.021},
        "ccatp_event_code": {(): 1.0},
        "ccatp_severity": {(): 2.0},
        "ccatp_condition": {("no_way_on",): 1.0},
        "ccatp_battery_charge_ratio": {(): 0.93},
        "ccatp_fan_duty_ratio": {("left",): 0.8, ("right",): 0.75},
        "ccatp_wheels_held": {(): 1.0},
        "ccatp_drive_age_seconds": {(): 0.01},
        "ccatp_permit_age_seconds": {(): 0.02},
        "ccatp_robot_faults": {(): 1.0},
        "ccatp_dashboard_pages": {(): 3.0},
    }


def test_unknown_values_are_left_out() -> None:
    metrics = metrics_of(NOTHING)
    assert set(metrics) == {"ccatp_info", "ccatp_up", "ccatp_process_restarts_total", "ccatp_dashboard_pages"}
    assert metrics["ccatp_up"] == {(): 0.0}


def test_a_name_is_escaped() -> None:
    title = 'a"b\\c\nd'
    assert next(iter(metrics_of(NOTHING, title=title)["ccatp_info"]))[0] == title
