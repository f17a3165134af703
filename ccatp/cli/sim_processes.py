"""The stand-ins of robot and laser system beside a command that needs somebody to talk to."""

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from ccatp.config.load import dump_config
from ccatp.config.models import Config
from ccatp.config.package import child_environment
from ccatp.daemon.child_processes import ENVIRONMENT, listen, simulator_addresses, with_addresses
from ccatp.daemon.process import SUPERVISOR_PID
from ccatp.daemon.supervisor import PROCESSES

STOP_TIMEOUT_S = 5.0


@contextmanager
def stand_ins(cfg: Config) -> Iterator[Config]:
    """Start them, on any free ports and by the wall clock; stop them at the end.

    Yields:
        The configuration with their addresses.

    Raises:
        ConfigError: they cannot listen.
    """
    processes = [process for process in PROCESSES if process.is_simulator]
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="ccatp-")))
        any_port = {part: getattr(cfg.sim, part).model_copy(update={"port": 0}) for part in ("robot", "etalon")}
        cfg = cfg.model_copy(update={"sim": cfg.sim.model_copy(update=any_port)})
        places = simulator_addresses(cfg)
        sockets = {p.name: stack.enter_context(listen(p.listens, *places[p.listens])) for p in processes}
        cfg = with_addresses(cfg, sockets)
        (folder / "config.toml").write_text(dump_config(cfg), encoding="utf-8")
        for process in processes:
            fd = sockets[process.name].fileno()
            command = [sys.executable, "-m", process.module, "--run-dir", str(folder), "--runtime-dir", str(folder)]
            child = subprocess.Popen(
                [*command, "--realtime", "--listen-fd", str(fd)],
                stdin=subprocess.DEVNULL,
                stdout=sys.stderr,
                pass_fds=(fd,),
                env={**child_environment(os.environ), **ENVIRONMENT, SUPERVISOR_PID: str(os.getpid())},
            )
            stack.callback(_end, child)
        yield cfg


def _end(child: "subprocess.Popen[bytes]") -> None:
    child.terminate()
    try:
        child.wait(STOP_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        child.kill()
        child.wait()
