"""The agent at a real crossbar router: from an OCS client a survey is started, its status polled, and aborted."""

import json
import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from ccatp.config.package import child_environment
from tests.support.runs import until

# Crossbar is no dependency of ours: name one with this variable, or have it in the path.
CROSSBAR = os.environ.get("CCATP_CROSSBAR") or shutil.which("crossbar")


REALM, ROOT, INSTANCE = "test_realm", "observatory", "ccatp"


def configure(folder: Path, port: int) -> None:
    """The files of a router at a port, and of a site with one agent; JSON is YAML."""
    allow = {"call": True, "register": True, "publish": True, "subscribe": True}
    role = {"name": "anonymous", "permissions": [{"uri": "", "match": "prefix", "allow": allow, "cache": True}]}
    web = {
        "type": "web",
        "endpoint": {"type": "tcp", "interface": "127.0.0.1", "port": port},
        "paths": {
            "ws": {"type": "websocket", "serializers": ["cbor", "msgpack", "json"]},
            "call": {"type": "caller", "realm": REALM, "role": "anonymous"},
        },
    }
    worker = {"type": "router", "realms": [{"name": REALM, "roles": [role]}], "transports": [web]}
    hub = {
        "wamp_server": f"ws://127.0.0.1:{port}/ws", "wamp_http": f"http://127.0.0.1:{port}/call",
        "wamp_realm": REALM, "address_root": ROOT, "registry_address": f"{ROOT}.registry",
    }  # fmt: skip
    host = {"agent-instances": [{"agent-class": "CcatpAgent", "instance-id": INSTANCE, "arguments": []}]}
    (folder / "cb").mkdir()
    (folder / "cb" / "config.json").write_text(json.dumps({"version": 2, "controller": {}, "workers": [worker]}))
    (folder / "sites.yaml").write_text(json.dumps({"hub": hub, "hosts": {"localhost": host}}))


@contextmanager
def started(log: Path, command: list[str], environment: dict[str, str]) -> Iterator["subprocess.Popen[bytes]"]:
    """A program whose output goes to a file; it is ended at the end."""
    with log.open("wb") as file:
        process = subprocess.Popen(command, stdout=file, stderr=file, cwd=log.parent, env=environment)
        try:
            yield process
        finally:
            process.terminate()
            try:
                process.wait(20.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


@contextmanager
def network(crossbar: str, folder: Path, port: int, *arguments: str) -> Iterator[list[str]]:
    """A router at a free port and the agent with these options; yields the options of an OCS client."""
    configure(folder, port)
    environment = {**os.environ, "CROSSBAR_DISABLE_VERSION_CHECK": "1"}
    environment.pop("PYTHONPATH", None)  # it has an environment of its own
    options = ["--site-file", str(folder / "sites.yaml"), "--site-host", "localhost"]
    agent = [sys.executable, "-m", "ccatp.daemon.operator.ocs_agent", *options, "--instance-id", INSTANCE, *arguments]

    def listens() -> bool:
        assert router.poll() is None, "the crossbar router ended early"
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", port)) == 0

    start = [crossbar, "start", "--cbdir", str(folder / "cb")]
    with started(folder / "crossbar.log", start, environment) as router:
        until(listens)
        with started(folder / "agent.log", agent, child_environment(os.environ)):
            yield options


def connect(options: list[str]) -> Any:
    from ocs.ocs_client import OCSClient

    try:
        return OCSClient(INSTANCE, args=options)
    except RuntimeError:  # the agent is not there yet
        return None


# A subscriber in a process of its own, because its libraries want the whole process.
SUBSCRIBER = """
import asyncio, json, sys
from autobahn.asyncio.wamp import ApplicationRunner, ApplicationSession
class Ear(ApplicationSession):
    async def onJoin(self, details):
        await self.subscribe(self.hear, sys.argv[3])
    def hear(self, message, *_):
        blocks = message[0] if isinstance(message, (list, tuple)) else message
        if "survey" in blocks:
            print(json.dumps(blocks["survey"]), flush=True)
            self.leave()
    def onDisconnect(self):
        asyncio.get_event_loop().stop()
ApplicationRunner(sys.argv[1], sys.argv[2]).run(Ear)
"""


def published(options: list[str]) -> dict[str, Any]:
    """The next block that somebody who listens to the feed gets."""
    hub = json.loads(Path(options[1]).read_text())["hub"]
    feed = f"{hub['address_root']}.{INSTANCE}.feeds.survey"
    command = [sys.executable, "-c", SUBSCRIBER, hub["wamp_server"], hub["wamp_realm"], feed]
    found: dict[str, Any] = json.loads(subprocess.check_output(command, timeout=30.0))
    return found


@pytest.mark.slow
@pytest.mark.filterwarnings("default")  # of OCS's own libraries
@pytest.mark.skipif(
    CROSSBAR is None, reason="no crossbar here: pip install crossbar elsewhere, name it in CCATP_CROSSBAR"
)
def test_survey_status_abort_from_an_ocs_client(tmp_path: Path, runtime_dir: Path, free_port: int) -> None:
    pytest.importorskip("ocs", reason="needs the extra ocs")
    assert CROSSBAR is not None
    config = tmp_path / "sim.toml"
    config.write_text(
        "[sim.robot]\nport = 0\n[sim.etalon]\nport = 0\n[mission]\ncalibration_length_m = 0.0\n"
        '[run]\nmirror = "thesis-m1"\n'
    )
    options = ("--sim", "--realtime", "--config", str(config), "--runtime-dir", str(runtime_dir), "--period", "0.5")
    with network(CROSSBAR, tmp_path, free_port, *options) as client_options:
        client = until(lambda: connect(client_options))
        refused = client.status()
        assert not refused.session["success"]
        assert "no daemon in" in str(refused.session["messages"])
        assert client.survey.start(panels=-1)[0] != 0  # refused by the check of its parameter
        assert client.survey.start(panels=2)[0] == 0
        state = until(lambda: (client.survey.status().session["data"] or {}).get("state") in ("turning", "driving"))
        assert state
        assert client.status().session["data"]["total"] == 18
        assert client.pause().session["success"]
        assert client.status().session["data"]["state"] == "held"
        assert client.resume().session["success"]
        fed = until(lambda: client.monitor.status().session["data"])
        assert fed["running"]
        block = published(client_options)
        assert block["data"]["total"][0] == 18
        of_the_last_second = "held", "turning", "driving", "settling", "measuring"
        assert block["data"]["state"][0] in of_the_last_second
        assert client.abort().session["success"]
        ended = client.survey.wait(timeout=120)
        assert "aborted, the robot is at base" in str(ended.session["messages"])
        assert ended.session["data"]["exit_status"] == 3
        until(lambda: not client.monitor.status().session["data"]["running"])
