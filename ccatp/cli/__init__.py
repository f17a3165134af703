"""The table of commands. Only click is imported here, because ``--help`` and completion must be fast.

Each module has the commands of one purpose; ``common`` has their shared parts.
"""

import gc
from collections.abc import Sequence

import click

import ccatp
from ccatp.cli import config, onboard, operate, prepare, recording, report, run, runs, sim, study
from ccatp.cli.common import CommandGroup, example, run_command_line
from ccatp.missions import built_in

SECTIONS = {
    "Before a mission": (prepare.plan, prepare.check, prepare.calibrate, config.config, config.keys),
    "Operate": (
        *(run.run, operate.status, operate.alarms, operate.pause, operate.resume, operate.abort, operate.stop),
        *(operate.emergency, operate.clear, run.dashboard, run.stream),
    ),
    "Data": (
        *(runs.runs, report.report, report.compare, report.align, report.replay, report.plot, recording.recording),
    ),
    "Simulation and robots": (sim.sim, onboard.onboard, sim.conformance),
    "Studies": (study.study, study.bench, *(part.get() for kind in built_in() for part in kind.commands)),
    "Shell": (config.completion,),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    status = run_command_line(cli, argv)
    if argv is None:  # the process ends; otherwise it would visit all objects of the libraries again, for 0.3 s
        gc.freeze()
    return status


@click.group(
    cls=CommandGroup,
    sections=SECTIONS,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    epilog=example("ccatp run --sim", "ccatp run --sim --mirror fyst-m2 --seed 2", "ccatp status --json"),
)
@click.version_option(ccatp.__version__, message="ccatp %(version)s")
def cli() -> None:
    """Survey telescope mirrors with a laser-tracked robot."""
