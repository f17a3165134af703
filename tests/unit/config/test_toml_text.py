"""TOML as text."""

import math
import tomllib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ccatp.config.messages import find_line, format_key, format_toml, format_value

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
