"""``ccatp config init``, ``show``, ``diff`` and ``schema``; ``ccatp runs``."""

import json
import re
from pathlib import Path
from typing import Any

import pytest

from ccatp.cli import main
from ccatp.config.describe import comments, differences, json_schema, template
from ccatp.config.load import load_config, load_radio_config
from ccatp.links.runtime_dir import locked
from ccatp.records.recorder import RUN_LOCK
from tests.support.command import refused


def leaves(schema: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Every value of a schema by its dotted key; * for any name."""
    found: dict[str, dict[str, Any]] = {}

    def visit(node: dict[str, Any], key: str) -> None:
        model = schema["$defs"].get(str(node.get("$ref")).removeprefix("#/$defs/"), node)
        for name, value in model.get("properties", {}).items():
            if "$ref" not in value:
                found[f"{key}{name}"] = value
            visit(value, f"{key}{name}.")
        if isinstance(model.get("additionalProperties"), dict):
            visit(model["additionalProperties"], f"{key}*.")

    visit(schema, "")
    return found


def test_every_key_has_a_description_and_its_unit() -> None:
    found = leaves(json_schema())
    assert len(found) > 300
    assert [key for key, value in found.items() if len(value.get("description", "")) < 5] == []
    units = {key: value["unit"] for key, value in found.items() if "unit" in value}
    assert (units["limits.v_max_m_s"], units["mirror.panels.gap_mm"], units["run.budget_s"]) == ("m/s", "mm", "s")
    assert found["robot.max_wheel_rad_s"] == {
        "description": "interface control document 1", "exclusiveMinimum": 0.0, "maximum": 1e6, "unit": "rad/s",
        "title": "Max Wheel Rad S", "type": "number",
    }  # fmt: skip


def test_comments_of_keys_and_sections() -> None:
    text = "# head\n[a]  # section\nk = 1\nm = [1, 2] # both\n[a.b-c]\nk = 'x' #\n"
    assert comments(text, "s") == {
        "s": "", "s.a": "section", "s.a.k": "", "s.a.m": "both", "s.a.b-c": "", "s.a.b-c.k": "",
    }  # fmt: skip


def test_the_template_changes_nothing_and_has_every_key(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "mine.toml"
    assert main(["config", "init", str(file)]) == 0
    assert load_config(file) == load_config()
    file.write_text(re.sub(r"(?m)^# (?=[\w-]+ = )", "", template()), encoding="utf-8")
    assert load_config(file) == load_config()
    capsys.readouterr()
    assert f"{file}: exists; choose another name" in refused(capsys, "config", "init", str(file))
    assert main(["config", "init", str(file), "--force"]) == 0


def test_show_and_diff(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, other = tmp_path / "mine.toml", tmp_path / "other.toml"
    file.write_text('[run]\nmirror = "fyst-m2"\n[robot]\nwheel_radius_m = 0.031\n', encoding="utf-8")
    assert main(["config", "show", str(file), "--set", "run.seed=7"]) == 0
    other.write_text(capsys.readouterr().out, encoding="utf-8")
    assert load_config(other) == load_config(file, {"run.seed": 7})
    assert main(["config", "diff", str(file)]) == 0
    assert capsys.readouterr().out.splitlines() == [
        'run.mirror: "fyst-m1" -> "fyst-m2"', "robot.wheel_radius_m: 0.03 -> 0.031",
    ]  # fmt: skip
    assert main(["config", "diff", str(file), str(other), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"run.seed": [1, 7]}
    assert main(["config", "diff", "follow"]) == 0
    assert capsys.readouterr().out == "no difference\n"
    assert differences(load_radio_config(None, {"run.seed": 9})) == [("run.seed", 1, 9)]


# -- runs --------------------------------------------------------------------------------------------------------------


def make_run(folder: Path, status: int | None, measured: int) -> Path:
    folder.mkdir(parents=True)
    (folder / "config.toml").write_text("")
    events: list[dict[str, Any]] = [
        {"event": "run_started", "timestamp": f"2026-01-0{measured}T00:00:00.5Z", "seed": 3, "mirror": "fyst-m1"}
    ]
    if status is not None:
        events.append({"event": "run_finished", "timestamp": "2026-02-01T00:00:00Z", "status": status})
        summary = {"mirror": "fyst-m1", "world": "hard", "points": {"total": 9, "measured": measured}}
        (folder / "summary.json").write_text(json.dumps(summary))
        (folder / "origin.json").write_text('{"simulation": true}')
    lines = [json.dumps(event) for event in events]
    # Between the first and the last ones of a long log nobody looks.
    (folder / "log.jsonl").write_text("\n".join([lines[0], '{"cut', *["{}"] * 100_000, *lines[1:]]) + "\n")
    return folder


def test_runs_with_how_they_ended(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make_run(tmp_path / "b", 0, 9)
    make_run(tmp_path / "a", 4, 2)
    killed, going_on = make_run(tmp_path / "c", None, 3), make_run(tmp_path / "d", None, 4)
    (tmp_path / "no run").mkdir()
    with locked(going_on / RUN_LOCK, "test"):
        assert main(["runs", "list", str(tmp_path), "--json"]) == 0
    runs = json.loads(capsys.readouterr().out)["runs"]
    assert [(run["run"][-1], run["state"], run["points"], run["what"]) for run in runs] == [
        ("a", "held", "2/9", "fyst-m1, hard, simulated"), ("c", "not finished", "", "fyst-m1"),
        ("d", "going on", "", "fyst-m1"), ("b", "complete", "9/9", "fyst-m1, hard, simulated"),
    ]  # fmt: skip
    assert main(["runs", "list", str(tmp_path)]) == 0
    assert capsys.readouterr().out.splitlines()[1].split() == [
        "2026-01-02T00:00:00", "held", "2/9", "0.3", "fyst-m1,", "hard,", "simulated", str(tmp_path / "a"),
    ]  # fmt: skip
    assert main(["runs", "show", str(killed)]) == 0
    shown = capsys.readouterr().out
    assert "state           not finished\n" in shown
    assert "config.toml                   0.000 MB  the exact configuration\n" in shown
    assert main(["runs", "show", str(killed), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["files"]["config.toml"] == 0
    assert "no such folder" in refused(capsys, "runs", "list", str(tmp_path / "none"))
    assert "no run directory (it has no config.toml)" in refused(capsys, "runs", "show", str(tmp_path))


def test_an_error_is_an_object_where_json_is_asked_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["runs", "show", str(tmp_path), "--json"]) == 2
    caught = capsys.readouterr()
    assert caught.out == ""
    assert json.loads(caught.err) == {
        "error": f"{tmp_path}: no run directory (it has no config.toml); ccatp runs list shows them", "status": 2,
    }  # fmt: skip
