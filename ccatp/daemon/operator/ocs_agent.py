"""The agent of the observatory control system (extra ``ocs``): surveys as its process, commands as its tasks.

A survey is a separate process, started by the agent, systemd or an operator. The agent follows it over the operator
channel. The survey continues if the agent ends, and a restarted agent follows it again.
"""

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from ccatp.config.package import child_environment
from ccatp.errors import CcatpError, ConfigError, DaemonUnreachableError, ExitStatus
from ccatp.links.client import OperatorClient
from ccatp.links.runtime_dir import runtime_dir_path
from ccatp.links.topics import MissionStatus

Answer = tuple[bool, str]
PERIOD_S = 0.5
RUNNING = ("starting", "running")  # states of a session of OCS
# A started survey publishes its status within this time (processes, planning, joining).
START_TIMEOUT_S = 60.0
ENDINGS: Mapping[int, str] = {
    ExitStatus.COMPLETE: "the survey is complete",
    ExitStatus.ABORTED: "aborted, the robot is at base",
    ExitStatus.HELD: "held, the robot is not at base",
    ExitStatus.UNREACHABLE: "the robot or the laser system did not answer",
    ExitStatus.INTERRUPTED: "interrupted, the wheels are held",
}
# The feed always has the same fields (numbers and short texts): names in the feed and in the status.
UNCHANGED = "state", "summary_state", "cause", "point", "done", "skipped", "total", "elapsed_s", "eta_s"
FEED_FIELDS = {
    **{name: name for name in UNCHANGED},
    "arrival_error_mm": "error_mm",
    "danger_code": "code",
    "late_frames": "missed_deadlines",
    "exit_status": "exit_status",
}


@dataclass(slots=True)
class SurveyTask:
    """Starts, follows and ends surveys; a session is one of OCS, with ``status`` and ``data``."""

    client: OperatorClient
    command: Sequence[str]  # of a survey, ``ccatp run ...``
    environment: Mapping[str, str]
    log: Callable[[str], None]

    def survey(self, session: Any, panels: int | None = None) -> Answer:
        """Start a survey of the first ``panels`` (all where None), or join the one that runs, and follow it to its end.

        ``session.data`` shows the status. When the session is stopped, the survey is aborted: the robot is at base when
        the session ends.
        """
        if self._status() is not None:
            self.log("a survey runs already; following it")
            return self._follow(session, None)
        command = [*self.command, *([] if panels is None else ["--panels", str(panels)])]
        self.log(f"starting {' '.join(command)}")
        child = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            start_new_session=True,  # it outlives the agent
            env=child_environment(self.environment),
        )
        return self._follow(session, child)

    def _follow(self, session: Any, child: "subprocess.Popen[bytes] | None") -> Answer:
        deadline_s, is_aborted, last = time.monotonic() + START_TIMEOUT_S, False, None
        while child is None or child.poll() is None:
            status = self._status()
            if status is not None:
                last = status
                session.data = msgspec.to_builtins(status)
                if session.status not in RUNNING and not is_aborted:
                    is_aborted = self.ask("abort")[0]
            elif child is None:  # the survey has ended
                break
            elif last is None and time.monotonic() > deadline_s:
                child.terminate()
                child.wait()
                return False, f"the survey said nothing within {START_TIMEOUT_S:g} s and was ended"
            time.sleep(PERIOD_S)
        code = child.returncode if child is not None else (-1 if last is None else last.exit_status)
        session.data = {**session.data, "exit_status": code}
        if code < 0:
            return False, "the survey is over"
        ending = ENDINGS.get(code, f"the survey ended with status {code}; see its log")
        # An abort is a success if stopping the session requested it.
        return code == ExitStatus.COMPLETE or (is_aborted and code == ExitStatus.ABORTED), ending

    def ask(self, order: str, session: Any | None = None) -> Answer:
        """Send one command to the daemon: status, pause, resume, abort, stop."""
        try:
            status: MissionStatus = getattr(self.client, order)()
        except CcatpError as error:
            return False, str(error)
        if session is not None:
            session.data = msgspec.to_builtins(status)
        return True, f"{order}: {status.state}"

    def monitor(self, session: Any, publish: Callable[[dict[str, Any]], None], period_s: float) -> Answer:
        """Publish the status periodically until the session is stopped; ``session.data`` has the last status."""
        while session.status in RUNNING:
            status, now_s, until_s = self._status(), time.time(), time.monotonic() + period_s
            blocks = {"daemon": {"running": int(status is not None)}}
            session.data = {"timestamp": now_s, "running": status is not None}
            if status is not None:
                blocks["survey"] = {field: getattr(status, name) for field, name in FEED_FIELDS.items()}
                session.data |= msgspec.to_builtins(status)
            for name, data in blocks.items():
                publish({"timestamp": now_s, "block_name": name, "data": data})
            while session.status in RUNNING and time.monotonic() < until_s:
                time.sleep(min(0.1, period_s))
        return True, "monitoring ended"

    def _status(self) -> MissionStatus | None:
        try:
            return self.client.status()
        except DaemonUnreachableError:
            return None


AGENT_CLASS = "CcatpAgent"
# Names that OCS reads from the module of the entry point ``ocs.plugins``.
package_name = "ccatp"
agents = {AGENT_CLASS: {"module": "ccatp.daemon.operator.ocs_agent", "entry_point": "main"}}
FEED = "survey"
ORDERS = ("status", "pause", "resume", "abort", "stop")
# A pause is answered when the robot is at rest.
TIMEOUT_S = 10.0


# Options of the agent's command line, which it passes on to ``ccatp run``.
OPTIONS: dict[str, dict[str, Any]] = {
    "--sim": {"action": "store_true", "help": "simulate robot and laser system"},
    "--realtime": {"action": "store_true", "help": "with --sim: pace the simulation on the wall clock"},
    "--config": {"type": Path, "help": "configuration of the surveys"},
    "--mirror": {"help": "mirror of the surveys, if not that of the configuration"},
    "--runtime-dir": {"type": Path, "help": "folder of the daemon's sockets, if not the usual one"},
}


def add_arguments(parser: argparse.ArgumentParser) -> argparse.ArgumentParser:
    """Add the agent's own options to those of OCS."""
    own = parser.add_argument_group("Agent options")
    for option, attributes in OPTIONS.items():
        own.add_argument(option, **attributes)
    own.add_argument("--period", type=float, default=1.0, help="seconds between two blocks of the feed")
    return parser


def survey_command(args: argparse.Namespace) -> list[str]:
    """``ccatp run`` with the agent's options."""
    command = [sys.executable, "-m", "ccatp", "run"]
    for option in OPTIONS:
        value = getattr(args, option.strip("-").replace("-", "_"))
        if value:
            command += [option] if value is True else [option, str(value)]
    return command


def main(args: Sequence[str] | None = None) -> None:
    """Entry of ``ocs-agent-cli --agent CcatpAgent``: join the crossbar router and serve until it ends.

    Raises ConfigError: the extra is not installed.
    """
    try:
        import txaio  # type: ignore[import-untyped, unused-ignore]  # noqa: PLC0415 - belongs to an extra
        from ocs import ocs_agent, site_config  # noqa: PLC0415
    except ImportError as error:
        raise ConfigError("the agent needs OCS: install ccatp with its extra, ccatp[ocs]") from error
    txaio.start_logging(  # type: ignore[attr-defined, unused-ignore]
        level=os.environ.get("LOGLEVEL", "info")
    )
    parser = add_arguments(argparse.ArgumentParser())
    parsed = site_config.parse_args(agent_class=AGENT_CLASS, parser=parser, args=args)
    if not parsed.sim and parsed.config is None:
        parser.error("name the robot's configuration with --config FILE, or add --sim")
    # Passed to the survey as well, because a simulation without it would take another folder if this one is in use.
    parsed.runtime_dir = runtime_dir_path(str(parsed.runtime_dir or ""), os.environ)
    agent, runner = ocs_agent.init_site_agent(parsed)
    surveys = SurveyTask(
        OperatorClient(parsed.runtime_dir, TIMEOUT_S), survey_command(parsed), os.environ, agent.log.info
    )
    register(agent, surveys, ocs_agent.param, parsed.period)
    runner.run(agent, auto_reconnect=True)


def register(agent: Any, surveys: SurveyTask, param: Any, period_s: float) -> None:
    """Register processes, tasks and feed at an ``OCSAgent``; ``param`` is ``ocs.ocs_agent.param``."""

    def stop(session: Any, _params: Any) -> Answer:
        session.set_status("stopping")
        return True, "asked to stop"

    def survey(session: Any, params: Any) -> Answer:
        """Start a survey, or join the one that runs, and end with it.

        **Process** - with ``panels`` only of the first so many. Stopping it aborts the survey: the robot drives to its
        base.
        """
        return surveys.survey(session, params["panels"])

    def monitor(session: Any, _params: Any) -> Answer:
        """Publish the state of the survey to the feed ``survey``, whether one runs or not.

        **Process** - begins with the agent.
        """
        return surveys.monitor(session, lambda block: agent.publish_to_feed(FEED, block), period_s)

    panels = param("panels", default=None, type=int, check=lambda number: number >= 0)
    nothing = param("_")
    agent.register_feed(FEED, record=True, agg_params={"frame_length": 60}, buffer_time=1.0)
    agent.register_process("survey", panels(survey), stop, blocking=True)
    agent.register_process("monitor", nothing(monitor), stop, blocking=True, startup=True)
    for order in ORDERS:

        def task(session: Any, _params: Any, order: str = order) -> Answer:
            return surveys.ask(order, session)

        task.__doc__ = (
            f"Ask the daemon: {order}.\n\n**Task** - {order}(): the session's data hold the status afterwards."
        )
        agent.register_task(order, nothing(task), blocking=True)


if __name__ == "__main__":
    main()
