"""The command as its users start it."""

import json
import os
import subprocess
import sys

HEAVY = ("pydantic", "numpy", "scipy", "zmq", "rich", "structlog", "mcap", "msgspec", "matplotlib", "asyncio")


def test_help_imports_nothing_heavy() -> None:
    # what is imported, not how long it takes: this is what keeps help and completion quick, on any machine
    code = f"""
import click, json, sys
from ccatp.cli import cli, main
def paths(group, path=()):
    yield path
    for name, command in group.commands.items():
        yield from paths(command, (*path, name)) if isinstance(command, click.Group) else [(*path, name)]
status = max(main([*path, "--help"]) for path in paths(cli))
print(json.dumps([status, [name for name in {HEAVY!r} if name in sys.modules]]))
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert json.loads(result.stdout.splitlines()[-1]) == [0, []]
    assert not result.stderr


def test_a_closed_pipe_is_no_traceback() -> None:
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "ccatp", "config", "schema"]
    with os.fdopen(writer, "wb") as nobody:
        result = subprocess.run(command, stdout=nobody, stderr=subprocess.PIPE, timeout=60, check=False)
    assert result.returncode == 1
    assert result.stderr == b""
