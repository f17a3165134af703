"""``ccatp study``: what reaches the campaigns, what the shell gets."""

import json
from pathlib import Path
from typing import Any

import pytest

from ccatp.cli import main
from ccatp.studies import STUDIES
from tests.unit.studies import toy


@pytest.fixture(autouse=True)
def toy_study(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ccatp.studies.find_study", lambda name: analysis if name == "one" else toy.STUDY)


def analysis(cfg: Any, out: Path) -> dict[str, Any]:
    """A study without runs."""
    (out / "table.md").write_text(f"{cfg.limits.v_max_m_s}\n")
    return {"study": "one", "cells": [], "wall_s": 0.0}


def test_json_is_alone_on_standard_output(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert main(["study", "toy", "--runs", "2", "--workers", "1", "--seed", "5", "--out", str(out), "--json"]) == 0
    shown = capsys.readouterr()
    result = json.loads(shown.out)
    assert [cell["mean"] for cell in result["cells"]] == pytest.approx([0.05 * 5.5, 0.1 * 5.5])
    assert result["settings"] == {"run.seed": 5}
    assert "ccatp: study toy: 4 jobs to do" in shown.err
    assert shown.err.splitlines()[-1] == f"ccatp: study toy: all 4 jobs are done; results are in {out}"
    assert (out / "figure.txt").exists()
    # The same directory with another configuration.
    assert main(["study", "toy", "--workers", "1", "--out", str(out), "--panels", "3", "--seed", "5"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "was done with another configuration or version; give the options of then, or another --out" in line


def test_without_json_the_table_is_shown(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    args = ["--workers", "1", "--only", "speed_m_s=0.1", "--no-figures", "--panels", "2", "--set", "run.filter=ekf"]
    assert main(["study", "toy", *args]) == 0
    assert capsys.readouterr().out == "# A toy\n\n| speed_m_s | runs | mean |\n|---|---|---|\n| 0.1 | 3 | 0.20 |\n"
    settings = json.loads((tmp_path / "studies/toy/result.json").read_text())["settings"]
    assert settings == {"run.panels": 2, "run.filter": "ekf"}


def test_shards_report_what_is_missing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    args = ["study", "toy", "--workers", "1", "--out"]
    assert main([*args, str(tmp_path / "a"), "--shard", "1/2"]) == 0
    shown = capsys.readouterr().err
    assert "3 of 6 jobs are done; the other shards, or the same command without --shard, do the 3 that are m" in shown
    assert main([*args, str(tmp_path / "b"), "--from", str(tmp_path / "a")]) == 0
    assert "3 jobs to do, 3 done before" in capsys.readouterr().err


def test_an_analysis_takes_what_every_study_takes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    args = ["study", "one", "--out", str(tmp_path / "a"), "--set", "limits.v_max_m_s=0.05"]
    assert main([*args, "--runs", "3", "--panels", "1", "--json"]) == 0
    shown = capsys.readouterr()
    assert json.loads(shown.out)["study"] == "one"
    assert shown.err == "ccatp: study one is one analysis: --runs and --workers change nothing\n"
    assert main(args) == 0
    assert capsys.readouterr().out == "0.05\n"


HANDED_OUT = [
    ("--cluster", "a:1"), ("--shard", "1/2"), ("--from", "x"), ("--only", "a=b"), ("--mirror", "fyst-m1"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("name", "out", "args", "status", "message"),
    [
        *(
            ("one", "", args, 2, f"ccatp: study one has no runs to hand out; leave {args[0]} out")
            for args in HANDED_OUT
        ),
        ("one", "file/out", (), 2, "ccatp: --out: cannot make {out}: Not a directory; choose another --out"),
        ("toy", "file/out", (), 2, "ccatp: --out: cannot make {out}: Not a directory; choose another --out"),
        ("one", "taken", (), 4, "ccatp: {out}/table.md: Is a directory; make room or choose another --out"),
    ],
)
def test_what_cannot_be_is_one_line(
    name: str, out: str, args: tuple[str, ...], status: int, message: str, tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    (tmp_path / "file").touch()
    (tmp_path / "taken" / "table.md").mkdir(parents=True)
    assert main(["study", name, "--out", str(tmp_path / out), *args]) == status
    assert capsys.readouterr().err == message.format(out=tmp_path / out) + "\n"


def test_an_unknown_study_is_one_line_and_help_lists_the_others(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.undo()
    assert main(["study", "filter", "--out", str(tmp_path)]) == 2
    assert capsys.readouterr().err == "ccatp: no study 'filter'; did you mean filters?\n"
    assert main(["study", "--help"]) == 0
    shown = capsys.readouterr().out
    assert all(f"  {name} " in shown for name in STUDIES)
