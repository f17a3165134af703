"""Pages of surveys and comparisons: sections by what a run holds, nothing from outside, text that stays text."""

import base64
import hashlib
import html
import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from markupsafe import escape

from ccatp.cli import main
from ccatp.config.load import dump_config, load_config
from ccatp.core import Vector3
from ccatp.errors import ConfigError
from ccatp.links.topics import FixMessage
from ccatp.records.state_log import LogLine
from ccatp.report.alignment import worst_corner
from ccatp.report.compare import SurveyPair, compare_lines, compare_page, compared_figures, read_survey, survey_of
from ccatp.report.findings import findings_of, outcome_of
from ccatp.report.html import POLICY, environment, events_of, micro_text
from ccatp.report.record import SurveyFiles, changed_keys, read_record
from ccatp.report.run_page import report_run, run_page
from tests.support.command import answered, printed, refused
from tests.support.pages import Markup
from tests.support.recorded import record

# The result first, then how good it is, then what else is known of the run.
ALL = [
    "panels", "surface", "quality", "map", "points", "localization", "time", "events", "configuration",
]  # fmt: skip


@pytest.mark.usefixtures("drawn")
def test_the_page_of_a_whole_run(recorded: Path, run_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    figures = run_dir.parent / "figures" / "deep"
    reported = answered(capsys, "report", run_dir, "--figures", figures)
    the_command_says_what_it_wrote(reported, run_dir, figures)
    page = (run_dir / "report.html").read_text(encoding="utf-8")
    markup = Markup(page)
    assert markup.outside == []
    assert markup.anchors == ALL
    assert f'content="{POLICY}"' in page
    (script,) = markup.scripts
    ours = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert POLICY.startswith(f"default-src 'none'; script-src 'sha256-{ours}'; style-src")
    assert not re.search(r"url\((?!#)", page)
    assert "@import" not in page
    assert "SIMULATION, world hard, seed 1" in page
    assert "Not in this run" not in page
    assert len(page) < 1_000_000
    assert run_page(findings_of(read_record(recorded))) == page


def test_a_real_robot_is_called_one_and_has_no_truth(tmp_path: Path) -> None:
    found = findings_of(read_record(record(tmp_path / "real", is_simulation=False, only=4)))
    reported = found.record
    assert (reported.is_simulation, reported.has_truth, reported.injected, reported.missing) == (False, False, None, ())
    assert found.errors is not None
    assert np.isnan(found.errors.error_mm).all()
    assert (found.figures, found.against) == (None, None)
    assert sum(verdict.first_mm is not None for verdict in found.points) >= 4  # as the laser saw them
    page = run_page(found)
    assert Markup(page).anchors == ALL
    assert "SIMULATION" not in page
    for text in (
        "real robot", "The true pose is not known", "aborted, at base", "the observatory wants the robot home",
        "the planned way to the last measured point",
    ):  # fmt: skip
        assert text in page


@pytest.mark.parametrize(
    ("gone", "left"),
    [
        (("telemetry.mcap",), ["panels", "surface", "quality", "map", "points", "events", "configuration"]),
        (("mission.sqlite", "log.jsonl", "summary.json"), ["quality", "map", "localization", "time", "configuration"]),
        (("telemetry.mcap", "mission.sqlite", "log.jsonl", "summary.json"), ["configuration"]),
    ],
)
def test_sections_by_what_a_run_holds(gone: tuple[str, ...], left: list[str], without: Callable[..., Path]) -> None:
    found = run_page(findings_of(read_record(without(*gone))))
    assert Markup(found).anchors == left
    for name in gone:
        assert f"<li>{name}: " in found


def plain(page: str) -> str:
    """The words of a page, each after one space."""
    return " ".join(html.unescape(re.sub(r"<style.*?</style>|<[^>]*>", " ", page, flags=re.DOTALL)).split())


def test_the_outcome_comes_first_in_plain_words(recorded: Path, tmp_path: Path) -> None:
    found = findings_of(read_record(recorded))
    head = plain(run_page(found).partition("<nav>")[0])
    assert found.alignment is not None
    assert found.alignment.wavefront is not None
    (panel,) = found.alignment.panels
    corner, wavefront = worst_corner(found.record.mirror, panel), found.alignment.wavefront
    assert (
        "complete . 9 of 9 planned points measured: 1 of 77 panels (9 of 693 points) of the mirror. "
        f"Half-wavefront error {micro_text(wavefront.before_m)} \u00b5m rms, {micro_text(wavefront.after_m)} \u00b5m "
        "predicted after the adjuster moves. "
        f"Furthest off: a corner of panel 1/2, {micro_text(corner[0])} \u00b5m."
    ) in head
    cut_short = findings_of(read_record(record(tmp_path / "short", only=1)))
    head = plain(run_page(cut_short).partition("<nav>")[0])
    assert "aborted, at base : the observatory wants the robot home. " in head
    assert "0 of 77 panels (1 of 693 points)" in head
    assert "The panel alignment is not determined." in head


def test_text_stays_text(without: Callable[..., Path]) -> None:
    whole = read_record(without("telemetry.mcap", "mission.sqlite"))  # what is drawn has no text from outside
    evil = '<script>alert("1")</script>&'
    line = LogLine("2026-01-01T00:00:00", None, "error", evil, evil)
    texts = {"name": evil, "log": (line,), "config_text": evil, "files": {evil: 1}}
    spoilt = findings_of(replace(whole, warnings=(evil,), missing=(evil,), **texts))  # type: ignore[arg-type]
    page = run_page(spoilt)
    assert page.count(str(escape(evil))) >= 6
    for found in (page, compare_page(SurveyPair(survey_of(spoilt), survey_of(findings_of(whole))))):
        Markup(found)
        assert evil not in found


def test_a_run_given_up_before_its_first_point_says_why(recorded: Path) -> None:
    whole = read_record(recorded)
    names = [f"{row.point.row}-{row.point.col}-{row.point.point}" for row in whole.points or ()]
    rows = tuple(row._replace(status="planned", t_s=None) for row in whole.points or ())
    summary = {**(whole.summary or {}), "points": {"left_out": {"operator": names}}}
    found = run_page(findings_of(replace(whole, points=rows, measured=(), summary=summary)))
    assert "<p>9 not measured: operator.</p>" in found
    assert "<p>No point measured: no surface, no adjuster moves.</p>" in found


@pytest.mark.parametrize(
    ("changes", "outcome"),
    [
        ({}, ("complete", "", True)),
        ({"log": True, "outcome": "", "exit_status": -1, "state": "driving", "cause": ""}, ("complete", "", True)),
        (
            {"outcome": "", "exit_status": 4, "state": "held", "cause": "stuck"},
            ("ended with status 4, held", "stuck", False),
        ),
        (
            {"outcome": "stopped", "exit_status": 4, "cause": "encoder samples stale", "stopped_by": "eva"},
            ("stopped", "by eva, held before: encoder samples stale", False),
        ),
        ({"outcome": "", "exit_status": -1, "state": "driving", "cause": ""}, ("interrupted", "while driving", False)),
    ],
)
def test_outcomes(recorded: Path, changes: dict[str, object], outcome: tuple[str, str, bool]) -> None:
    whole = read_record(recorded)
    if not changes.pop("log", False):  # it has the end of a mission whose recording is cut off
        whole = replace(whole, log=())
    (session,) = whole.sessions
    status = msgspec.structs.replace(session.statuses[-1], **changes)
    found = outcome_of(replace(whole, sessions=(replace(session, statuses=(status,)),)))
    assert (found.text, found.cause, found.is_good) == outcome


@pytest.mark.parametrize(
    ("ended", "outcome"),
    [
        ({"what": "failed", "by": "program", "cause": "main died"}, ("failed", "main died", False)),
        ({"what": "interrupted", "by": "signal"}, ("interrupted", "by a signal", False)),
        ({"what": "faulted", "by": "mission", "cause": "stuck"}, ("ended with a fault", "stuck", False)),
        ({"what": "at_base", "by": "operator", "who": "eva"}, ("aborted, at base", "by eva", False)),
        ({"what": "complete", "by": "mission"}, ("complete", "", True)),
    ],
)
def test_the_outcome_is_that_of_the_summary_whatever_the_last_status_says(
    recorded: Path, ended: dict[str, str], outcome: tuple[str, str, bool]
) -> None:
    whole = read_record(recorded)
    (session,) = whole.sessions
    driving = msgspec.structs.replace(session.statuses[-1], outcome="", exit_status=-1, state="driving", cause="link")
    cut_off = replace(session, statuses=(driving,))
    found = outcome_of(replace(whole, sessions=(cut_off,), summary={**(whole.summary or {}), "ended": ended}))
    assert (found.text, found.cause, found.is_good) == outcome


def test_the_summary_of_an_earlier_session_says_nothing_of_one_in_progress(recorded: Path, tmp_path: Path) -> None:
    for file in recorded.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    with (tmp_path / "log.jsonl").open("a", encoding="utf-8") as log:
        log.write('{"logger": "supervisor", "event": "run_started", "level": "info"}\n')
    record = read_record(tmp_path)
    assert record.summary is None
    assert [line for line in record.missing if line.startswith("summary.json: it is of an earlier session")]


def test_alarms_that_were_active_at_the_end_are_on_the_page(recorded: Path) -> None:
    whole = read_record(recorded)
    ended = {"what": "stopped", "by": "operator", "alarms": [{"name": "lifted", "severity": "hold", "cause": "in air"}]}
    page = run_page(findings_of(replace(whole, summary={**(whole.summary or {}), "ended": ended})))
    assert "Alarms active at the end" in page
    assert "lifted: in air" in page


# -- quality of the measurement ---------------------------------------------------------------------------------------


def with_fixes(whole: SurveyFiles, fixes: tuple[FixMessage, ...]) -> SurveyFiles:
    (session,) = whole.sessions
    return replace(whole, sessions=(replace(session, fixes=fixes),))


def moved(whole: SurveyFiles, fix: FixMessage, by_m: Vector3) -> FixMessage:
    """A fix elsewhere, deck frame."""
    offset = np.array(whole.mirror.world_from_deck(by_m)) - whole.mirror.world_from_deck((0.0, 0.0, 0.0))
    return msgspec.structs.replace(fix, position_m=tuple((np.array(fix.position_m) + offset).tolist()))


def test_repeatability_is_that_of_points_measured_more_than_once(recorded: Path) -> None:
    whole = read_record(recorded)
    fixes = [fix for fix in whole.sessions[0].fixes if fix.point is not None]
    assert (findings_of(whole).quality.repeats, findings_of(whole).quality.repeat_um) == (0, None)
    assert "no point was measured twice" in run_page(findings_of(whole))
    again = [moved(whole, fix, (0.0, 0.0, up_m)) for fix in fixes[:4] for up_m in (-3e-6, 3e-6)]
    doubted = [msgspec.structs.replace(again[0], is_fused=False, position_m=(0.0, 0.0, 9.0))]
    quality = findings_of(with_fixes(whole, (*again, *doubted))).quality
    assert (quality.repeats, quality.fixes, quality.refused) == (4, 9, 1)
    # Two values d above and below their mean have the standard deviation sqrt(2) d; panels are up to 6 deg steep.
    assert quality.repeat_um == pytest.approx(3.0 * np.sqrt(2.0), rel=0.01)


def test_nis_is_of_the_place_of_the_fix_against_the_estimate(recorded: Path) -> None:
    whole = read_record(recorded)
    (session,) = whole.sessions
    fix = session.fixes[-1]
    at = int(np.searchsorted(session.track.seq, fix.seq))
    height_m = whole.cfg.robot.puck_height_m
    x_m, y_m, _ = whole.mirror.foot_of_puck(fix.position_m, height_m)
    sigma_m = 1e-3  # a thousand times what the fix is uncertain
    wide = replace(session, fixes=(fix,), sigma_m=np.full_like(session.sigma_m, sigma_m))
    wide.track.pose[at, :2] = x_m + 3.0 * sigma_m, y_m
    quality = findings_of(replace(whole, sessions=(wide,))).quality
    assert quality.nis is not None
    assert quality.nis.mean == pytest.approx(9.0 / 2.0, rel=1e-3)


# -- two runs ---------------------------------------------------------------------------------------------------------


def test_two_surveys_of_one_mirror_agree(
    recorded: Path, run_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = run_dir / "config.toml"
    config.write_text(dump_config(load_config(config, {"run.filter": "ukf"})))
    out, figures = tmp_path / "cmp.html", tmp_path / "figures"
    data = answered(capsys, "compare", recorded, run_dir, "--out", out, "--figures", figures)
    assert (data["one_mirror"], data["agree"], data["dof"], data["report"]) == (True, True, 3, str(out))
    (panel,) = data["panels"]
    assert panel["piston_um"] == 0.0 < panel["sigma"][0]
    names = ("time", "localization", "arrivals", "change", "paths")
    assert {path.name for path in figures.iterdir()} == {f"{n}.{s}" for n in names for s in ("svg", "png", "pdf")}
    page = out.read_text()
    markup = Markup(page)
    assert markup.outside == []
    assert markup.anchors == [
        "figures", "configuration", "map", "time", "errors", "points", "surface", "panels", "adjusters", "events",
    ]  # fmt: skip
    assert '<tr><th scope="row">run.filter</th><td>ekf</td><td>ukf</td></tr>' in page
    assert '<tr><th scope="row">points</th><td>9</td><td>9</td><td>0</td></tr>' in page
    assert "The surveys agree" in page
    adjusters = page[page.index('<section id="adjusters">') :]
    row = adjusters[adjusters.index("<tbody>") : adjusters.index("</tbody>")]
    assert row.count("\u2192 <strong>") == 5


def test_panels_that_moved_are_found(recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    elsewhere = record(tmp_path / "moved", run__seed=2)  # its panels lie otherwise
    lines = printed(capsys, "compare", recorded, elsewhere, "--out", tmp_path / "c.html").splitlines()
    (differ,) = (at for at, line in enumerate(lines) if line.startswith("the surveys differ: chi2 of no change "))
    assert lines[differ + 1].startswith("panel 1/2 has moved: piston ")
    # Its adjusters were not moved as the first survey asks for: each of the five is judged.
    assert lines[differ + 2].startswith("adjuster moves that A plans, by the change that B shows: ")
    assert sum(int(word) for word in lines[differ + 2].split() if word.isdecimal()) == 5
    assert lines[-2].startswith("repeatability of a point ")
    assert lines[-1] == str(tmp_path / "c.html")
    (line,) = (line for line in lines if line.startswith("half-wavefront error, um"))
    assert all(len(cell.partition(".")[2]) == 2 for cell in line.split()[-3:])
    assert "1 of 1 panels have moved" in (tmp_path / "c.html").read_text()


def test_a_run_beside_itself_says_that_nothing_differs(recorded: Path) -> None:
    found = findings_of(read_record(recorded))
    lines = compare_lines(SurveyPair(survey_of(found), survey_of(found)))
    assert lines[0] == "no figure differs"
    assert lines[1].startswith("the surveys agree")


def test_ports_that_a_simulation_chose_are_no_change() -> None:
    shipped = {"robot": {"port": 7010}, "sim": {"robot": {"port": 7010}, "frame": 1}}
    chosen = {"robot": {"port": 40001}, "sim": {"robot": {"port": 0}, "frame": 2}}
    assert changed_keys(chosen, shipped) == {"sim.frame": (2, 1)}
    given = {"robot": {"port": 40001}, "sim": {"robot": {"port": 40001}, "frame": 1}}
    assert list(changed_keys(given, shipped)) == ["robot.port", "sim.robot.port"]


def test_different_mirrors_are_not_compared_point_by_point(recorded: Path, tmp_path: Path) -> None:
    thesis = record(tmp_path / "thesis", run__mirror="thesis-m1", only=2)
    pair = SurveyPair(read_survey(recorded), read_survey(thesis))
    page = compare_page(pair)
    assert Markup(page).anchors == ["figures", "configuration", "time", "errors", "events"]
    warning = "The runs are of different mirrors, fyst-m1 and thesis-m1: points and panels are not compared."
    assert warning in page
    assert compare_lines(pair)[0] == f"warning: {warning}"
    assert not [one.name for one in compared_figures(pair) if "wavefront" in one.name and one.change is not None]


# -- lines of the log -------------------------------------------------------------------------------------------------


def events_body(lines: list[LogLine]) -> str:
    macros = environment().get_template("macros.html").module
    return str(macros.log_events(events_of(lines)))  # type: ignore[attr-defined]


def line(text: str, level: str = "warning", t_s: float | None = 1.0, process: str = "main") -> LogLine:
    return LogLine("2026-01-01T12:00:00.5Z", t_s, level, process, text)


LATE = [line(f"late frame: lag {0.05 + 0.001 * k:.3f} s, limit 0.05 s", t_s=1.0 * k) for k in range(300)]
GRAVE = (
    line("process main was killed by SIGKILL: restarting it, wheels held meanwhile", t_s=None, process="supervisor"),
    line("operator: abort", level="info", t_s=350.0),
    line("held for 30 s, waiting for an operator: stuck", level="error", t_s=360.0),
)


def test_a_flood_hides_nothing() -> None:
    before, folded = events_body([*LATE, *GRAVE]).split("<details>")
    rows = before.split("<tr>")[2:]
    assert len(rows) == 4
    for row, found in zip(rows, ("held for 30 s", "was killed", "operator: abort", "late frame"), strict=True):
        assert found in row
    assert "<td>300</td>" in rows[3]
    assert '<th scope="row">0.00 s</th><td>299.00 s</td>' in rows[3]
    assert "lag 0.050 to 0.349 s, limit 0.05 s" in rows[3]
    assert "12:00:00" in rows[1]  # the supervisor knows no robot time
    assert folded.count("<tr>") == 2 + 303  # of two tables
    few = events_body(LATE[:3]).split("<details>")[0]
    assert few.count("late frame") == 3
    assert "<td>300</td>" not in few


# What a simulated survey that went well leaves in its log.
CLEAN = [
    line("run started: mirror fyst-m1, seed 3, sim yes", "info", None, "supervisor"),
    line("controller joined: main", "info", None, "dataloop"),
    line("gate statistics: fans refused 0", "info", None, "main"),
    line("robot session: text controller lost: wheels held", "info", None, "dataloop"),
    line("run finished: status 0", "info", None, "supervisor"),
]
OVER = "The mission is over: the processes close their connections and end."


def test_a_clean_run_reports_it_in_one_line() -> None:
    shown, folded = events_body(CLEAN).split("<details>")
    assert plain(shown) == "No warnings, no errors, no restarts: 5 lines of information."
    assert folded.index("joined") < folded.index(OVER) < folded.index("gate statistics") < folded.index("lost")
    # Connections that are lost while the mission goes on, or when all is killed, are no end.
    assert OVER not in events_body(CLEAN[:-1])
    assert OVER not in events_body([*CLEAN[:2], *CLEAN[3:]])
    shown = events_body([*CLEAN[:3], GRAVE[0], *CLEAN[3:]]).split("<details>")[0]
    assert shown.count("<tr>") == 2
    assert "was killed" in shown
    resumed = events_body([CLEAN[0], *CLEAN]).split("<details>")[0]
    assert resumed.count("run started") == 2


def test_the_end_of_a_long_log_is_shown_too() -> None:
    calm = [line(f"note {k}", "info") for k in range(1000)]
    folded = events_body([*CLEAN[:2], *calm, *CLEAN[2:]]).split("<details>")[1]
    assert folded.index("joined") < folded.index(OVER) < folded.index("lost")
    assert "606 lines are not shown here: see log.jsonl." in folded


def test_a_page_stays_small_however_much_went_wrong(run_dir: Path) -> None:
    def page(lines: int) -> str:
        with (run_dir / "log.jsonl").open("a") as log:
            for k in range(lines):
                name = "".join(chr(97 + k // 26**place % 26) for place in range(4))  # each of its own kind
                fields = {"logger": "main", "event": f"odd {name}: {'x' * 900}", "level": ("error", "warning")[k % 2]}
                log.write(json.dumps(fields) + "\n")
        whole = read_record(run_dir)
        problems = tuple(f"problem {k}: {'x' * 900}" for k in range(lines // 2))
        spoilt = replace(whole, warnings=problems, missing=problems, files=dict.fromkeys(problems, 1))
        return run_page(findings_of(spoilt))

    small, large = page(1000), page(9000)
    Markup(large)
    assert len(large) < len(small) + 3000  # longer numbers
    assert len(large) < 1_000_000
    words = plain(large)
    assert "and 4400 more." in words  # of 4500 problems
    assert "and 8900 more kinds of such lines: see log.jsonl." in words
    assert re.search(r"96\d\d lines are not shown here: see log\.jsonl\.", words)


# -- the commands -----------------------------------------------------------------------------------------------------


def the_command_says_what_it_wrote(reported: dict[str, Any], run_dir: Path, figures: Path) -> None:
    assert reported["report"] == str(run_dir / "report.html")
    assert (run_dir / "report.html").stat().st_size > 100_000
    assert not list(run_dir.glob("*.new"))
    names = ("path", "surface", "time", "localization")
    assert {path.name for path in figures.iterdir()} == {f"{n}.{s}" for n in names for s in ("svg", "png", "pdf")}
    summary = json.loads((run_dir / "summary.json").read_text())
    assert reported["points"] == {"total": 9, "pass": 9, "corrected": 0, "fail": 0, "skipped": 0, "not_measured": 0}
    assert reported["arrival_error_mm"]["max"] == pytest.approx(summary["arrival_error_mm"]["max"], abs=1e-3)
    assert reported["time_budget_s"]["total"] == pytest.approx(summary["mission_time_s"], abs=0.02)


def test_refusals_and_warnings(run_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("")
    for name in ("telemetry.mcap", "mission.sqlite"):  # whose figures take their time
        (run_dir / name).unlink()
    for command, why in (
        (("report", tmp_path / "nothing"), "nothing: no such directory; name the directory of a run"),
        (("compare", run_dir, tmp_path), "no config.toml there"),
        (("report", run_dir, "--figures", tmp_path / "file" / "figures"), "cannot be written: Not a directory"),
    ):
        assert why in refused(capsys, *command)
    with pytest.raises(ConfigError, match=r"no/a\.html: cannot be written: No such file or directory"):
        report_run(run_dir, tmp_path / "no" / "a.html")
    (run_dir / "summary.json").write_text("{")
    assert main(["report", str(run_dir), "--json"]) == 0
    reported = capsys.readouterr()
    assert reported.err.startswith("ccatp: warning: summary.json: cannot be read: ")
    assert json.loads(reported.out)["warnings"][0].startswith("summary.json: ")


def test_two_layouts_are_drawn_beside_each_other_where_a_process_can_be_forked() -> None:
    # A process of its own, because one with threads, as that of these tests, is not forked.
    code = """
import json, os
from ccatp.report.html import beside

def fail():
    raise ZeroDivisionError(str(os.getpid()))

own, other = beside(lambda: [str(os.getpid())], lambda: [str(os.getpid()), "x" * 1_000_000])
try:
    beside(lambda: [], fail)
except ZeroDivisionError as error:
    failed = str(error)
try:
    beside(fail, lambda: ["x" * 1_000_000])
except ZeroDivisionError as error:
    failed_first = str(error)
try:
    os.waitpid(-1, os.WNOHANG)
    left = "a child"
except ChildProcessError:
    left = ""
print(json.dumps([own, other[0], len(other[1]), failed, failed_first, left, str(os.getpid())]))
"""
    found: dict[str, list[Any]] = {}
    for threads in ("1", "2"):
        env = os.environ | {"OPENBLAS_NUM_THREADS": threads}
        done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True)
        found[threads] = json.loads(done.stdout)
        assert not done.stderr
    *forked, own = found["1"]
    assert forked == [[own], forked[1], 1_000_000, own, own, ""]  # what fails in the fork is reported by its parent
    assert forked[1] != own
    if os.cpu_count() != 1:
        *_, own = found["2"]
        assert found["2"] == [[own], own, 1_000_000, own, own, "", own]
