"""Glue. The command ``ccatp completion``: the lines that teach a shell our commands, options and names."""

import shutil
import sys
from typing import Any

import click

from ccatp.commands.frame import NearestChoice, example

SHELLS = ("bash", "zsh", "fish")
VARIABLE = "_CCATP_COMPLETE"


@click.command(
    epilog=example(
        'eval "$(ccatp completion bash)"',
        "ccatp completion zsh > ~/.zfunc/_ccatp",
        "ccatp completion fish > ~/.config/fish/completions/ccatp.fish",
    )
)
@click.argument("shell", type=NearestChoice(SHELLS), metavar="SHELL")
@click.pass_context
def completion(context: click.Context, shell: str) -> int:
    """Print the completion for SHELL: bash, zsh or fish.

    For bash put the line of the example into ~/.bashrc; for zsh a folder of $fpath takes the file.
    """
    from click.shell_completion import get_completion_class

    root = context.find_root().command
    kind = get_completion_class(shell)
    if kind is None:  # click knows all of SHELLS
        raise click.UsageError(f"no completion for {shell}")
    sys.stdout.write(_source(kind, root, shell))
    return 0


def _source(kind: Any, root: click.Command, shell: str) -> str:
    """The script; click asks bash for its version first, which is of no use where there is none to ask."""
    script = kind(root, {}, "ccatp", VARIABLE)
    if shell == "bash" and shutil.which("bash") is None:
        return str(script.source_template % script.source_vars()) + "\n"
    return str(script.source()) + "\n"
