"""The synchronous client of a daemon that does not answer."""

import fcntl
import threading
from pathlib import Path

import pytest
import zmq

from ccatp.errors import DaemonUnreachableError
from ccatp.links.client import OperatorClient
from ccatp.links.runtime_dir import LOCK_FILE


def test_a_command_to_a_run_that_ends_meanwhile_does_not_wait_for_its_deadline(runtime_dir: Path) -> None:
    with (runtime_dir / LOCK_FILE).open("w") as lock, zmq.Context() as context, context.socket(zmq.ROUTER) as server:
        fcntl.flock(lock, fcntl.LOCK_EX)
        server.bind(f"ipc://{runtime_dir / 'control'}")

        def end() -> None:
            server.poll()  # the request has come: it gets no answer
            fcntl.flock(lock, fcntl.LOCK_UN)

        daemon = threading.Thread(target=end)
        daemon.start()
        # At its deadline it would say that no answer came.
        with pytest.raises(DaemonUnreachableError, match="ccatp ended before it answered"):
            OperatorClient(runtime_dir).status()
        daemon.join()
