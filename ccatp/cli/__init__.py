"""The table of commands. Only click is imported here, because ``--help`` and completion must be fast.

Each module has the commands of one purpose and is imported when one of them is used; ``common`` has their shared parts.
"""

import gc
from collections.abc import Sequence

import click

import ccatp
from ccatp.cli.common import CommandGroup, example, run_command_line
from ccatp.missions import Part, built_in


def _commands(module: str, *names: str) -> tuple[Part, ...]:
    return tuple(Part(f"ccatp.cli.{module}:{name}") for name in names)


# Titles in the help, and the commands below them; each has the name of its function.
SECTIONS = {
    "Before a mission": (*_commands("prepare", "plan", "check", "calibrate"), *_commands("config", "config", "keys")),
    "Operate": (
        *_commands("run", "run"),
        *_commands("operate", "status", "alarms", "pause", "resume", "abort", "stop", "emergency", "clear"),
        *_commands("run", "dashboard", "stream"),
    ),
    "Data": (
        *_commands("runs", "runs"),
        *_commands("report", "report", "compare", "align", "replay", "plot"),
        *_commands("recording", "recording"),
    ),
    "Simulation and robots": (
        *_commands("sim", "sim"),
        *_commands("onboard", "onboard"),
        *_commands("sim", "conformance"),
    ),
    "Studies": (*_commands("study", "study", "bench"), *(part for kind in built_in() for part in kind.commands)),
    "Shell": _commands("config", "completion"),
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
