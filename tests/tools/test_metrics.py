"""The figures of ``make metrics``, on a package whose figures are counted by hand."""

import sys
from pathlib import Path

import pytest

from tools.metrics.frame_profile import measure, profile
from tools.metrics.sizes import duplicate_classes, read_sources, single_importer_modules

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
