"""The agent of the observatory control system."""

import argparse
import sys
import threading
import time
import tomllib
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import pytest

from ccatp.daemon.operator import ocs_agent
from ccatp.daemon.operator.ocs_agent import SurveyTask, add_arguments, main, register, survey_command
from ccatp.errors import ConfigError
from ccatp.links.client import OperatorClient
from tests.unit.links.test_auth import serving, status


class Session:
    """As an OCS session."""

    def __init__(self) -> None:
        self.status = "running"
        self.data: dict[str, Any] = {}

    def set_status(self, status: str) -> None:
        self.status = status


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ccatp.daemon.operator.ocs_agent.PERIOD_S", 0.01)


def surveys_of(runtime_dir: Path, program: str = "") -> SurveyTask:
    command = [sys.executable, "-c", program]
    return SurveyTask(OperatorClient(runtime_dir, 5.0), command, {}, lambda _: None)


@pytest.mark.parametrize(
    ("program", "panels", "code", "success", "reported"),
    [
        ("0", None, 0, True, "complete"),
        ("3", None, 3, False, "at base"),
        ("4", None, 4, False, "not at base"),
        ("5", None, 5, False, "did not answer"),
        ("7", None, 7, False, "status 7"),
        ("0 if sys.argv[1:] == ['--panels', '3'] else 9", 3, 0, True, "the survey is complete"),
    ],
)
def test_a_survey_ends_as_its_process_does(
    program: str, panels: int | None, code: int, success: bool, reported: str, runtime_dir: Path
) -> None:
    session = Session()
    done, text = surveys_of(runtime_dir, f"import sys; raise SystemExit({program})").survey(session, panels)
    assert done is success
    assert reported in text
    assert session.data["exit_status"] == code


def test_a_survey_that_reports_nothing_is_ended(runtime_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ccatp.daemon.operator.ocs_agent.START_TIMEOUT_S", 0.2)
    done, text = surveys_of(runtime_dir, "import time; time.sleep(60)").survey(Session())
    assert not done
    assert "said nothing within 0.2 s" in text


def test_a_survey_that_runs_already_is_followed_and_aborted_when_the_session_stops(runtime_dir: Path) -> None:
    session, asked = Session(), []

    def answer(request: dict[str, Any]) -> dict[str, Any]:
        asked.append(request["cmd"])
        if len(asked) == 4:
            session.status = "stopping"
        return status(state="driving", done=len(asked), exit_status=3 if "abort" in asked else -1)

    with serving(runtime_dir, "control", answer):

        def go_away() -> None:
            while "abort" not in asked:
                time.sleep(0.001)
            # what the daemon's end looks like from here
            (runtime_dir / "control").unlink(missing_ok=True)

        thread = threading.Thread(target=go_away)
        thread.start()
        done, text = surveys_of(runtime_dir, "raise SystemExit(9)").survey(session)
        thread.join()
    assert "abort" in asked
    assert session.data["state"] == "driving"
    assert (done, text) in ((True, "aborted, the robot is at base"), (False, "the survey is over"))


def test_orders_and_refusals(runtime_dir: Path) -> None:
    session = Session()
    surveys = surveys_of(runtime_dir)
    done, text = surveys.ask("status", session)
    assert not done
    assert "no daemon in" in text
    with serving(runtime_dir, "control", lambda request: status(state=request["cmd"])):
        assert surveys.ask("pause", session) == (True, "pause: pause")
        assert session.data["state"] == "pause"
    with serving(runtime_dir, "control", lambda _: {"ok": False, "error": "nothing is paused"}):
        assert surveys.ask("resume") == (False, "resume refused: nothing is paused")


def test_the_monitor_publishes_until_it_is_stopped(runtime_dir: Path) -> None:
    session = Session()
    blocks: list[dict[str, Any]] = []

    def publish(block: dict[str, Any]) -> None:
        blocks.append(block)
        if len(blocks) >= 3:
            session.status = "stopping"

    with serving(runtime_dir, "control", lambda _: status(done=5, state="driving")):
        assert surveys_of(runtime_dir).monitor(session, publish, 0.01) == (True, "monitoring ended")
    assert [block["block_name"] for block in blocks] == ["daemon", "survey", "daemon", "survey"]
    assert blocks[0]["data"] == {"running": 1}
    assert blocks[1]["data"]["done"] == 5
    assert all(isinstance(value, int | float | str) for value in blocks[1]["data"].values())
    session.status, blocks[:] = "running", []
    surveys_of(runtime_dir / "none").monitor(session, publish, 0.01)
    assert [block["data"] for block in blocks] == [{"running": 0}] * 3


def test_what_the_agent_offers(runtime_dir: Path) -> None:
    agent, session = MagicMock(), Session()
    register(agent, surveys_of(runtime_dir, "raise SystemExit(0)"), lambda *_, **__: lambda function: function, 0.01)
    processes = {call.args[0]: call.args[1:] for call in agent.register_process.call_args_list}
    tasks = {call.args[0]: call.args[1] for call in agent.register_task.call_args_list}
    assert processes.keys() == {"survey", "monitor"}
    assert tasks.keys() == {"status", "pause", "resume", "abort", "stop"}
    assert [call.args[0] for call in agent.register_feed.call_args_list] == ["survey"]
    assert processes["survey"][0](session, {"panels": None})[0]
    assert not tasks["abort"](session, {})[0]
    assert "**Task**" in tasks["abort"].__doc__
    monitor, stop = processes["monitor"]
    agent.publish_to_feed.side_effect = lambda *_: stop(session, {})
    assert monitor(session, {})[0]
    assert session.status == "stopping"
    assert agent.publish_to_feed.call_args_list[0].args[0] == "survey"


def test_the_command_of_a_survey() -> None:
    parser = add_arguments(argparse.ArgumentParser())
    args = parser.parse_args(["--sim", "--realtime", "--config", "a.toml", "--mirror", "fyst-m2"])
    assert survey_command(args)[3:] == ["run", "--sim", "--realtime", "--config", "a.toml", "--mirror", "fyst-m2"]


def test_without_the_extra_it_reports_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ocs", None)
    with pytest.raises(ConfigError, match=r"install ccatp with its extra, ccatp\[ocs\]"):
        main([])


def test_the_plugin_names_the_agent() -> None:
    project = tomllib.loads((Path(__file__).parents[3] / "pyproject.toml").read_text())["project"]
    assert project["entry-points"]["ocs.plugins"] == {"ccatp": "ccatp.daemon.operator.ocs_agent"}
    assert ocs_agent.agents["CcatpAgent"] == {"module": "ccatp.daemon.operator.ocs_agent", "entry_point": "main"}
