"""Progress on the terminal, its rate limit, and the report at the end of a run."""

import json
from pathlib import Path

import pytest
from msgspec.structs import replace

from ccatp.beacons.config.load import load_radio_config
from ccatp.daemon.loops.survey_runner import state_text
from ccatp.daemon.operator.terminal import RunView
from ccatp.daemon.supervision.process import Endpoints, RunContext
from ccatp.links.liveness import RateLimitedLog, kind_of
from ccatp.links.topics import DangerEvent, LogMessage, MissionStatus, TrackMessage
from ccatp.survey.events import Mode
from tests.support.scenario import world_of

CFG, _ = world_of()
STATUS = MissionStatus(seq=-1, t_s=0.0, state="driving", elapsed_s=61.0, eta_s=9.0, done=1, total=10)


def test_a_run_from_its_first_line_to_its_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / ("a" * 100) / "[b]"  # one line, however long, and no markup
    view = RunView(RunContext(CFG, folder, Endpoints(folder), is_sim=True))
    event = DangerEvent(seq=1, t_s=2.0, code=0, cause="", signal="", value=0.0, limit=0.0, off=(False,) * 4)
    row = (1, 0.01, 2, 3, 0.1, 0.2, 0.3, 1e-3)
    for message in (
        STATUS,
        STATUS,  # only every tenth is told
        TrackMessage(seq=1, t_s=0.0, rows=[row]),
        TrackMessage(seq=1, t_s=0.0, rows=[row]),  # the first pose only
        LogMessage(seq=1, t_s=0.0, level="error", process="main", text="held"),
        event,  # all is well
        replace(event, code=1, cause="edge", signal="edge_fl"),
    ):
        view.show(message)
    view.show_summary({"mirror": "fyst-m1"}, as_json=True)
    view.show_report(str(tmp_path / "report.html"))
    reported = capsys.readouterr()
    assert json.loads(reported.out) == {"mirror": "fyst-m1"}
    first, *lines, danger, report = reported.err.splitlines()
    assert first == f"ccatp SIMULATION of fyst-m1, world thesis, seed 1, filter ekf; writing {folder}"
    assert lines == [
        "10 %: 1 of 10 points, driving, 1:01 elapsed, 0:09 remaining",
        "info: first pose at 0.01 s: panel 2-3, x 0.1000 m, y 0.2000 m, heading 0.3000 rad",
        "error: held",
    ]
    assert danger.startswith("warning: danger: code 1, edge")
    assert report == f"report  {tmp_path / 'report.html'}"


@pytest.mark.parametrize(
    ("verbosity", "lines"),
    [
        (-1, ["error: held"]),
        (1, ["debug: driving", "10 %: 1 of 10 points", "error: held", "debug: held", "report  there"]),
    ],
)
def test_quiet_and_verbose(
    verbosity: int, lines: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    view = RunView(RunContext(CFG, tmp_path, Endpoints(tmp_path), is_sim=True), verbosity)
    for message in (STATUS, LogMessage(seq=1, t_s=0.0, level="error", process="main", text="held")):
        view.show(message)
    view.show(replace(STATUS, state="held"))
    view.show_report("there")
    reported = capsys.readouterr().err.splitlines()
    assert [line.partition(",")[0] for line in reported if not line.startswith("ccatp SIM")] == lines


def test_danger_is_shown_where_it_holds_the_robot_without_a_code(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    view = RunView(RunContext(CFG, tmp_path, Endpoints(tmp_path), is_sim=True))
    event = DangerEvent(seq=1, t_s=2.0, code=0, cause="late", signal="", value=0.0, limit=0.0, off=(False,) * 4)
    for severity in range(7):
        view.show(replace(event, severity=severity))
    shown = [line.split(", late")[0] for line in capsys.readouterr().err.splitlines()[1:]]
    assert shown == [f"warning: danger: {word}" for word in ("slow", "hold", "return", "fault")]


def test_a_verdict_is_shown_again_only_after_another_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    view = RunView(RunContext(CFG, tmp_path, Endpoints(tmp_path), is_sim=True))
    stale = DangerEvent(
        seq=1, t_s=2.0, code=0, cause="encoder samples stale", signal="enc", value=0.151, limit=0.15, off=(False,) * 4,
        severity=4,
    )  # fmt: skip
    normal = replace(stale, cause="", signal="", severity=0)
    also_other = replace(stale, t_s=2.1, value=0.251, active=[("edge_stale", "edge samples stale", 3)])
    for event in (stale, also_other, replace(stale, t_s=2.2), replace(stale, severity=6), normal, stale):
        view.show(event)
    shown = [line.split(", ")[0] for line in capsys.readouterr().err.splitlines()[1:]]
    assert shown == ["warning: danger: hold", "warning: danger: fault", "warning: danger: hold"]


def test_progress_with_and_without_a_point(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    survey = RunView(RunContext(CFG, tmp_path, Endpoints(tmp_path), is_sim=False))
    at_point = replace(STATUS, point="1-2-3", error_mm=0.5)
    assert survey.text_of(at_point) == "driving 1-2-3, 1:01 elapsed, 0:09 remaining, arrival 0.50 mm"
    beacons = RunView(RunContext(load_radio_config(None), tmp_path, Endpoints(tmp_path), is_sim=True))
    held = replace(STATUS, cause="operator", state="held", error_mm=25.0)
    assert beacons.text_of(held) == "held (operator), 1:01 elapsed, position known to 2.5 cm"
    titles = [line.partition(";")[0] for line in capsys.readouterr().err.splitlines()]
    assert titles == [
        "ccatp survey of fyst-m1, filter ekf",
        "ccatp SIMULATION among beacons: zigbee, visit waypoints, seed 1",
    ]


@pytest.mark.parametrize(
    ("state", "cause", "text"),
    [
        (Mode.HELD, "operator", "held: operator"),
        (Mode.TURNING, "", "resumed: turning"),
        (Mode.RETURNING, "fire", "returning: fire"),
        (Mode.HELD, "", "held"),
        (Mode.SETTLING, "frame late", "resumed: settling, after: frame late"),  # it takes a fix first
        (Mode.DONE, "frame late", "done"),  # an operator stopped it
    ],
)
def test_a_mission_that_continues_reports_it(state: Mode, cause: str, text: str) -> None:
    assert state_text(state, cause) == text


@pytest.mark.parametrize(
    ("one", "other", "is_same"),
    [
        ("a frame was served 145 ms late", "a frame was served 59 ms late", True),
        ("at 1.25 s", "at 300 s", True),
        ("late by 12.5.", "late by 3.", True),
        ("measurement of 1-2-7 failed", "measurement of 1-2-8 failed", False),
        ("panel 1/2", "panel 1/3", False),
        ("robot at 127.0.0.1:7010", "robot at 127.0.0.2:7010", False),
    ],
)
def test_kinds(one: str, other: str, is_same: bool) -> None:
    assert (kind_of(one) == kind_of(other)) is is_same


def test_a_few_of_each_kind_are_reported_and_errors_all() -> None:
    sparing = RateLimitedLog(2, 10.0)
    reported = [sparing.take("warning", f"held: {k} ms late", 0.1 * k) for k in range(50)]
    assert reported == ["held: 0 ms late", "held: 1 ms late", *[None] * 48]
    assert sparing.take("warning", "resumed: turning", 5.0) == "resumed: turning"
    assert sparing.take("info", "held: 9 ms late", 5.0) == "held: 9 ms late"
    assert sparing.take("warning", "held: 7 ms late", 10.5) == "held: 7 ms late (48 more times)"
    assert [sparing.take("error", "broken", 0.0) for _ in range(9)] == ["broken"] * 9
