"""The clients against a real daemon: what a script of an observatory would do."""

from collections.abc import Callable
from pathlib import Path

import pytest

from ccatp.config.load import load_config
from ccatp.errors import RefusedError
from ccatp.links.client import HttpClient, OperatorClient
from tests.processes.conftest import Run


def test_a_survey_paused_resumed_and_called_home(start: Callable[..., Run], runtime_dir: Path) -> None:
    page = ("--set", "dashboard.enabled=true", "--set", "dashboard.port=0")
    run = start("--realtime", "--panels", "1", "--mirror", "thesis-m1", *page)
    run.until(lambda status: status["state"] in ("turning", "driving"))
    daemon = OperatorClient(runtime_dir)
    assert daemon.status().total == 9
    assert daemon.pause().state == "held"
    http = HttpClient(f"http://127.0.0.1:{load_config(run.run_dir / 'config.toml').dashboard.port}")
    assert http.is_healthy()
    assert http.status()["mission"]["total"] == 9
    http.resume()
    daemon.wait(lambda status: status.state != "held", timeout_s=20.0)
    with pytest.raises(RefusedError, match="resume refused"):
        daemon.resume()
    assert daemon.observatory.ping().code == 0
    latched = daemon.observatory.emergency("weather", "wind")
    assert latched.code == 2
    # At base the daemon ends; whoever asks then finds nobody, and its exit status says the rest.
    assert run.wait() == 3
