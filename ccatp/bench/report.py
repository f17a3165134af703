"""Pure. The result of the benchmarks as text: a Markdown page, lines for a terminal."""

from collections.abc import Mapping, Sequence
from typing import Any

_STEP_HEAD = (
    "case",
    "ours p50, µs",
    "ours p99, µs",
    "peer",
    "peer p50, µs",
    "ratio",
    "difference",
    "rounding, sigmas",
)
_MISSION_HEAD = ("case", "times real time", "simulated, s", "wall, s")


def markdown(result: Mapping[str, Any]) -> str:
    """The page ``docs/bench.md``."""
    steps = [case for case in result["cases"] if "times_real_time" not in case]
    missions = [case for case in result["cases"] if "times_real_time" in case]
    lines = [
        "# Benchmarks",
        "",
        "Written by `ccatp bench --markdown`. Ours and the peer take turns, step by step; ratio = ours / peer: below 1",
        "ours is faster. All compute the same: with readings a hundred times less exact, where rounding counts for",
        f"nothing, every entry of mean and covariance agrees after every step within {result['equal_within']:g} (SI).",
        "The last column is the largest difference on the problem that is timed, in sigmas: what the forms with an",
        "inverse and a subtraction lose there by rounding.",
        "",
        f"Machine: {machine_line(result['machine'])}",
        "",
        *_table(_STEP_HEAD, [_step_row(case) for case in steps]),
    ]
    if missions:
        lines += ["", *_table(_MISSION_HEAD, [_mission_row(case) for case in missions])]
    notes = dict.fromkeys(case["note"] for case in result["cases"] if "note" in case)
    if notes:
        lines += ["", *(f"* {note}" for note in notes)]
    return "\n".join(lines) + "\n"


def terminal_lines(result: Mapping[str, Any]) -> list[str]:
    """One line for the machine and one for each case."""
    lines = [machine_line(result["machine"])]
    for case in result["cases"]:
        if "times_real_time" in case:
            lines.append(f"{case['name']:<52} {case['times_real_time']:8.1f} times real time")
        elif case["peer"] is None:
            lines.append(f"{case['name']:<52} {case['us_p50']:8.1f} us   {case['note']}")
        else:
            lines.append(
                f"{case['name']:<52} {case['us_p50']:8.1f} us {case['peer']:>28} {case['peer_us_p50']:8.1f} us"
                f"   ratio {case['ratio']:.3f}   equal within {case['largest_difference']:.0e}"
            )
    return lines


def machine_line(machine: Mapping[str, Any]) -> str:
    """The machine in one line."""
    packages = [f"{name} {machine[name]}" for name in ("numpy", "scipy", "filterpy", "stonesoup") if machine[name]]
    return ", ".join([machine["cpu"], f"{machine['cores']} cores", f"Python {machine['python']}", *packages])


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    return [f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *rows)]


def _step_row(case: Mapping[str, Any]) -> list[str]:
    numbers = [f"{case['us_p50']:.1f}", f"{case['us_p99']:.1f}"]
    if case["peer"] is None:
        return [case["name"], *numbers, *["-"] * 5]
    differences = [f"{case[key]:.0e}" for key in ("largest_difference", "rounding_sigmas")]
    return [case["name"], *numbers, case["peer"], f"{case['peer_us_p50']:.1f}", f"{case['ratio']:.3f}", *differences]


def _mission_row(case: Mapping[str, Any]) -> list[str]:
    times = [f"{case[key]:.1f}" for key in ("times_real_time", "mission_time_s", "wall_s")]
    return [case["name"], *times]
