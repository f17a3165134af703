"""A run is streamed live to a viewer that comes late, and does not notice."""

import json
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import zmq

from tests.processes.conftest import Run


def test_a_late_viewer_sees_the_run(start: Callable[..., Run], runtime_dir: Path) -> None:
    command = [sys.executable, "-m", "ccatp", "stream", "--runtime-dir", str(runtime_dir), "--port", "0"]
    # Before the run: it must not mistake the stream for its recorder.
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as stream, zmq.Context() as context:
        assert stream.stderr is not None
        where = stream.stderr.readline().rpartition(" ")[2].strip()
        run = start("--realtime", "--panels", "1", "--mirror", "thesis-m1")
        run.until(lambda status: status["state"] == "driving")
        with context.socket(zmq.SUB) as viewer:
            viewer.setsockopt(zmq.LINGER, 0)
            viewer.setsockopt(zmq.RCVTIMEO, 20_000)
            viewer.setsockopt(zmq.SUBSCRIBE, b"")
            viewer.connect(where)
            found: dict[str, dict[str, object]] = {}
            wanted = {"run", "view/panels", "view/frames", "view/robot", "view/sensors", "view/error", "mission"}
            while wanted - found.keys():
                topic, payload, t_s = viewer.recv_multipart()
                found[topic.decode()] = json.loads(payload)
                float(t_s)
        assert found["run"] | {"run_dir": ""} == {
            "mirror": "thesis-m1", "world": "thesis", "simulation": True, "seed": 1, "filter": "ekf", "run_dir": "",
        }  # fmt: skip
        assert abs(float(str(found["view/error"]["position_mm"]))) < 50.0
        run.ask("stop")
        run.wait()
        stream.send_signal(signal.SIGTERM)
        assert stream.wait(10.0) == 0
    assert run.process.returncode == 4
