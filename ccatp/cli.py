"""Glue. The table of commands. Only click is imported here: ``--help`` and completion must be quick."""

from collections.abc import Sequence

import click

import ccatp
from ccatp.commands.align import align
from ccatp.commands.bench import bench
from ccatp.commands.calibrate import calibrate
from ccatp.commands.check import check
from ccatp.commands.completion import completion
from ccatp.commands.config import config
from ccatp.commands.conformance import conformance
from ccatp.commands.dashboard import dashboard
from ccatp.commands.emergency import clear, emergency
from ccatp.commands.frame import SuggestingGroup, example, run_command_line
from ccatp.commands.keys import keys
from ccatp.commands.log import log
from ccatp.commands.operate import abort, pause, resume, stop
from ccatp.commands.plan import plan
from ccatp.commands.radio import radio
from ccatp.commands.replay import replay
from ccatp.commands.report import compare, report
from ccatp.commands.run import run
from ccatp.commands.run_map import draw_map
from ccatp.commands.sim import sim
from ccatp.commands.status import status
from ccatp.commands.stream import stream
from ccatp.commands.study import study
from ccatp.package import COMPILED, build

BEFORE = (plan, check, calibrate, config, keys)
MISSION = (run, status, pause, resume, abort, stop, emergency, clear, dashboard, stream)
AFTERWARDS = (report, compare, align, replay, draw_map, log)
LABORATORY = (sim, study, bench, conformance, radio, completion)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    return run_command_line(cli, argv)


@click.group(
    cls=SuggestingGroup,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    epilog=example("ccatp run --sim", "ccatp run --sim --mirror fyst-m2 --seed 2", "ccatp status --json"),
)
@click.version_option(ccatp.__version__, message="ccatp %(version)s" + (" compiled" if build() == COMPILED else ""))
def cli() -> None:
    """Survey telescope mirrors with a laser-tracked robot."""


for command in (*BEFORE, *MISSION, *AFTERWARDS, *LABORATORY):
    cli.add_command(command)
