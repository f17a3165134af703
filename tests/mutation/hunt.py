"""``python -m tests.mutation.hunt MODULE TEST...``: mutants of a module that the tests do not notice, as JSON.

Everything runs in this process: a mutant's code is put into the loaded module, the tests run until the first that
fails. Tests named after ``--then`` run only for mutants that the others let live.
"""

import contextlib
import io
import json
import signal
import sys
from types import FrameType

import pytest

from tests.mutation.mutator import Mutant, applied, module_of, mutants

PATIENCE_S = 120.0  # a mutant that runs longer hangs, which is noticed
ARGUMENTS = ["-x", "-q", "-p", "no:cacheprovider", "--noconftest", "--no-header", "--no-summary"]


class _HangsError(BaseException):
    """The tests take too long."""


def _hang(_: int, __: FrameType | None) -> None:
    raise _HangsError


def passes(tests: list[str]) -> bool:
    """Whether the tests pass."""
    signal.signal(signal.SIGALRM, _hang)
    signal.setitimer(signal.ITIMER_REAL, PATIENCE_S)
    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            return pytest.main([*ARGUMENTS, *tests]) == pytest.ExitCode.OK
    except _HangsError:
        return False
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)


def hunt(name: str, tests: list[str], then: list[str], part: int, parts: int) -> tuple[int, list[Mutant]]:
    """How many mutants there are in a part of them, and those that live."""
    module, path = module_of(name)
    assert passes(tests), f"the tests of {name} fail without a mutant"
    alive: list[Mutant] = []
    count = 0
    for k, mutant in enumerate(mutants(path)):
        if k % parts != part:
            continue
        with applied(module, mutant) as is_changed:
            if not is_changed:
                continue
            count += 1
            if passes(tests) and (not then or passes(then)):
                alive.append(mutant)
                print(f"alive: {path.name}:{mutant.line}: {mutant.what}: {mutant.text}", file=sys.stderr, flush=True)
    return count, alive


def main(arguments: list[str]) -> None:
    """Print how many mutants there are, and those that live."""
    share, name, *tests = arguments
    then = []
    if "--then" in tests:
        at = tests.index("--then")
        tests, then = tests[:at], tests[at + 1 :]
    part, parts = map(int, share.split("/"))
    count, alive = hunt(name, tests, then, part, parts)
    print(json.dumps({"mutants": count, "alive": [(m.line, m.text, m.what) for m in alive]}))


if __name__ == "__main__":
    main(sys.argv[1:])
