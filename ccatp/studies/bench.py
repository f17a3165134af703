"""Benchmarks: each case of a table timed alternately with its peers, timed missions, and the result as text."""

import gc
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ccatp.config.models import Config
from ccatp.core import FloatArray
from ccatp.report.html import render
from ccatp.studies.bench_cases import STEPS, Contender, races
from ccatp.studies.bench_frame import BenchError, frame_cases
from ccatp.studies.machine import machine, machine_line

EQUAL_WITHIN = 1e-10  # every entry of mean and covariance, SI units
ROUNDS, QUICK_ROUNDS = 40, 4
MOST_DENSE_ROUNDS = 10
FRAMES_OF_RESULT = ("mission in process", "lockstep")


def run_bench(
    cfg: Config, *, quick: bool, run_args: Sequence[str] = (), frames: bool = True, steps: bool = True
) -> dict[str, Any]:
    """Run all benchmarks; ``quick``: with a tenth of the rounds, and missions of one panel.

    ``run_args``: further arguments of ``ccatp run`` for this configuration. Raises BenchError: results differ, or a
    mission failed.
    """
    # Missions first, while this process has allocated little memory.
    of_frames = frame_cases(cfg, run_args, quick=quick) if frames else []
    of_steps = step_cases(cfg, QUICK_ROUNDS if quick else ROUNDS) if steps else ()
    return {"machine": machine(), "equal_within": EQUAL_WITHIN, "cases": [*of_steps, *of_frames]}


def step_cases(cfg: Config, rounds: int) -> Iterator[dict[str, Any]]:
    """Results of every race against each of its peers."""
    for name, ours, peers, is_dense, note in races(cfg):
        most = min(rounds, MOST_DENSE_ROUNDS) if is_dense else rounds
        for peer_name, peer in peers.items():
            try:
                yield step_case(name, ours, peer_name, peer, most)
            except ImportError:
                why = f"{peer_name} is not installed: pip install 'ccatp[peers]'"
                yield {**step_case(name, ours, "", None, rounds), "note": why}
        if not peers:
            yield {**step_case(name, ours, "", None, rounds), "note": note}


def step_case(name: str, ours: Contender, peer_name: str, peer: Contender | None, rounds: int) -> dict[str, Any]:
    """Result of one race. Raises BenchError: the results differ, so the times cannot be compared."""
    found: dict[str, Any] = {"name": name}
    if peer is not None:
        difference = largest_difference(ours, peer)
        if not difference <= EQUAL_WITHIN:
            raise BenchError(
                f"{name}: results differ from those of {peer_name} by {difference:.2g}, more than {EQUAL_WITHIN:g}: "
                "times of different computations cannot be compared"
            )
        found["largest_difference"] = difference
    times_us = [np.percentile(taken, (50, 99)).tolist() for taken in race(ours, peer, rounds)]
    p50, p99 = times_us[0]
    found |= {"us_p50": p50, "us_p99": p99, "peer": None, "peer_us_p50": None, "peer_us_p99": None, "ratio": None}
    if peer is not None:
        peer_p50, peer_p99 = times_us[1]
        found |= {"peer": peer_name, "peer_us_p50": peer_p50, "peer_us_p99": peer_p99, "ratio": p50 / peer_p50}
    return found


def race(ours: Contender, peer: Contender | None, rounds: int) -> FloatArray:
    """Time every step of both contenders, in alternate rounds; they also alternate in who begins a round.

    So a machine that slows down slows both, and neither always runs on caches that the other one has filled. One
    additional round warms up. Returns elapsed times of single steps of ours and of the peer, if any, us, shape
    (1 or 2, rounds, STEPS).
    """
    both = [ours] if peer is None else [ours, peer]
    taken = np.zeros((len(both), rounds, STEPS))
    collecting = gc.isenabled()
    gc.disable()
    try:
        for turn in range(-1, rounds):
            for which in range(len(both)) if turn % 2 else reversed(range(len(both))):
                solution = both[which]()
                next(solution)
                for i in range(STEPS):
                    start_ns = time.perf_counter_ns()
                    next(solution)
                    spent_ns = time.perf_counter_ns() - start_ns
                    if turn >= 0:
                        taken[which, turn, i] = 1e-3 * spent_ns
            gc.collect(1)
    finally:
        if collecting:
            gc.enable()
    return taken


def largest_difference(ours: Contender, peer: Contender) -> float:
    """Largest difference of any entry of the two results after any step, SI units; NaN if the peer's is not finite."""
    solutions = ours(), peer()
    readers = [next(solution) for solution in solutions]
    largest = 0.0
    for _ in range(STEPS):
        results = [read(next(solution)) for read, solution in zip(readers, solutions, strict=True)]
        for one, other in zip(*results, strict=True):
            found, expected = (np.asarray(result, dtype=np.float64).ravel() for result in (one, other))
            largest = max(largest, float(np.abs(found - expected).max()))
            if not np.isfinite(expected).all():
                return float("nan")
    return largest


BY_HAND = "<!-- by hand -->\n"


def write_page(path: Path, result: Mapping[str, Any]) -> None:
    """Write the page; text after ``BY_HAND`` in an existing page is kept."""
    before = path.read_text(encoding="utf-8") if path.exists() else ""
    _, mark, by_hand = before.partition(BY_HAND)
    path.write_text(tables(result, is_page=True) + (f"\n{mark}{by_hand}" if mark else ""), encoding="utf-8")


def tables(result: Mapping[str, Any], *, is_page: bool = False) -> str:
    """Machine, Markdown tables of the cases, and each note once: for the terminal and for ``bench --markdown``."""
    cases = result["cases"]
    frames, steps = ([case for case in cases if ("us_spread" in case) is is_frame] for is_frame in (True, False))
    notes = dict.fromkeys(case["note"] for case in cases if "note" in case)
    machine_text = machine_line(result["machine"])
    result_text = result_lines(frames, steps) if is_page else ""
    return render(
        "bench.md", machine=machine_text, result=result_text, frames=frames, steps=steps, notes=notes, is_page=is_page
    )


def result_lines(frames: Sequence[Mapping[str, Any]], steps: Sequence[Mapping[str, Any]]) -> str:
    """The result with which the page begins: a frame in process and in lockstep, and the ratios of each peer."""
    lines = []
    for kind in FRAMES_OF_RESULT:
        case = next((case for case in frames if case["name"].startswith(kind)), None)
        if case is not None:
            ratio = f"{case['ratio']:.2f} times the time of {case['peer']}"
            lines.append(f"A frame takes {case['us_p50']:.0f} µs ({case['name']}), {ratio}.")
    ratios: dict[str, list[float]] = {}
    for case in steps:
        if case["ratio"] is not None:
            ratios.setdefault(case["peer"], []).append(case["ratio"])
    if ratios:
        spans = (f"{peer} {_span(values)}" for peer, values in ratios.items())
        lines.append(f"Time of a step divided by that of the peer: {', '.join(spans)}.")
    return "\n".join(lines)


def _span(values: Sequence[float]) -> str:
    return " to ".join(dict.fromkeys(f"{value:.2f}" for value in (min(values), max(values))))
