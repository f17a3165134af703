"""Hints in complaints about a configuration."""

import math
import os
import tomllib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ccatp.config.load import difference, with_values, write_in_place
from ccatp.config.messages import choice_hint, faults_of, find_line, format_key, format_toml, format_value, slip_hint
from ccatp.errors import ConfigError


def test_the_longest_suffix_tells_the_unit() -> None:
    assert slip_hint(("limits", "v_max_m_s"), 100.0, 0.3) == "; looks like mm/s: 100 mm/s are 0.1 m/s"
    assert slip_hint(("limits", "omega_max_rad_s"), 60.0, 5.0) == "; looks like deg/s: 60 deg/s are 1.0472 rad/s"
    assert slip_hint(("robot", "edge_sensors_m", 0, 1), 90.0, 2.0).endswith("are 0.09 m")


def test_no_unit_is_guessed_that_would_not_fit_either() -> None:
    assert slip_hint(("robot", "wheel_radius_m"), 3000.0, 0.2) == ""
    assert slip_hint(("robot", "port"), 70000.0, 65535.0) == ""


def test_a_choice_names_the_nearest_and_all() -> None:
    assert choice_hint("fyst-m1x", ["fyst-m2", "fyst-m1"]) == "did you mean fyst-m1? available: fyst-m1, fyst-m2"
    assert choice_hint("x", []) == "available: none"


def test_a_finding_of_unknown_kind_keeps_pydantics_words() -> None:
    (fault,) = faults_of([{"type": "new", "loc": ("run", "seed"), "input": "x" * 100, "msg": "is odd"}])
    assert fault.what == f'= "{"x" * 59}... is odd'


TEXT = """# comment with x = 1
top = 1
[robot]   # [not] a = header
port = 7010
edge = [
  [1, 2],
]
[control.gain_sets."mine too"]
forward = { kp = 3.0 }
a.b = 1
"""

scalars = st.one_of(
    st.booleans(),
    st.integers(-(2**53), 2**53),
    st.floats(allow_nan=False),
    st.text(st.characters(exclude_categories=["Cs"]), max_size=20),
)
# 60 values fold over several lines
arrays = st.one_of(st.lists(scalars, max_size=3), st.lists(st.floats(allow_nan=False), max_size=60))
names = st.text(st.characters(exclude_categories=["Cs"]), max_size=8)
trees = st.recursive(
    st.dictionaries(names, st.one_of(scalars, arrays, st.lists(arrays, max_size=3)), max_size=4),
    lambda inner: st.dictionaries(names, st.one_of(scalars, inner), max_size=4),
    max_leaves=8,
)


@given(trees)
def test_what_is_written_reads_back_equal(tree: dict[str, object]) -> None:
    assert tomllib.loads(format_toml(tree)) == tree


@given(st.floats(allow_nan=False))
def test_floats_keep_every_bit(value: float) -> None:
    back = tomllib.loads(f"v = {format_value(value)}")["v"]
    assert math.copysign(1.0, back) == math.copysign(1.0, value)
    assert back == value


@pytest.mark.parametrize(
    ("key", "line"),
    [
        (("top",), 2),
        (("robot",), 3),
        (("robot", "port"), 4),
        (("robot", "edge", 0, 1), 5),
        (("robot", "missing"), 3),
        (("control",), 8),
        (("control", "gain_sets", "mine too", "forward", "kp"), 9),
        (("control", "gain_sets", "mine too", "a", "b"), 10),
        (("x",), None),
        ((), None),
    ],
)
def test_a_key_is_found_at_its_line(key: tuple[str | int, ...], line: int | None) -> None:
    assert find_line(TEXT, key) == line


def test_keys_read_as_in_the_code() -> None:
    assert format_key(("robot", "edge_sensors_m", 0, 1)) == "robot.edge_sensors_m[0][1]"


def test_inline_tables_are_written() -> None:
    value = {"a": 1, "b c": [True, "x"]}
    assert tomllib.loads(f"v = {format_value(value)}")["v"] == value


TEXT_CONFIG_EDIT = """# head

[run]  # what
seed = 3      # three
[robot]
port = 7010
edge_sensors_m = [[1, 2],   # left
                  [3, 4]]
"""


def test_only_the_value_changes() -> None:
    after = with_values(TEXT_CONFIG_EDIT, {"run.seed": 4.5}, Path("x.toml"))
    assert after == TEXT_CONFIG_EDIT.replace("seed = 3      # three", "seed = 4.5      # three")


def test_what_is_measured_is_unverified_no_more() -> None:
    text = "[robot]\na_m = 0.03  # UNVERIFIED; 1 % wrong\nb_m = 0.1  # UNVERIFIED\n"
    after = with_values(text, {"robot.a_m": 0.031}, Path("x.toml"))
    assert after == text.replace("0.03  # UNVERIFIED", "0.031  # measured by ccatp calibrate")


def test_new_keys_and_sections_are_added() -> None:
    after = with_values(TEXT_CONFIG_EDIT, {"robot.wheel_base_m": 0.151, "a.b": 1.0}, Path("x.toml"))
    assert after == TEXT_CONFIG_EDIT + "wheel_base_m = 0.151\n\n[a]\nb = 1.0\n"
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
