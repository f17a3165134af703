"""Tests of the commands ``completion``, ``plan`` and ``status``."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import msgspec
import pytest

from ccatp.beacons.config.load import load_radio_config
from ccatp.cli import main
from ccatp.conditions.danger import WHEEL_BLOCKED
from ccatp.config.load import available, dump_config, load_config
from ccatp.config.package import child_environment
from ccatp.core import Severity
from ccatp.daemon.operator.terminal import status_line, status_rows
from ccatp.daemon.supervision.process import RUN_DIR_FILE
from ccatp.daemon.supervision.run_text import clock, text_in
from ccatp.links.topics import MissionStatus
from ccatp.survey.composition import assemble
from ccatp.survey.planning.search import leg_lengths
from tests.support.command import answered, printed
from tests.unit.links.test_auth import serving

BASH = shutil.which("bash")


@pytest.mark.parametrize(
    ("shell", "sign"),
    [("bash", "complete -o nosort -F"), ("zsh", "#compdef ccatp"), ("fish", "complete --no-files --command ccatp")],
)
def test_each_shell_gets_its_script(shell: str, sign: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = printed(capsys, "completion", shell)
    assert sign in text
    assert "_CCATP_COMPLETE" in text
    (tmp_path / "script").write_text(text)
    if program := shutil.which(shell):
        subprocess.run([program, "-n", str(tmp_path / "script")], check=True, timeout=20)


# Each TAB is one start of the program: as few as show that every kind of word is completed.
@pytest.mark.skipif(BASH is None, reason="no bash here")
@pytest.mark.parametrize(
    ("words", "offered"),
    [(("ccatp", "re"), {"replay", "resume"}), (("ccatp", "run", "--mirror", "fyst"), {"fyst-m1", "fyst-m2"})],
    ids=("command", "mirror"),
)
def test_bash_completes(words: tuple[str, ...], offered: set[str], tmp_path: Path) -> None:
    program = tmp_path / "ccatp"
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m ccatp "$@"\n')
    program.chmod(0o755)
    environment = child_environment(os.environ)
    script = f"""
eval "$(ccatp completion bash)"
COMP_WORDS=({" ".join(words)}); COMP_CWORD={len(words) - 1}
_ccatp_completion ccatp
printf '%s\\n' "${{COMPREPLY[@]}}"
"""
    path = {"PATH": f"{tmp_path}:{environment['PATH']}"}
    found = set(
        subprocess.check_output([str(BASH), "-c", script], env=environment | path, text=True, timeout=60).split()
    )
    assert offered <= found
    assert all(word.startswith(words[-1]) for word in found)


NAMES = ("fyst-m1", "fyst-m2", "thesis-m1", "thesis-m2")


def planned(capsys: pytest.CaptureFixture[str], *args: str, status: int = 0) -> Any:
    return answered(capsys, "plan", *args, status=status)


def test_every_shipped_world_is_named_in_the_help(capsys: pytest.CaptureFixture[str]) -> None:
    reported = " ".join(printed(capsys, "plan", "--help").split())
    assert set(available("world")) <= set(re.split(r"[ ,]+", reported))


@pytest.mark.parametrize(("name", "filter_name"), [*((name, "kf") for name in NAMES), ("fyst-m1", "ekf")])
def test_the_plan_is_that_of_a_run(name: str, filter_name: str, capsys: pytest.CaptureFixture[str]) -> None:
    found = planned(capsys, "--mirror", name, "--panels", "3", "--filter", filter_name)
    parts = assemble(load_config(overrides={"run.mirror": name, "run.panels": 3, "run.filter": filter_name}))
    assert found["lower_bound_s"] == pytest.approx(parts.lower_bound_s, abs=1e-3)
    length_m = sum(leg_lengths(parts.route.stops, parts.mirror.base_pose, parts.mirror))
    assert found["length_m"] == pytest.approx(length_m, abs=1e-3)
    assert [(s["x_m"], s["y_m"]) for s in found["stops"]] == [
        (round(stop.x_m, 4), round(stop.y_m, 4)) for stop in parts.route.stops
    ]
    assert [tuple(s["point"]) for s in found["stops"] if s["point"]] == [tuple(point) for point in parts.points]
    assert found["points"] == {"total": 27, "reached": 27}
    assert (found["mirror"], found["order"], found["out_of_reach"]) == (name, "thesis", [])


def test_its_times_add_up(capsys: pytest.CaptureFixture[str]) -> None:
    found = planned(capsys, "--panels", "2")
    parts_s = [found[key] for key in ("driving_s", "turning_s", "measuring_s")]
    assert sum(parts_s) == pytest.approx(found["lower_bound_s"], abs=2e-3)
    assert found["measuring_s"] == pytest.approx(0.5 * sum(s["kind"] != "via" for s in found["stops"]))
    # The clock at the last stop, and the measurement there.
    assert found["stops"][-1]["t_s"] + 0.5 == pytest.approx(found["lower_bound_s"], abs=2e-3)
    times_s = [stop["t_s"] for stop in found["stops"]]
    assert times_s == sorted(times_s)
    assert 0.0 < found["any_order_bound_s"] <= found["lower_bound_s"]
    assert found["fits_budget"]


def test_settings_act(capsys: pytest.CaptureFixture[str]) -> None:
    usual = planned(capsys, "--panels", "4")
    faster = planned(capsys, "--panels", "4", "--set", "limits.v_max_m_s=0.2")
    other = planned(capsys, "--panels", "4", "--set", "run.order=optimised", "--set", "run.budget_s=60")
    assert faster["driving_s"] < usual["driving_s"]
    assert other["order"] == "optimised"
    assert other["lower_bound_s"] < usual["lower_bound_s"]
    assert not other["fits_budget"]


def test_points_out_of_reach_are_reported_and_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    args = ("--panels", "1", "--set", "mission.leg_clearance_m=0.12", "--figure", str(tmp_path / "plan.svg"))
    found = planned(capsys, *args, status=2)
    assert (tmp_path / "plan.svg").read_bytes().startswith(b"<svg")
    # Points lie 115 mm from the rim at least; the first panel of M1 has it below and on its left.
    lost = [tuple(point) for point in found["out_of_reach"]]
    assert lost
    assert all(point[:2] == (1, 2) for point in lost)
    assert (1, 2, 5) not in lost
    assert found["points"] == {"total": 9, "reached": 9 - len(lost)}
    assert main(["plan", *args]) == 2
    out, err = capsys.readouterr()
    assert f"out of reach    {len(lost)} points: 1/2/" in out
    assert err == (
        f"ccatp: {len(lost)} points are out of reach with mission.leg_clearance_m = 0.12 and "
        "turn_clearance_m = 0.005; a run would be refused\n"
    )


def test_the_text_tells_the_same(capsys: pytest.CaptureFixture[str]) -> None:
    found = planned(capsys, "--panels", "10", "--mirror", "fyst-m2")
    out = printed(capsys, "plan", "--panels", "10", "--mirror", "fyst-m2")
    assert "fyst-m2: 90 points of 10 panels, order thesis\n" in out
    assert f"way             {found['length_m']:.1f} m, {len(found['stops'])} stops" in out
    assert out.endswith("out of reach    none\n")
    assert out.splitlines()[1].endswith(" ...")
    said = printed(capsys, "plan", "--mirror", "fyst-m2", "--panels", "1")
    assert "fyst-m2: 9 points of 1 panel, order thesis\n" in said


NO_STATUS = MissionStatus(seq=-1, t_s=0.0, state="")

STATUS = {
    **msgspec.to_builtins(NO_STATUS),
    "state": "driving", "point": "3-4-5", "done": 120, "skipped": 3, "total": 693, "elapsed_s": 754.0, "eta_s": 3700.0,
    "lower_bound_s": 3000.0, "error_mm": 0.052,
}  # fmt: skip


def test_the_table() -> None:
    assert status_rows(STATUS) == [
        ("now", "driving"),  # the daemon is of an older version
        ("state", "driving 3-4-5"),
        ("points", f"120 of 693 measured, 3 skipped  [{'#' * 5}{'.' * 25}]"),
        ("time", "12:34 elapsed, 1:01:40 remaining, minimum 50:00"),
        ("arrival", "0.05 mm from the last point, as estimated"),
        ("event code", "0 normal"),
    ]
    assert dict(status_rows({**STATUS, "error_mm": 0.0, "done": 0}))["arrival"] == "none yet"
    resumed = dict(status_rows({**STATUS, "error_mm": 0.0, "done": 3}))
    assert resumed["arrival"] == "none since the main loop began"  # points were measured by one before it
    held = {
        **STATUS, "state": "held", "point": "", "cause": "operator", "code": 2, "missed_deadlines": 4,
        "worst_lateness_ms": 31.0, "exit_status": 4, "outcome": "stopped",
        "left_out": {"out of time": ["1-2-3", "1-2-4"], "operator": [f"1-2-{k}" for k in range(1, 94)]},
    }  # fmt: skip
    first = ", ".join(f"1-2-{k}" for k in range(1, 11))
    assert (
        dict(status_rows(held)).items()
        >= {
            "cause": "operator",
            "event code": "2 operation aborted",
            "late frames": "4, worst 31 ms",
            "not measured: out of time": "1-2-3, 1-2-4",
            "not measured: operator": f"93 points: {first}, ...",
            "exit status": "4",
            "outcome": "stopped",
        }.items()
    )


def test_what_holds_the_robot_is_shown_with_severity_duration_and_advice() -> None:
    cause = {"condition": WHEEL_BLOCKED.name, "cause": "the left wheel is blocked"}
    wheel = {**STATUS, **cause, "state": "held", "t_s": 95.0, "since_s": 20.0}
    shown = dict(status_rows(wheel))
    assert (shown["severity"], shown["for"], shown["what to do"]) == ("hold", "1:15", WHEEL_BLOCKED.advice)
    assert dict(status_rows({**wheel, "severity": int(Severity.FAULT)}))["severity"] == "fault"  # it has escalated
    paused = dict(status_rows({**wheel, "condition": "operator", "cause": "operator"}))
    assert "severity" not in paused
    assert paused["what to do"].startswith("`ccatp resume`")
    assert "what to do" not in dict(status_rows({**wheel, "condition": "of_another_version"}))


def test_the_status_of_a_mission_among_beacons_has_its_own_words(tmp_path: Path) -> None:
    assert text_in(tmp_path) is None
    run_dir = tmp_path / "run"
    run_dir.mkdir()
    (tmp_path / RUN_DIR_FILE).write_text(f"{run_dir}\n")
    assert text_in(tmp_path) is None  # a run that was removed
    (run_dir / "config.toml").write_text(dump_config(load_radio_config(None)))
    text = text_in(tmp_path)
    visiting = {
        "state": "visiting",
        "point": "waypoint 3",
        "done": 2,
        "total": 8,
        "elapsed_s": 22.6,
        "error_mm": 62.4,
        "turn": {"kind": "work", "actor": "robot", "next": "go_on"},
    }
    assert status_rows(visiting, text)[1:] == [
        ("state", "visiting waypoint 3"),
        ("waypoints", "2 of 8 reached  [########......................]"),
        ("time", "0:23 elapsed"),  # how long it takes is not known
        ("position", "known to 6.2 cm"),
        ("event code", "0 normal"),
    ]
    assert status_line(visiting, text).startswith("25 %: 2 of 8 waypoints, 0:23 elapsed: visiting")
    over = {**visiting, "state": "done", "outcome": "stopped", "exit_status": 4}
    assert dict(status_rows(over, text))["state"] == "done"


def test_one_line() -> None:
    drives = {"kind": "work", "actor": "robot", "next": "go_on"}
    assert status_line({**STATUS, "turn": drives}) == (
        "18 %: 120 of 693 points, 12:34 elapsed, 1:01:40 remaining: driving to 3-4-5. "
        "Next: the robot continues by itself"
    )
    paused = {"kind": "paused", "actor": "operator", "next": "resume", "offers": ["resume"]}
    held = {**STATUS, "state": "held", "turn": {**paused, "why": {"condition": "operator", "values": {"by": "eva"}}}}
    assert status_line(held).endswith(" 12:34 elapsed: paused by eva. Next: an operator: resume")
    assert "remaining" not in dict(status_rows(held))["time"]
    home = {**STATUS, "state": "returning", "eta_s": 0.0, "turn": {**drives, "kind": "home"}}
    assert status_line(home).endswith(
        " 12:34 elapsed: driving home. Next: the robot drives to its base, where the run ends"
    )
    assert status_line({}).startswith("0 %: 0 of 0 points")
    assert [clock(s) for s in (-1.0, 0.4, 59.6, 3600.0)] == ["0:00", "0:00", "1:00", "1:00:00"]


def answers(*found: dict[str, Any]) -> Any:
    left = list(found)
    return lambda _: {"ok": True, "status": {**STATUS, **(left.pop(0) if len(left) > 1 else left[0])}}


def test_watching_tells_changes_until_the_end(runtime_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    course = answers({}, {}, {"done": 121}, {"done": 693, "state": "done", "exit_status": 0})
    command = ["status", "--watch", "--every", "0.1", "--runtime-dir", str(runtime_dir)]
    with serving(runtime_dir, "control", course) as asked:
        assert main(command) == 0
    assert len(asked) == 4
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 3  # what did not change is not told again
    assert lines[-1].endswith("100 %: 693 of 693 points, 12:34 elapsed: done")
    with serving(runtime_dir, "control", answers({}, {"exit_status": 3})):
        assert main([*command, "--json"]) == 0
    assert [json.loads(line)["status"]["exit_status"] for line in capsys.readouterr().out.splitlines()] == [-1, 3]


def test_watching_a_daemon_that_goes_ends_well(
    runtime_dir: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    command = ["status", "--watch", "--runtime-dir", str(runtime_dir)]
    assert main(command) == 5  # nobody was there
    with serving(runtime_dir, "control", answers({})):
        # The daemon goes between two looks.
        monkeypatch.setattr("ccatp.cli.operate.time.sleep", lambda _: (runtime_dir / "control").unlink())
        assert main(command) == 0
    assert "driving" in capsys.readouterr().out


def test_a_terminal_gets_a_table(
    runtime_dir: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "120")
    with serving(runtime_dir, "control", answers({}, {"exit_status": 0})):
        assert main(["status", "--watch", "--every", "0.1", "--runtime-dir", str(runtime_dir)]) == 0
    assert "120 of 693 measured" in capsys.readouterr().out
