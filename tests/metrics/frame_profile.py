"""``python -m tests.metrics.frame_profile [--panels N]``: where the CPU time of a lockstep frame goes, by process."""

import argparse
import json
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import NamedTuple

from tests.metrics.frame_calls import run_survey

_ROOT = Path(__file__).resolve().parents[2]
_HOOK = Path(__file__).with_name("profile_hook")
_FRAME_HZ = 100.0


class ProcessProfile(NamedTuple):
    """CPU time of a lockstep frame in one process, us: main thread by (function, innermost function), other threads."""

    name: str
    rows: Counter[tuple[str, str]]
    others_us: float


def profile(root: Path, panels: int) -> list[ProcessProfile]:
    """Run a survey of ``root``; the processes, those that use most first."""
    with tempfile.TemporaryDirectory(prefix="ccatp-profile-") as folder:
        arguments = "--json", "--panels", str(panels)
        out = run_survey(root, Path(sys.executable), _HOOK, {"CCATP_PROFILE": folder}, arguments)
        frames = json.loads(out)["mission_time_s"] * _FRAME_HZ
        found = [json.loads(path.read_text()) for path in Path(folder).glob("*.json")]
    profiles = [
        ProcessProfile(
            name.removeprefix("ccatp").lstrip(".") or "supervisor",
            Counter({(own, inner): 1e6 * time_s / frames for own, inner, time_s in rows}),
            1e6 * others_s / frames,
        )
        for name, others_s, rows in found
        if rows
    ]
    return sorted(profiles, key=lambda one: one.rows.total(), reverse=True)


def print_profile(one: ProcessProfile, shown: int, *, is_by_file: bool) -> None:
    """The functions or files that take most, with what libraries do for them."""
    print(f"\n{one.name}: {one.rows.total():.0f} us a frame, other threads {one.others_us:.0f} us")
    times_us: Counter[str] = Counter()
    for (own, inner), us in one.rows.items():
        times_us[own.partition(":")[0] if is_by_file else own if inner == own else f"{own} -> {inner}"] += us
    ranked = times_us.most_common()
    for name, us in ranked[:shown]:
        print(f"{us:8.1f}  {name}")
    print(f"{sum(us for _, us in ranked[shown:]):8.1f}  {len(ranked[shown:])} others")


def main() -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(prog="python -m tests.metrics.frame_profile", description=__doc__)
    parser.add_argument("--panels", type=int, default=4)
    parser.add_argument("--files", action="store_true", help="by file, not by function")
    parser.add_argument("--shown", type=int, default=12, help="rows of each process")
    options = parser.parse_args()
    for one in profile(_ROOT, options.panels):
        print_profile(one, options.shown, is_by_file=options.files)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
