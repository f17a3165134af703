"""Commands for surveys, given what is of a mission among beacons; and runs of which there is little."""

import shutil
from pathlib import Path

import pytest

from ccatp.cli import main
from ccatp.config.load import dump_config, load_config
from ccatp.config.package import configs_dir
from ccatp.links.topics import schema_of
from ccatp.records.recorder import Recorder, iter_messages


@pytest.mark.parametrize("command", [["align"], ["plot"], ["replay"], ["calibrate", "--from"]])
def test_a_run_among_beacons_is_named_as_such(
    command: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copy(configs_dir() / "zigbee.toml", tmp_path / "config.toml")
    Recorder(tmp_path / "telemetry.mcap", [("truth", schema_of("truth"))], is_simulation=True).close()
    assert main([*command, str(tmp_path)]) == 2
    err = capsys.readouterr().err
    assert f'{tmp_path}/config.toml: is of a mission among beacons (system = "zigbee")' in err
    assert err.endswith(f"use ccatp report {tmp_path}\n")
    assert err.count("\n") == 1


def test_the_check_is_of_surveys(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "--sim", "--config", str(configs_dir() / "zigbee.toml")]) == 2
    out, err = capsys.readouterr()
    assert "is of a mission among beacons" in err
    assert "surveys of mirrors alone; use ccatp run" in err
    assert err.count("\n") == 1
    assert not out


def test_a_map_of_a_run_without_points(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "config.toml").write_text(dump_config(load_config()))
    assert main(["plot", str(tmp_path)]) == 2
    err = capsys.readouterr().err
    assert f"{tmp_path}: no mission.sqlite there" in err
    assert "resume" not in err


def test_a_cut_recording_is_told_without_loose_ends(tmp_path: Path) -> None:
    path = tmp_path / "telemetry.mcap"
    recorder = Recorder(path, [("truth", schema_of("truth"))], is_simulation=True)
    recorder.write("truth", 1.0, b'{"seq":0,"t_s":0.0,"rows":[]}')
    recorder.close()
    path.write_bytes(path.read_bytes()[:-60])
    damages: list[str] = []
    assert list(iter_messages(path, damages.append))
    (damage,) = damages
    assert "damaged or cut off before byte" in damage
    assert damage == damage.rstrip(" :")
