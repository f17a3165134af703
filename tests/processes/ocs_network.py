"""An observatory control system on this machine: a crossbar router and our agent, each a process of its own."""

import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ccatp.config.package import child_environment

REALM, ROOT, INSTANCE = "test_realm", "observatory", "ccatp"


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
    return port


def _router(folder: Path, port: int) -> None:
    allow = {"call": True, "register": True, "publish": True, "subscribe": True}
    role = {"name": "anonymous", "permissions": [{"uri": "", "match": "prefix", "allow": allow, "cache": True}]}
    endpoint = {"type": "tcp", "interface": "127.0.0.1", "port": port}
    paths = {
        "ws": {"type": "websocket", "serializers": ["cbor", "msgpack", "json"]},
        "call": {"type": "caller", "realm": REALM, "role": "anonymous"},
    }
    worker = {
        "type": "router",
        "realms": [{"name": REALM, "roles": [role]}],
        "transports": [{"type": "web", "endpoint": endpoint, "paths": paths}],
    }
    (folder / "config.json").write_text(json.dumps({"version": 2, "controller": {}, "workers": [worker]}))


def _sites(folder: Path, port: int) -> Path:
    """JSON is YAML."""
    hub = {
        "wamp_server": f"ws://127.0.0.1:{port}/ws", "wamp_http": f"http://127.0.0.1:{port}/call",
        "wamp_realm": REALM, "address_root": ROOT, "registry_address": f"{ROOT}.registry",
    }  # fmt: skip
    host = {"agent-instances": [{"agent-class": "CcatpAgent", "instance-id": INSTANCE, "arguments": []}]}
    path = folder / "sites.yaml"
    path.write_text(json.dumps({"hub": hub, "hosts": {"localhost": host}}))
    return path


def _wait_for_port(port: int, process: "subprocess.Popen[bytes]", timeout_s: float = 60.0) -> None:
    deadline_s = time.monotonic() + timeout_s
    while time.monotonic() < deadline_s:
        assert process.poll() is None, "the crossbar router ended early"
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return
        time.sleep(0.1)
    raise AssertionError(f"nobody listens on port {port}")


@contextmanager
def network(crossbar: str, folder: Path, *arguments: str) -> Iterator[list[str]]:
    """A router and the agent with these options; yields the options of an OCS client."""
    port = free_port()
    (folder / "cb").mkdir()
    _router(folder / "cb", port)
    sites = _sites(folder, port)
    with (folder / "crossbar.log").open("wb") as log, (folder / "agent.log").open("wb") as agent_log:
        environment = {**os.environ, "CROSSBAR_DISABLE_VERSION_CHECK": "1"}
        environment.pop("PYTHONPATH", None)  # it has an environment of its own
        router = subprocess.Popen(
            [crossbar, "start", "--cbdir", str(folder / "cb")], stdout=log, stderr=log, env=environment
        )
        try:
            _wait_for_port(port, router)
            options = ["--site-file", str(sites), "--site-host", "localhost"]
            agent = subprocess.Popen(
                [sys.executable, "-m", "ccatp.daemon.ocs_agent", *options, "--instance-id", INSTANCE, *arguments],
                stdout=agent_log, stderr=agent_log, cwd=folder, env=child_environment(os.environ),
            )  # fmt: skip
            try:
                yield options
            finally:
                _end(agent)
        finally:
            _end(router)


def _end(process: "subprocess.Popen[bytes]") -> None:
    process.terminate()
    try:
        process.wait(20.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
