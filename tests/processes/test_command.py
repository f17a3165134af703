"""The command as its users start it."""

import json
import subprocess
import sys

HEAVY = ("pydantic", "numpy", "scipy", "zmq", "rich", "structlog", "mcap", "msgspec", "matplotlib", "asyncio")


def test_help_imports_nothing_heavy() -> None:
    # what is imported, not how long it takes: this is what keeps help and completion quick, on any machine
    code = (
        "import json, sys\nfrom ccatp.cli import main\nstatus = main(['--help'])\n"
        f"print(json.dumps([status, [name for name in {HEAVY!r} if name in sys.modules]]))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert json.loads(result.stdout.splitlines()[-1]) == [0, []]
    assert not result.stderr


def test_a_closed_pipe_is_no_traceback() -> None:
    # the schema is longer than a pipe holds, and its reader leaves after the first byte
    with subprocess.Popen(
        [sys.executable, "-m", "ccatp", "config", "schema"], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.read(1)
        process.stdout.close()
        assert process.wait(60) == 1
        assert process.stderr.read() == b""
