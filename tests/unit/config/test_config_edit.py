"""Tests of changing single keys of a configuration file."""

import os
from pathlib import Path

import pytest

from ccatp.config.load import difference, with_values, write_in_place
from ccatp.errors import ConfigError

TEXT = """# head

[run]  # what
seed = 3      # three
[robot]
port = 7010
edge_sensors_m = [[1, 2],   # left
                  [3, 4]]
"""


def test_only_the_value_changes() -> None:
    after = with_values(TEXT, {"run.seed": 4.5}, Path("x.toml"))
    assert after == TEXT.replace("seed = 3      # three", "seed = 4.5      # three")


def test_what_is_measured_is_unverified_no_more() -> None:
    text = "[robot]\na_m = 0.03  # UNVERIFIED; 1 % wrong\nb_m = 0.1  # UNVERIFIED\n"
    after = with_values(text, {"robot.a_m": 0.031}, Path("x.toml"))
    assert after == text.replace("0.03  # UNVERIFIED", "0.031  # measured by ccatp calibrate")


def test_new_keys_and_sections_are_added() -> None:
    after = with_values(TEXT, {"robot.wheel_base_m": 0.151, "a.b": 1.0}, Path("x.toml"))
    assert after == TEXT + "wheel_base_m = 0.151\n\n[a]\nb = 1.0\n"
    assert with_values("", {"a.b": 1.0}, Path("x.toml")) == "[a]\nb = 1.0\n"


def test_nested_sections_are_found() -> None:
    text = "[localizer.full_state]\nrewind_s = 2.0\n"
    after = with_values(text, {"localizer.gyroscope_bias_rad_s": 0.01}, Path("x.toml"))
    assert "gyroscope_bias_rad_s = 0.01" in after
    assert with_values(after, {"localizer.gyroscope_bias_rad_s": 0.01}, Path("x.toml")) == after


def test_what_is_no_toml_or_no_section_is_told() -> None:
    with pytest.raises(ConfigError, match=r"x\.toml: is not TOML"):
        with_values("[robot", {"robot.a": 1.0}, Path("x.toml"))
    with pytest.raises(ConfigError, match=r"x\.toml: robot is a value, not a section"):
        with_values("robot = 3\n", {"robot.a": 1.0}, Path("x.toml"))


def test_the_difference_shows_both() -> None:
    shown = difference("a = 1\n", "a = 2\n", Path("x.toml"))
    assert "-a = 1" in shown
    assert "+a = 2" in shown
    assert difference("a = 1\n", "a = 1\n", Path("x.toml")) == ""


def test_a_link_stays_a_link_and_the_mode_stays(tmp_path: Path) -> None:
    file, link = tmp_path / "real.toml", tmp_path / "link.toml"
    file.write_text("a = 1\n")
    file.chmod(0o604)
    link.symlink_to(file)
    write_in_place(link, "a = 2\n")
    assert link.is_symlink()
    assert file.read_text() == "a = 2\n"
    assert file.stat().st_mode & 0o777 == 0o604


def test_a_failure_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "a.toml"
    file.write_text("a = 1\n")

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(ConfigError, match=r"a\.toml: cannot be written: No space left"):
            write_in_place(file, "a = 2\n")
    assert file.read_text() == "a = 1\n"
    assert list(tmp_path.iterdir()) == [file]
    with pytest.raises(ConfigError, match="cannot be written: No such file"):
        write_in_place(tmp_path / "missing" / "a.toml", "")
