"""``python -m tools.mutation [TARGET...]``: a mutant of ``baseline.json`` that was killed and lives now is an error.

``--write`` draws the sample of ``targets.toml`` and stores the baseline. ``--strict`` runs every mutant of the targets;
only those that ``equivalent.toml`` lists may live.
"""

import argparse
import contextlib
import functools
import gc
import io
import json
import math
import os
import resource
import signal
import sys
import threading
import time
import tomllib
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from types import FrameType, FunctionType
from typing import Any

import pytest

from tools.mutation import mutants as mt

SEED = "1"
ARGUMENTS = ["-q", "-n0", "-p", "no:cacheprovider", "--tb=no", "--capture=sys"]
# Costs more than most of the tests, and finds no mutant.
LEAK_CHECK = "nothing_leaks"
# Processor time for the tests of one mutant, the fastest first. A mutant that must die meets all of its tests.
BUDGET_S = 10.0


class Runner:
    """A pytest plugin: runs all tests once, notes what each calls, and runs for a mutant those that call it."""

    def __init__(self, files: set[str], work: "Callable[[Runner], None]") -> None:
        self._files, self._work = files, work
        self._has_failed = False
        self._running: pytest.Item | None = None
        self._cost_s: dict[pytest.Item, float] = {}
        self._callers: defaultdict[mt.Key, set[pytest.Item]] = defaultdict(set)
        self._functions: list[FunctionType] = []

    def pytest_sessionstart(self) -> None:
        from hypothesis import Phase, settings  # pytest must be the first to import it

        phases = (Phase.explicit, Phase.generate)  # no search for the smallest example
        settings.register_profile("mutation", derandomize=True, deadline=None, database=None, phases=phases)
        settings.load_profile("mutation")

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self._has_failed |= report.failed

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        for item in session.items:
            if LEAK_CHECK in (names := getattr(item, "fixturenames", [])):
                names.remove(LEAK_CHECK)
            self._running, began_s = item, time.process_time()
            threading.setprofile(self._note_call)
            sys.setprofile(self._note_call)
            is_sound = self._passes([item])
            sys.setprofile(None)
            threading.setprofile(None)
            assert is_sound, f"{item.nodeid} fails without a mutant"
            self._cost_s[item] = time.process_time() - began_s
        gc.unfreeze()  # a loop that ran in a test has frozen what there was, and hidden it
        self._functions = [one for one in gc.get_objects() if isinstance(one, FunctionType)]
        self._functions = [one for one in self._functions if one.__code__.co_filename in self._files]
        self._work(self)
        return True

    def _note_call(self, frame: FrameType, event: str, _: object) -> None:
        if event == "call" and frame.f_code.co_filename in self._files and self._running is not None:
            self._callers[mt.key_of(frame.f_code)].add(self._running)

    def _passes(self, items: list[pytest.Item]) -> bool:
        self._has_failed = False
        for item, following in zip(items, [*items[1:], None], strict=False):
            item.ihook.pytest_runtest_protocol(item=item, nextitem=following)
            if self._has_failed:
                return False
        return True

    def is_killed(self, mutant: mt.Mutant, budget_s: float) -> bool:
        """Whether a test fails with the mutant, or does not end. A mutant runs in a process of its own."""
        changed = mt.changed_functions(mutant, self._functions)
        users = [one for one, _ in changed] or mt.users_of(mutant, self._functions)
        tests = {item for one in users for item in self._callers[mt.key_of(one.__code__)]}
        chosen: list[pytest.Item] = []
        cost_s = 0.0
        for item in sorted(tests, key=self._cost_s.__getitem__):
            if not chosen or cost_s + self._cost_s[item] <= budget_s:
                chosen.append(item)
                cost_s += self._cost_s[item]
        if (pid := os.fork()) == 0:
            is_killed = True
            try:
                os.setsid()
                signal.signal(signal.SIGALRM, signal.SIG_DFL)
                signal.alarm(round(120 + 20 * cost_s))  # for tests that wait for ever; the machine may be busy
                resource.setrlimit(resource.RLIMIT_CPU, (round(5 + 5 * cost_s),) * 2)
                mt.apply(mutant, changed)
                is_killed = not self._passes(chosen)
            finally:
                os._exit(is_killed)
        _, status = os.waitpid(pid, 0)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(pid, signal.SIGKILL)
        return status != 0


note = functools.partial(print, file=sys.__stderr__, flush=True)


def judged(target: dict[str, Any], chosen: list[mt.Mutant], must_die: list[bool]) -> list[bool]:
    """Whether each of the mutants is killed."""
    killed: list[bool] = []

    def work(runner: Runner) -> None:
        for mutant, must in zip(chosen, must_die, strict=True):
            killed.append(runner.is_killed(mutant, BUDGET_S) or (must and runner.is_killed(mutant, math.inf)))
            if not killed[-1]:
                word = "LIVES AND MUST NOT" if must else "lives"
                note(f"{word}: {mutant.path.name}:{mutant.line}: {mutant.name.change}   in   {mutant.name.statement}")

    shown = io.StringIO()
    files = {str(path) for path in sources(target)}
    with contextlib.redirect_stdout(shown):
        status = pytest.main([*ARGUMENTS, *target["tests"]], plugins=[Runner(files, work)])
    if status != pytest.ExitCode.OK:
        sys.exit(f"{shown.getvalue()}\npytest: {status!r}")
    return killed


def sources(target: dict[str, Any]) -> list[Path]:
    paths = {pattern: sorted(Path.cwd().glob(pattern)) for pattern in target["modules"]}
    if missing := [pattern for pattern, found in paths.items() if not found]:
        sys.exit(f"targets.toml names modules that are not there: {missing}")
    return [path for found in paths.values() for path in found]


def write(target: dict[str, Any]) -> dict[str, Any]:
    """The target's entry of the baseline."""
    found = mt.mutants(sources(target))
    chosen = mt.sample(found, target["sample"], SEED)
    killed = judged(target, chosen, [False] * len(chosen))
    note(f"{len(found)} mutants; {sum(killed)} of {len(chosen)} killed")
    return {"mutants": len(found), "sample": [[*one.name, dead] for one, dead in zip(chosen, killed, strict=True)]}


def lost(target: dict[str, Any], before: dict[str, Any]) -> int:
    """How many mutants of the baseline were killed and live now."""
    was_killed = {mt.Name(*entry[:-1]).renamed(target["renames"]): entry[-1] for entry in before["sample"]}
    found = mt.mutants(sources(target))
    located = mt.locate(list(was_killed), found)
    for name in (name for name in was_killed if name not in located):
        note(f"not found: {name.owner}.{name.function}: {name.change}   in   {name.statement}")
    expected = [was_killed[name] for name in located]
    killed = judged(target, list(located.values()), expected)
    note(
        f"{before['mutants']} mutants before, {len(found)} now; {sum(was_killed.values())} of {len(was_killed)} killed "
        f"before; {len(located)} of them found: {sum(expected)} killed before, {sum(killed)} now"
    )
    return sum(was and not dead for was, dead in zip(expected, killed, strict=True))


def unlisted(target: dict[str, Any], listed: list[dict[str, str]]) -> int:
    """How many mutants of the target's ``strict`` classes live and are not listed as equivalent."""
    found = [one for one in mt.mutants(sources(target)) if one.name.owner in target["strict"]]
    equivalents = {(one["text"], one["what"]) for one in listed}
    must_die = [one.name.short() not in equivalents for one in found]
    killed = judged(target, found, must_die)
    note(f"{len(found)} mutants; {sum(killed)} killed, {must_die.count(False)} equivalent")
    return sum(must and not dead for must, dead in zip(must_die, killed, strict=True))


def save(baseline: dict[str, Any], path: Path) -> None:
    """One mutant a line."""
    parts = []
    for name, entry in sorted(baseline.items()):
        rows = ",\n".join(json.dumps(row) for row in entry["sample"])
        parts.append(f'{json.dumps(name)}: {{"mutants": {entry["mutants"]}, "sample": [\n{rows}\n]}}')
    path.write_text("{\n" + ",\n".join(parts) + "\n}\n")


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tools.mutation")
    parser.add_argument("--write", action="store_true")
    parser.add_argument("--strict", action="store_true")
    parser.add_argument("--tables", type=Path, default=Path(__file__).parent)
    parser.add_argument("targets", nargs="*")
    options = parser.parse_args()
    tables: Path = options.tables
    targets = tomllib.loads((tables / "targets.toml").read_text())
    path = tables / "baseline.json"
    baseline = json.loads(path.read_text()) if path.exists() else {}
    bad = 0
    for name in options.targets or (targets if options.write or options.strict else baseline):
        note(f"== {name}")
        target = targets[name]
        if options.strict:
            bad += unlisted(target, tomllib.loads((tables / "equivalent.toml").read_text())["mutant"])
        elif options.write:
            baseline[name] = write(target)
            save(baseline, path)
        else:
            bad += lost(target, baseline[name])
    sys.exit(bool(bad))


if __name__ == "__main__":
    main()
