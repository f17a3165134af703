"""Links in virtual time, what grows during a run, and the estimate against the simulated truth."""

import os
import platform
from typing import Any

import pytest
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.parser import text_string_to_metric_families

import ccatp
from ccatp.links.topics import DisplayState, Heartbeat
from ccatp.report.dashboard.app import StateCollector
from ccatp.report.dashboard.history import Growing, Lines, Trail, TruthCompare, is_gap
from ccatp.report.dashboard.view import NO_LINE, Links, LinkState
from ccatp.survey.events import Mode


def presence(process: str, t_s: float, *, pid: int = 1, phase: str = "joined", age_s: float | None = 0.01) -> Heartbeat:
    return Heartbeat(seq=0, t_s=t_s, process=process, pid=pid, phase=phase, frame_age_s=age_s)


@pytest.fixture
def links() -> Links:
    links = Links()
    links.presence(presence("main", 10.0))
    links.presence(presence("danger", 10.0))
    return links


def whats(links: Links, now_s: float) -> list[str]:
    return [loss.what for loss in links.losses(now_s)]


def test_before_anybody_spoke_nothing_is_lost_but_it_is_not_well() -> None:
    links = Links()
    assert links.losses(10.0) == []
    assert links.trouble(10.0) == "main has sent no heartbeat"
    phases = [link.phase for link in links.shown(10.0)]
    assert phases == ["no heartbeat yet", "no heartbeat yet", "no frame yet", "no fix yet"]


def test_all_is_well(links: Links) -> None:
    assert (links.losses(10.1), links.trouble(10.1)) == ([], "")
    links.fix_s = 9.0
    shown = {link.name: link for link in links.shown(10.1)}
    assert all(link.is_well for link in shown.values())
    assert (shown["robot"].age_s, shown["laser"].age_s) == pytest.approx((0.11, 1.1))


MAIN, DANGER = "the main loop has not reported", "the danger loop has not reported"


@pytest.mark.parametrize(
    ("reported", "picture_s", "now_s", "lost"),
    [
        pytest.param([presence("danger", 10.9)], None, 10.95, [], id="not yet"),
        pytest.param([presence("danger", 10.9)], None, 11.05, [MAIN], id="a loop that says nothing"),
        pytest.param([presence("danger", 10.9)], None, 12.0, [MAIN, DANGER], id="both"),
        pytest.param([], 10.0, 10.75, [], id="pictures that were wanted"),
        pytest.param([], 10.0, 10.85, [MAIN], id="and do not come show it sooner"),
        pytest.param([], None, 10.85, [], id="pictures that nobody wants"),
        pytest.param(
            [presence("main", 10.5, phase="rejoining", age_s=0.5), presence("danger", 10.5)], None, 10.6,
            ["the robot has been away"], id="the robot is away",
        ),
        pytest.param([presence("main", 11.0, age_s=0.95), presence("danger", 11.0)], None, 11.04, [], id="is slow"),
        pytest.param(
            [presence("main", 11.0, age_s=0.95), presence("danger", 11.0)], None, 11.1,
            ["the robot has sent no frame"], id="sends nothing",
        ),
    ],
)  # fmt: skip
def test_losses(
    links: Links, reported: list[Heartbeat], picture_s: float | None, now_s: float, lost: list[str]
) -> None:
    for one in reported:
        links.presence(one)
    links.picture_s = picture_s
    assert whats(links, now_s) == lost
    # Without the main loop nothing is known of the robot.
    unwell = [name for name in ("main loop", "danger loop") if f"the {name} " in str(lost)] + ["robot"] * bool(lost)
    assert [link.name for link in links.shown(now_s) if not link.is_well] == unwell
    if lost:
        assert links.trouble(now_s).startswith(f"{lost[0]} for ")
    links.is_over = True
    assert (links.losses(now_s), links.trouble(now_s)) == ([], "")


def test_a_loop_that_is_gone_shows_at_once_and_until_another_one_speaks(links: Links) -> None:
    links.cut("main", 10.2)
    assert str(links.losses(10.3)[0]) == "the main loop is gone for 0.1 s"
    links.cut("main", 10.3)
    links.presence(presence("main", 10.15))  # one of its last words, which was on its way
    assert links.losses(10.7)[0].for_s == pytest.approx(0.5)
    links.picture_s = 10.1
    links.presence(presence("main", 11.0, pid=2, phase="starting", age_s=None))
    assert links.losses(11.0) == []
    links.cut("danger", 11.0)
    links.presence(presence("danger", 11.2))  # a connection that came back is no loss
    assert links.losses(11.3) == []
    assert links.restarts == {"main": 1, "danger": 0}


def test_what_is_new_is_reported_once_and_the_older_half_gets_thin() -> None:
    grown = Growing(100)
    for k in range(2):
        grown.add(k, 1.0)
        assert (grown.take_new(), grown.take_new()) == ([(k, 1.0)], [])
    for k in range(2, 1000):
        grown.add(k, 2.0 if k == 300 else 1.0)
        assert len(grown.rows) <= 100
    kept = [row[0] for row in grown.rows]
    assert kept[-40:] == list(range(960, 1000))
    assert kept[0] == 0  # and it still begins where it began
    assert kept == sorted(kept)
    assert 300 in kept  # the largest of its time
    assert grown.take_new() == [(k, 1.0) for k in range(900, 1000)]  # nobody took for long


def test_no_line_is_drawn_over_a_time_without_rows_however_often_rows_are_thinned() -> None:
    grown = Growing(100, 3.0)
    for t_s in (0.0, 2.0, 6.0, 7.0, 5.0):  # a clock that goes back stands still
        grown.add(t_s, 1.0, 2.0)
    assert grown.rows == [
        (0.0, 1.0, 2.0),
        (2.0, 1.0, 2.0),
        (6.0, None, None),
        *[(t, 1.0, 2.0) for t in (6.0, 7.0, 7.0)],
    ]
    grown.add(None, 1.0, 2.0)  # of an unknown time
    for k in range(20_000):
        grown.add(8.0 + k, 1.0, 2.0)
    assert [row for row in grown.rows if is_gap(row)] == [(6.0, None, None)]
    for k in range(1000):  # nothing but gaps
        grown.add(1e5 + 4.0 * k, 1.0, 2.0)
        assert len(grown.rows) <= 101


def test_a_robot_that_stands_leaves_no_gap_in_its_path_and_one_that_is_not_seen_does() -> None:
    trail = Trail(100, 3.0)
    for k in range(20):
        trail.add(float(k), 1.0, 2.0)
    trail.add(20.0, 1.03, 2.0)
    trail.add(30.0, 1.50, 2.0)
    assert trail.rows == [(0.0, 1.0, 2.0), (20.0, 1.03, 2.0), (30.0, None, None), (30.0, 1.5, 2.0)]


def test_what_was_before_is_put_before_what_is_known() -> None:
    past, known = Growing(100, 3.0), Growing(100, 3.0)
    for t_s in (1.0, 2.0, 10.0):
        past.add(t_s, 1.0)
    known.prepend([])
    for t_s in (9.0, 10.0):
        known.add(t_s, 5.0)
    known.prepend(past.rows)
    assert known.rows == [(1.0, 1.0), (2.0, 1.0), (9.0, None), (9.0, 5.0), (10.0, 5.0)]


def test_a_line_that_comes_again_is_one_row_with_its_newest_text_and_old_ones_go() -> None:
    lines = Lines(3)
    lines.add("0.5", "warning", "process main was killed")
    for k in range(300):
        lines.add(str(k), "warning", f"held: a frame was served {k} ms late")
        lines.add(str(k), "warning", "resumed: turning")
        if k == 9:
            lines.take_new()
    late = ("299", "warning", "held: a frame was served 299 ms late", 300, 2)
    going = ("299", "warning", "resumed: turning", 300, 3)
    assert lines.rows == [("0.5", "warning", "process main was killed", 1, 1), late, going]
    assert (lines.take_new(), lines.take_new()) == ([late, going], [])
    for text in ("x", "y"):
        lines.add("300", "info", text)
    assert [row[2] for row in lines.rows] == ["resumed: turning", "x", "y"]
    assert lines.left_out == 301  # the 300 that were late, and the one that was killed


def test_the_worst_of_each_second_is_reported_when_the_next_begins() -> None:
    errors = Growing(100)
    compare = TruthCompare(errors)
    for k in range(25):
        error_m = 0.003 if k == 7 else 0.001
        compare.estimate(10 * k, 1.0 + error_m, 2.0, 0.002)
        compare.truth(10 * k, 0.1 * k + 0.05, 1.0, 2.0)
    assert errors.rows == [(0.75, 3.0, 6.0), (1.05, 1.0, 6.0)]


def test_either_may_come_first_and_frames_between_are_not_compared() -> None:
    one, two = Growing(100), Growing(100)
    first, second = TruthCompare(one), TruthCompare(two)
    for seq in range(300):
        first.truth(seq, 0.01 * seq, 0.0, 0.0)
    for seq in range(0, 300, 10):
        first.estimate(seq, 0.001, 0.0, 0.001)
        second.estimate(seq, 0.001, 0.0, 0.001)
    for seq in range(300):
        second.truth(seq, 0.01 * seq, 0.0, 0.0)
    assert one.rows == two.rows
    assert len(one.rows) == 2
    assert [TruthCompare.is_compared(seq) for seq in (7, 20)] == [False, True]


# -- what Prometheus reads ---------------------------------------------------------------------------------------------


GROUND: dict[str, Any] = {"title": "fyst-m1", "states": [str(state) for state in Mode]}
NOTHING: dict[str, Any] = {
    "is_sim": False, "trouble": "main has sent no heartbeat", "links": [], "restarts": {"main": 0, "danger": 2},
    "pids": {},
    "mission": None, "verdict": None, "robot": None, "pose": None, "alarms": [],
}  # fmt: skip
ALL: dict[str, Any] = NOTHING | {
    "trouble": "",
    "alarms": [
        {"name": "no_way_on", "severity": "fault", "ended": "", "acknowledged_by": ""},
        {"name": "rim_ahead", "severity": "hold", "ended": "2026-11-26T00:13:00Z", "acknowledged_by": ""},
        {"name": "fan_weak", "severity": "return", "ended": "", "acknowledged_by": "anna"},
    ],
    "links": [LinkState("main loop", "joined", 0.05, True), LinkState("robot", "no frame yet", None, False)],
    "mission": {
        "state": "driving", "total": 693, "done": 12, "skipped": 1, "elapsed_s": 61.5, "eta_s": 3000.0,
        "missed_deadlines": 2, "worst_lateness_ms": 21.0, "error_mm": 0.25,
        "turn": {"actor": "operator"},
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
    "laser": {"dop": 1.0, "residual_um": 12.0, "channels": [1, 2, 3, 4], "is_used": True, "age_s": 7.5},
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
    assert found.pop("ccatp_build_info") == {(platform.python_version(), ccatp.__version__): 1.0}  # sorted by label
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
        "ccatp_arrival_error_meters": {(): 0.00025},
        "ccatp_nis_per_dof": {(): 1.0},
        "ccatp_event_code": {(): 1.0},
        "ccatp_severity": {(): 2.0},
        "ccatp_alarm": {("no_way_on", "fault"): 1.0, ("fan_weak", "return"): 1.0},
        "ccatp_alarms_unacknowledged": {(): 2.0},
        "ccatp_battery_charge_ratio": {(): 0.93},
        "ccatp_fan_duty_ratio": {("left",): 0.8, ("right",): 0.75},
        "ccatp_wheels_held": {(): 1.0},
        "ccatp_drive_age_seconds": {(): 0.01},
        "ccatp_permit_age_seconds": {(): 0.02},
        "ccatp_robot_faults": {(): 1.0},
        "ccatp_laser_residual_meters": {(): 12e-6},
        "ccatp_laser_dop": {(): 1.0},
        "ccatp_last_fix_age_seconds": {(): 7.5},
        "ccatp_next_actor": {("robot",): 0.0, ("operator",): 1.0, ("observatory",): 0.0, ("nobody",): 0.0},
        "ccatp_dashboard_pages": {(): 3.0},
    }


def test_what_the_loops_use_of_the_machine() -> None:
    found = metrics_of(NOTHING | {"pids": {"main": os.getpid(), "danger": 2**22 + 1}})
    (cpu_s,), (memory,) = (
        found[name].values() for name in ("ccatp_process_cpu_seconds_total", "ccatp_process_resident_memory_bytes")
    )
    assert cpu_s == pytest.approx(sum(os.times()[:2]), abs=1.0)  # whole ticks, and what the test uses meanwhile
    assert 1e7 < memory < 1e10


def test_unknown_values_are_not_used() -> None:
    metrics = metrics_of(NOTHING)
    assert set(metrics) == {
        "ccatp_info", "ccatp_build_info", "ccatp_up", "ccatp_process_restarts_total", "ccatp_dashboard_pages",
        "ccatp_alarms_unacknowledged",
    }  # fmt: skip
    assert metrics["ccatp_up"] == {(): 0.0}


def test_a_name_is_escaped() -> None:
    title = 'a"b\\c\nd'
    assert next(iter(metrics_of(NOTHING, title=title)["ccatp_info"]))[0] == title
