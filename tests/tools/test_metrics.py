"""The figures of ``make metrics``, on a package whose figures are counted by hand."""

import sys
from pathlib import Path

import pytest

from tools.metrics.frame_profile import measure, profile
from tools.metrics.sizes import (
    duplicate_classes,
    largest_classes,
    moving_sources,
    read_sources,
    single_importer_modules,
)

A = '''"""Docstring."""

import os  # a comment beside code

from p import b
from p.c import X


class Same:
    """Two
    lines."""

    size: int = 1
    """Of an attribute."""

    def one(self) -> str:
        # a comment
        return """a string
        over two lines"""
'''
B = "from p.c import X\n\n\nclass Same:\n    pass\n\n\nasync def two() -> None:\n    pass\n"


def test_lines_names_and_imports_are_counted(tmp_path: Path) -> None:
    folder = tmp_path / "p"
    folder.mkdir()
    for name, text in (("__init__", ""), ("a", A), ("b", B), ("c", "X = 1\n")):
        (folder / f"{name}.py").write_text(text)
    sources = {one.module: one for one in read_sources(tmp_path, "p")}
    assert list(sources) == ["p", "p.a", "p.b", "p.c"]
    a = sources["p.a"]
    assert (a.lines, a.code_lines, a.docstring_lines, a.functions) == (19, 8, 4, 1)
    assert sum(one.functions for one in sources.values()) == 2
    assert duplicate_classes(sources.values()) == ["Same"]
    assert single_importer_modules(sources.values()) == ["p", "p.b"]  # p.c has two importers, p.a has none


LOOP = """from ccatp.a import f


class Loop:
    def __init__(self, cfg):
        self.one = self.two = cfg
        self.two, self.three = 1, 2
        other.four = isinstance(cfg, RobotConfig | models.Config), isinstance(cfg, int)

    def f(self) -> tuple[int, int, int]: ...

    def g(self) -> tuple[int, int]: ...

    def h(self) -> tuple[int, ...]: ...
"""


def test_what_can_move_the_robot_checks_of_configurations_tuples_and_attributes_are_counted(tmp_path: Path) -> None:
    files = {
        "__init__": "", "daemon/__init__": "", "daemon/loops/__init__": "", "daemon/loops/main_loop": LOOP,
        "a": "import ccatp.b\n", "b": "", "c": "import ccatp.a\n", "survey/__init__": "",
        "survey/kind": 'K = Kind(runner=Part("ccatp.survey.run:go"), page=Part("ccatp.c:go"))\n',
        "survey/run": "from ccatp.beacons import x\n", "beacons/__init__": "", "beacons/x": "",
    }  # fmt: skip
    for name, text in files.items():
        path = tmp_path / "ccatp" / f"{name}.py"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    sources = read_sources(tmp_path, "ccatp")
    names = ["", ".a", ".b", ".daemon", ".daemon.loops", ".daemon.loops.main_loop", ".survey", ".survey.run"]
    assert [one.module for one in moving_sources(sources)] == [f"ccatp{name}" for name in names]
    assert (sum(one.config_checks for one in sources), sum(one.bare_tuples for one in sources)) == (1, 1)
    assert largest_classes(sources, 3) == [("ccatp.daemon.loops.main_loop.Loop", 3)]


ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_the_calls_of_a_frame_are_counted_in_the_main_loop() -> None:
    counted = measure(ROOT, Path(sys.executable))
    assert 10 < counted.files < counted.calls <= counted.all_calls
    assert counted.files <= counted.all_files


@pytest.mark.slow
def test_each_process_of_a_run_is_sampled() -> None:
    names = {one.name: one.rows.total() for one in profile(ROOT, 1)}
    assert {"daemon.loops.main_loop", "daemon.loops.danger_loop"} <= names.keys()
    assert all(us > 0.0 for us in names.values())
