"""Glue. The command ``ccatp bench``."""

import json
import os
from collections.abc import Mapping
from pathlib import Path

import click

from ccatp.commands.frame import JSON_OPTION, WORLD_OPTIONS, example, overrides

PAGE = "docs/bench.md"


@click.command(epilog=example("ccatp bench --quick", "ccatp bench --json", "ccatp bench --markdown"))
@WORLD_OPTIONS
@click.option("--quick", is_flag=True, help="A tenth of the repeats, a mission of one panel.")
@click.option("--steps-only", is_flag=True, help="No missions.")
@click.option(
    "--markdown", type=click.Path(path_type=Path, dir_okay=False), is_flag=False, flag_value=PAGE, metavar="[FILE]",
    help=f"Write the table to FILE; {PAGE} if not named.",
)  # fmt: skip
@JSON_OPTION
def bench(
    config_file: Path | None, mirror: str | None, world: str | None, seed: int | None, settings: Mapping[str, object],
    quick: bool, steps_only: bool, markdown: Path | None, json_output: bool,
) -> int:  # fmt: skip
    """Time this project's parts against peers that compute the same, by turns in one run."""
    # Matrices are small: threads of the linear algebra would be timed instead. Set before numpy is imported.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    import tempfile

    from ccatp.bench.report import markdown as page
    from ccatp.bench.report import terminal_lines
    from ccatp.bench.suite import run_bench
    from ccatp.config.loader import dump_config, load_config

    named = {"run.mirror": mirror, "run.world": world, "run.seed": seed}
    cfg = load_config(config_file, overrides(settings, named))
    with tempfile.TemporaryDirectory(prefix="ccatp-bench-") as folder:
        exact = Path(folder) / "config.toml"
        exact.write_text(dump_config(cfg), encoding="utf-8")
        result = run_bench(cfg, quick=quick, run_args=("--config", str(exact)), missions=not steps_only)
    if markdown is not None:
        markdown.write_text(page(result), encoding="utf-8")
    for line in [json.dumps(result)] if json_output else terminal_lines(result):
        click.echo(line)
    return 0
