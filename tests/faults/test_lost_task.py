"""A task of a loop that ends by an exception ends its process, loudly, and nothing drives the robot any more."""

import asyncio
from collections.abc import Callable
from typing import Any
from unittest.mock import patch

import pytest

from tests.faults.daemon_rig import configuration, running_daemon
from tests.faults.linking import Measured

# Every task that the two loops serve, by the method that it runs.
TASKS = (
    "ccatp.daemon.main_loop.MainLoop._publish_levels",
    "ccatp.daemon.main_loop.MainLoop._watch",
    "ccatp.daemon.fix_service.FixService.run",
    "ccatp.daemon.robot_session.ReconnectingRobotLink.serve",
    "ccatp.links.rpc.Router.serve",
    "ccatp.daemon.danger_loop.DangerLoop._publish_heartbeat",
    "ccatp.daemon.danger_loop.DangerLoop._watch",
    "ccatp.daemon.command_handlers.ObservatoryServer.serve",
)


class Broken(Exception):
    """What nobody foresaw."""


def names(error: BaseException) -> list[str]:
    """The leaves of nested groups of exceptions."""
    if isinstance(error, BaseExceptionGroup):
        return [name for part in error.exceptions for name in names(part)]
    return [type(error).__name__]


async def breaks(*_: object, **__: object) -> None:
    await asyncio.sleep(0.05)
    raise Broken


@pytest.mark.fault("P9")
@pytest.mark.parametrize("task", TASKS)
async def test_a_task_that_breaks_ends_its_loop_by_that_exception(task: str, measured: Measured) -> None:
    unheard = list[dict[str, Any]]()
    asyncio.get_running_loop().set_exception_handler(lambda _, context: unheard.append(context))
    found = list[str]()
    with patch(task, breaks):
        try:
            async with running_daemon(configuration()) as daemon:
                await asyncio.wait(daemon.loops, return_when=asyncio.FIRST_COMPLETED)
        except BaseExceptionGroup as error:
            found = names(error)
    assert "Broken" in found
    measured("P9", len(unheard))


@pytest.mark.fault("P9")
def test_the_tasks_are_those_that_the_loops_serve(method_names: Callable[[], set[str]]) -> None:
    assert {task.rsplit(".", 1)[1] for task in TASKS} == method_names()


@pytest.fixture
def method_names() -> Callable[[], set[str]]:
    """The coroutines in the ``services`` of both loops, read from their source."""
    import ast
    import inspect
    import textwrap

    from ccatp.daemon.danger_loop import DangerLoop
    from ccatp.daemon.main_loop import MainLoop

    def read() -> set[str]:
        found = set[str]()
        for loop in (MainLoop, DangerLoop):
            tree = ast.parse(textwrap.dedent(inspect.getsource(loop.run)))
            for node in ast.walk(tree):
                if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "services":
                    assert isinstance(node.value, ast.Tuple)
                    found |= {
                        call.func.attr
                        for call in node.value.elts
                        if isinstance(call, ast.Call) and isinstance(call.func, ast.Attribute)
                    }
        return found

    return read
