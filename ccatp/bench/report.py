"""The result of the benchmarks as text: a Markdown page, lines for a terminal."""

from collections.abc import Mapping, Sequence
from typing import Any

from ccatp.bench.exact import DIGITS

_STEP_HEAD = (
    "case",
    "ours p50, µs",
    "ours p99, µs",
    "peer",
    "peer p50, µs",
    "ratio",
    "difference",
    "our error",
    "peer's error",
)
_MISSION_HEAD = ("case", "times real time", "simulated, s", "wall, s")


def markdown(result: Mapping[str, Any]) -> str:
    """The page ``docs/bench.md``."""
    steps = [case for case in result["cases"] if "times_real_time" not in case]
    missions = [case for case in result["cases"] if "times_real_time" in case]
    lines = [
        "# Benchmarks",
        "",
        "Written by",
        "",
        "```",
        "OPENBLAS_NUM_THREADS=1 ccatp bench --markdown",
        "```",
        "",
        "on a machine that does nothing else. A filter step is a prediction and an update, called from Python, with",
        "all that it computes, nonlinear models included. Ours and the peer take turns step by step, and who begins by",
        "turns as well: each finds the caches as the other left them. Ratio = ours / peer: below 1 ours is faster.",
        "",
        "All compute the same, with the noise that the configuration ships. *Difference* is the largest one between",
        "any entry of the two means and covariances after any of the steps, in its own SI unit. *Error* is the same",
        f"against decimal arithmetic of {DIGITS} digits. A difference above {result['equal_within']:g} ends the run,",
        "unless ours is within that of the exact answer and the peer is not: forms with an inverse and (I - W H) P",
        "lose up to half their digits where a reading is far more exact than the state. There both are run again with",
        "readings a hundred times less exact, and have to agree.",
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
            error = f", ours {case['error']:.0e} from exact" if "error" in case else ""
            lines.append(
                f"{case['name']:<52} {case['us_p50']:8.1f} us {case['peer']:>28} {case['peer_us_p50']:8.1f} us"
                f"   ratio {case['ratio']:.3f}   difference {case['largest_difference']:.0e}{error}"
            )
    return lines


def machine_line(machine: Mapping[str, Any]) -> str:
    """The machine in one line."""
    packages = [f"{name} {machine[name]}" for name in ("numpy", "scipy", "filterpy", "stonesoup") if machine[name]]
    build = f"ccatp {machine['build']}"
    return ", ".join([machine["cpu"], f"{machine['cores']} cores", f"Python {machine['python']}", build, *packages])


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    return [f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *rows)]


def _step_row(case: Mapping[str, Any]) -> list[str]:
    numbers = [f"{case['us_p50']:.1f}", f"{case['us_p99']:.1f}"]
    if case["peer"] is None:
        return [case["name"], *numbers, *["-"] * 6]
    keys = ("largest_difference", "error", "peer_error")
    differences = [f"{case[key]:.0e}" if key in case else "-" for key in keys]
    return [case["name"], *numbers, case["peer"], f"{case['peer_us_p50']:.1f}", f"{case['ratio']:.3f}", *differences]


def _mission_row(case: Mapping[str, Any]) -> list[str]:
    times = [f"{case[key]:.1f}" for key in ("times_real_time", "mission_time_s", "wall_s")]
    return [case["name"], *times]
