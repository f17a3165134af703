"""``make metrics``: the size of the code base, and the calls of one frame of the main loop.

``python -m tools.metrics [--root PATH ...] [--no-frame] [--names]`` prints one column per checkout, so that two
versions can be compared. A checkout uses its own ``.venv`` where it has one. ``--names`` lists the files and classes
that are counted.
"""

import argparse
import sys
from pathlib import Path

from tools.metrics.frame_profile import MAIN_LOOP, MeasurementError, measure
from tools.metrics.sizes import (
    SMALL_FILE_LINES,
    duplicate_classes,
    largest_classes,
    moving_sources,
    read_sources,
    single_importer_modules,
)

_HERE = Path(__file__).resolve().parents[2]


def size_rows(root: Path) -> dict[str, int]:
    """The figures that follow from the source alone."""
    package, tests, tools = (read_sources(root, folder) for folder in ("ccatp", "tests", "tools"))
    moving = moving_sources(package)
    return {
        "ccatp: files": len(package),
        "ccatp: lines": sum(one.lines for one in package),
        "ccatp: code lines": sum(one.code_lines for one in package),
        "ccatp: docstring lines": sum(one.docstring_lines for one in package),
        "ccatp: classes": sum(len(one.classes) for one in package),
        "ccatp: functions": sum(one.functions for one in package),
        f"ccatp: files under {SMALL_FILE_LINES} code lines": sum(one.code_lines < SMALL_FILE_LINES for one in package),
        "ccatp: single-importer files": len(single_importer_modules(package)),
        "ccatp: duplicate class names": len(duplicate_classes(package)),
        "ccatp: isinstance of a configuration": sum(one.config_checks for one in package),
        "ccatp: bare tuples of three or more": sum(one.bare_tuples for one in package),
        "ccatp: attributes of the ten largest": sum(size for _, size in largest_classes(package, 10)),
        "can move the robot: files": len(moving),
        "can move the robot: lines": sum(one.lines for one in moving),
        "tests: files": len(tests),
        "tests: lines": sum(one.lines for one in tests),
        "tests: code lines": sum(one.code_lines for one in tests),
        "tools: files": len(tools),
        "tools: lines": sum(one.lines for one in tools),
    }


def frame_rows(root: Path, process: str) -> dict[str, int]:
    """The figures that a run gives."""
    own = root / ".venv" / "bin" / "python"
    median = measure(root, own if own.exists() else Path(sys.executable), process)
    return {
        "frame: calls": median.calls,
        "frame: files": median.files,
        "frame: calls until the next frame": median.all_calls,
        "frame: files until the next frame": median.all_files,
    }


def list_names(root: Path) -> None:
    """Print the files and classes that are counted because something is wrong with them."""
    package = read_sources(root, "ccatp")
    small = [f"{one.module} ({one.code_lines})" for one in package if one.code_lines < SMALL_FILE_LINES]
    for title, names in (
        (f"files under {SMALL_FILE_LINES} code lines", small),
        ("single-importer files", single_importer_modules(package)),
        ("duplicate class names", duplicate_classes(package)),
        ("largest classes, attributes", [f"{name} ({size})" for name, size in largest_classes(package, 10)]),
    ):
        print(f"\n{title}:", *names, sep="\n  ")


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m tools.metrics", description="Size of the code base.")
    parser.add_argument("--root", type=Path, action="append", help="checkout to be measured; may be repeated")
    parser.add_argument("--no-frame", action="store_true", help="source only, without the simulated survey")
    parser.add_argument("--names", action="store_true", help="list small and single-importer files and duplicate names")
    parser.add_argument("--process", default=MAIN_LOOP, help="command line of the main loop, a regular expression")
    options = parser.parse_args()
    roots: list[Path] = [root.resolve() for root in options.root or [_HERE]]
    try:
        columns = [size_rows(root) | ({} if options.no_frame else frame_rows(root, options.process)) for root in roots]
    except MeasurementError as error:
        print(f"metrics: {error}", file=sys.stderr)
        return 2
    if len(roots) > 1:
        print(*(f"{chr(ord('A') + k)}: {root}" for k, root in enumerate(roots)), sep="\n")
    for name in columns[0]:
        print(f"{name:40}", *(f"{column[name]:>9,}" for column in columns))
    if options.names:
        for root in roots:
            list_names(root)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
