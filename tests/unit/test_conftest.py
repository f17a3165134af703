"""The fixtures that fail a test for what it leaves behind do so, and let the others alone."""

from pathlib import Path

import pytest

pytest_plugins = ["pytester"]

CONFTEST = Path(__file__).parents[1] / "conftest.py"


def run(pytester: pytest.Pytester, test: str) -> pytest.RunResult:
    pytester.makeconftest(CONFTEST.read_text(encoding="utf-8").replace("GRACE_S = 2.0", "GRACE_S = 0.1"))
    pytester.makepyfile(f"import asyncio, os, subprocess, sys\nkept = []\n{test}")
    settings = ["asyncio_mode=auto", "asyncio_default_fixture_loop_scope=function"]
    return pytester.runpytest_inprocess("-p", "no:cacheprovider", *(word for text in settings for word in ("-o", text)))


def test_a_leaked_task_fails_its_test(pytester: pytest.Pytester) -> None:
    result = run(pytester, "async def test_it():\n    kept.append(asyncio.create_task(asyncio.sleep(60)))\n")
    result.assert_outcomes(passed=1, errors=1)
    result.stdout.fnmatch_lines(["*asyncio tasks left behind: *sleep*"])


def test_a_leaked_child_fails_its_test(pytester: pytest.Pytester) -> None:
    command = "[sys.executable, '-c', 'import time; time.sleep(60)']"
    result = run(pytester, f"def test_it():\n    os.posix_spawn(sys.executable, {command}, os.environ)\n")
    result.assert_outcomes(passed=1, errors=1)
    result.stdout.fnmatch_lines(["*child processes left behind: *time.sleep(60)*"])


def test_tasks_and_children_that_end_are_no_leak(pytester: pytest.Pytester) -> None:
    test = (
        "async def test_task():\n    await asyncio.create_task(asyncio.sleep(0))\n"
        "async def test_cancelled():\n    asyncio.create_task(asyncio.sleep(60)).cancel()\n"
        "def test_child():\n    assert subprocess.run([sys.executable, '-c', '']).returncode == 0\n"
    )
    run(pytester, test).assert_outcomes(passed=3)
