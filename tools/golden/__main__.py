"""``make golden``: this tree against a base commit, both run on this machine in one sitting, bit for bit.

    make golden-quick                             a few cases, for each commit: about a minute, the base is run once
    make golden                                   all cases, before a series of commits is delivered
    make golden ARGS="--cases survey-fyst -j 2"   cases by a regular expression; --list shows them
    make golden ARGS="--reuse-base"               takes results of the base that this machine made before
    make golden ARGS="--base COMMIT"              another base; RADIO_DATA=DIR: where recorded radio data is

A rename is a row in renames.toml. After a commit that changes results on purpose, that commit becomes the base there.
What the cases left is kept in build/golden: streams of the robot link, run directories, outputs. The base and its
results are there too, or in GOLDEN_CACHE=DIR, which several working trees may share.
"""

import argparse
import os
import re
import sys
import time
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

from tools.golden.comparison import Difference, Renames, compare, observe
from tools.golden.runs import CASES, HERE, RESULTS, ROOT, Case, GoldenError, Runner, Side, base_side, locked, this_side

_DATA = ROOT.parent / "shared" / "data" / "radio"


def main() -> int:
    """Compare; the status is 0 where everything is equal, 1 where something differs, 2 where that is not known."""
    options = _options()
    wanted = [case for case in CASES if re.search(options.cases, case.name) and (case.is_quick or not options.quick)]
    if options.list:
        print(*(f"{case.name}{'  (quick)' if case.is_quick else ''}" for case in wanted), sep="\n")
        return 0
    data = options.data.resolve()
    cases = [case for case in wanted if data.is_dir() or not case.needs_data]
    for case in wanted:
        if case not in cases:
            print(f"skipped  {case.name}: no recorded radio data at {data}; name the folder with --data")
    if not cases:
        print("no case to run", file=sys.stderr)
        return 2
    renames = Renames.read(HERE / "renames.toml")
    runner = Runner(data, reuse_base=options.reuse_base)
    try:
        sides = base_side(options.cache.resolve(), options.base or renames.base), this_side(renames)
        differing, failed = _compare_all(cases, sides, runner, options.j)
    except GoldenError as error:
        print(f"golden: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    equal = len(cases) - differing - failed
    print(f"{equal} of {len(cases)} cases equal to {options.base or renames.base}, {differing} differ, {failed} failed")
    return 2 if failed else 1 if differing else 0


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tools.golden", description="Compare this tree with a base commit.")
    parser.add_argument("--quick", action="store_true", help="a few short cases")
    parser.add_argument("--cases", default="", metavar="REGEX", help="cases whose names match")
    parser.add_argument("--list", action="store_true", help="list the cases")
    parser.add_argument("--base", default="", metavar="COMMIT", help="compare with this commit")
    parser.add_argument("--reuse-base", action="store_true", help="take earlier results of the base on this machine")
    parser.add_argument("--data", type=Path, default=_DATA, metavar="DIR", help="recorded radio data")
    parser.add_argument("--cache", type=Path, default=RESULTS, metavar="DIR", help="where the base is kept")
    parser.add_argument("-j", type=int, default=max(1, (os.cpu_count() or 1) // 2), help="runs at a time")
    return parser.parse_args()


def _compare_all(cases: list[Case], sides: tuple[Side, Side], runner: Runner, jobs: int) -> tuple[int, int]:
    """Run both sides of each case, and show each result as it comes; how many differ, and how many failed."""
    differing = failed = 0
    with ThreadPoolExecutor(jobs) as pool:
        futures = {pool.submit(_compare_case, case, sides, runner): case for case in cases}
        try:
            for future in as_completed(futures):
                name = futures[future].name
                try:
                    times, differences = future.result()
                except GoldenError as error:
                    failed += 1
                    print(f"FAILED   {name}: {error}", flush=True)
                    continue
                differing += bool(differences)
                print(f"{'DIFFERS' if differences else 'equal':8} {name}  ({times})", flush=True)
                for difference in differences:
                    print("    " + str(difference).replace("\n", "\n    "), flush=True)
        except BaseException:
            runner.stop()
            pool.shutdown(cancel_futures=True)
            raise
    return differing, failed


def _compare_case(case: Case, sides: tuple[Side, Side], runner: Runner) -> tuple[str, list[Difference]]:
    """Times of both sides, and what differs; they follow each other, so that they run under the same conditions."""
    observations, times = [], []
    for side in sides:
        with locked(side.results / case.name):
            begun_s = time.monotonic()
            folder = runner.run(side, case)
            times.append(f"{side.name} {time.monotonic() - begun_s:.1f} s")
            observations.append(observe(folder, only_results=case.only_results))
        if not observations[0]:
            raise GoldenError(f"the base left nothing to compare in {folder}")
    base, new = observations
    return ", ".join(times), compare(base, new, sides[1].renames)


if __name__ == "__main__":
    raise SystemExit(main())
