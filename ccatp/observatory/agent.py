"""Glue. The agent of the observatory control system (extra ``ocs``): surveys as its process, orders as its tasks."""

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from ccatp.client import Client
from ccatp.errors import CcatpError, ExitStatus
from ccatp.observatory.desk import Answer, SurveyDesk

AGENT_CLASS = "CcatpAgent"
FEED = "survey"
ORDERS = ("status", "pause", "resume", "abort", "stop")
# A pause is answered when the robot is at rest.
TIMEOUT_S = 10.0


class OcsMissing(CcatpError):
    """The extra is not installed."""

    exit_status = ExitStatus.USAGE


def add_arguments(parser: argparse.ArgumentParser) -> argparse.ArgumentParser:
    """The agent's own options; those of OCS come beside them."""
    own = parser.add_argument_group("Agent options")
    own.add_argument("--config", type=Path, help="configuration of the surveys")
    own.add_argument("--sim", action="store_true", help="simulate robot and laser system")
    own.add_argument("--realtime", action="store_true", help="with --sim: pace the simulation on the wall clock")
    own.add_argument("--mirror", help="mirror of the surveys, if not that of the configuration")
    own.add_argument("--runtime-dir", type=Path, help="folder of the daemon's sockets, if not the usual one")
    own.add_argument("--period", type=float, default=1.0, help="seconds between two blocks of the feed")
    return parser


def survey_command(args: argparse.Namespace) -> list[str]:
    """``ccatp run`` as the agent's options want it."""
    command = [sys.executable, "-m", "ccatp", "run"]
    command += [flag for flag, is_given in (("--sim", args.sim), ("--realtime", args.realtime)) if is_given]
    for option, value in (("--config", args.config), ("--mirror", args.mirror), ("--runtime-dir", args.runtime_dir)):
        if value is not None:
            command += [option, str(value)]
    return command


def main(args: Sequence[str] | None = None) -> None:
    """Entry of ``ocs-agent-cli --agent CcatpAgent``: join the crossbar router and serve until it ends.

    Raises:
        OcsMissing: the extra is not installed.
    """
    try:
        import txaio  # type: ignore[import-untyped, unused-ignore]  # noqa: PLC0415 - belongs to an extra
        from ocs import ocs_agent, site_config  # noqa: PLC0415
    except ImportError as error:
        raise OcsMissing("the agent needs OCS: install ccatp with its extra, ccatp[ocs]") from error
    txaio.start_logging(  # type: ignore[attr-defined, unused-ignore]
        level=os.environ.get("LOGLEVEL", "info")
    )
    parser = add_arguments(argparse.ArgumentParser())
    parsed = site_config.parse_args(agent_class=AGENT_CLASS, parser=parser, args=args)
    if not parsed.sim and parsed.config is None:
        parser.error("name the robot's configuration with --config FILE, or add --sim")
    agent, runner = ocs_agent.init_site_agent(parsed)
    desk = SurveyDesk(Client(parsed.runtime_dir, TIMEOUT_S), survey_command(parsed), os.environ, agent.log.info)
    register(agent, desk, ocs_agent.param, parsed.period)
    runner.run(agent, auto_reconnect=True)


def register(agent: Any, desk: SurveyDesk, param: Any, period_s: float) -> None:
    """Tell the agent its processes, tasks and feed.

    Args:
        agent: an ``ocs.ocs_agent.OCSAgent``.
        desk: what does the work, in threads of the agent.
        param: ``ocs.ocs_agent.param``.
        period_s: between two blocks of the feed.
    """

    def stop(session: Any, params: Any) -> Answer:
        del params
        session.set_status("stopping")
        return True, "asked to stop"

    def survey(session: Any, params: Any) -> Answer:
        """Start a survey, or join the one that runs, and end with it.

        **Process** - with ``panels`` only of the first so many. Stopping it aborts the survey: the robot drives to its
        base.
        """
        return desk.survey(session, params["panels"])

    def monitor(session: Any, params: Any) -> Answer:
        """Publish the state of the survey to the feed ``survey``, whether one runs or not.

        **Process** - begins with the agent.
        """
        del params
        return desk.monitor(session, lambda block: agent.publish_to_feed(FEED, block), period_s)

    panels = param("panels", default=None, type=int, check=lambda number: number >= 0)
    nothing = param("_")
    agent.register_feed(FEED, record=True, agg_params={"frame_length": 60}, buffer_time=1.0)
    agent.register_process("survey", panels(survey), stop, blocking=True)
    agent.register_process("monitor", nothing(monitor), stop, blocking=True, startup=True)
    for order in ORDERS:
        agent.register_task(order, nothing(_task(desk, order)), blocking=True)


def _task(desk: SurveyDesk, order: str) -> Callable[[Any, Any], Answer]:
    def task(session: Any, params: Any) -> Answer:
        del params
        return desk.ask(order, session)

    task.__doc__ = f"Ask the daemon: {order}.\n\n**Task** - {order}(): the status afterwards is in the session's data."
    return task


if __name__ == "__main__":
    main()
