"""The commands ``ccatp study`` and ``ccatp bench``."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from ccatp.cli import common


class _StudyCommand(common.CheckedCommand):
    """A command whose help lists the studies; their table is read only when the help is requested."""

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        from ccatp.studies import STUDIES

        with formatter.section("Studies"):
            formatter.write_dl([(name, title) for name, (_, title) in STUDIES.items()])
        super().format_epilog(ctx, formatter)


@common.command(
    "ccatp study filters --runs 20 --out studies/filters",
    "ccatp study filters --only world=hard,extreme --only filter=ekf --out studies/ekf",
    "ccatp study time --mirror fyst-m1 --mirror fyst-m2 --out studies/time",
    cls=_StudyCommand,
)
@click.argument("name", metavar="NAME")
@click.option(
    "--out", type=common.OutputFolder(), metavar="DIR",
    help="Where to write, studies/NAME if not given; a campaign that was stopped continues there.",
)  # fmt: skip
@click.option(
    "--runs", type=click.IntRange(min=1), metavar="N", help="Seeds of each cell; else the study's own number."
)
@click.option("--workers", type=click.IntRange(min=1), metavar="N", help="Processes; one for each core if not given.")
@click.option("--cluster", metavar="ADDRESS", help="Scheduler of dask.distributed that does the jobs instead.")
@click.option("--shard", metavar="I/N", help="Only every N-th job, from the I-th on; without it all are put together.")
@click.option(
    "--from", "others", multiple=True, type=common.PATH, metavar="DIR",
    help="Take over the jobs that are done there. May be repeated.",
)  # fmt: skip
@click.option("--only", multiple=True, metavar="FACTOR=LEVEL[,LEVEL]", help="Only these cells. May be repeated.")
@click.option("--mirror", "mirrors", multiple=True, metavar="NAME", help="In place of the study's. May be repeated.")
@common.PANELS_OPTION
@common.key_option("--seed", "run.seed", type=int, metavar="N", help="Seed of the first run.")
@common.key_option("--data", "run.data", metavar="DIR", help="Folder of recorded runs, for recordings and damage.")
@click.option("--peers", is_flag=True, help="Other people's estimators, too: GTSAM, which needs ccatp[peers].")
@common.CONFIG_OPTION
@common.SETTINGS_OPTION
@click.option("--no-figures", is_flag=True, help="Tables only.")
@common.JSON_OPTION
def study(
    name: str, out: Path | None, runs: int | None, workers: int | None, cluster: str | None, shard: str | None,
    others: Sequence[Path], only: Sequence[str], mirrors: Sequence[str], config_file: Path | None,
    settings: Mapping[str, object], peers: bool, no_figures: bool, json_output: bool,
) -> int:  # fmt: skip
    """Run the study NAME: many missions or an analysis, with tables, figures and a machine-readable result."""
    from ccatp.studies import limit_threads

    limit_threads()  # before numpy is imported
    from ccatp.config.load import load_config
    from ccatp.studies import find_study
    from ccatp.studies.campaign import WHOLE, CampaignError, Study, parse_choice, parse_shard
    from ccatp.studies.engine import CampaignOptions, run_campaign

    out = out or Path("studies") / name
    found = find_study(name)
    if isinstance(found, Study):
        options = CampaignOptions(
            out=out, runs=runs, workers=workers, cluster=cluster, shard=parse_shard(shard) if shard else WHOLE,
            others=tuple(others), mirrors=tuple(mirrors), only=dict(parse_choice(text) for text in only),
            settings=settings, with_figures=not no_figures,
        )  # fmt: skip
        if peers:
            if found.with_peers is None:
                raise CampaignError(f"study {name} has no peers; leave --peers out")
            found = replace(found, cells=found.with_peers)
        load = found.loader.get()
        if found.of_config is not None:
            found = found.of_config(found, load(config_file, settings))
        common.warn(found.notes)
        result = run_campaign(found, lambda keys: load(config_file, keys), options)
    else:
        idle = {"--cluster": cluster, "--shard": shard, "--from": others, "--only": only, "--mirror": mirrors}
        if surplus := [option for option, value in idle.items() if value]:
            raise CampaignError(f"study {name} has no runs to hand out; leave {surplus[0]} out")
        if runs or workers:
            click.echo(f"ccatp: study {name} is one analysis: --runs and --workers change nothing", err=True)
        result = _analysed(found, load_config(config_file, settings), out)
    common.print_lines([json.dumps(result) if json_output else (out / "table.md").read_text(encoding="utf-8").rstrip()])
    return 0


def _analysed(analysis: Callable[[Any, Path], dict[str, Any]], cfg: Any, out: Path) -> dict[str, Any]:
    from ccatp.report.plots import check_drawing
    from ccatp.studies.campaign import CampaignFailed
    from ccatp.studies.engine import make_out

    make_out(out)
    check_drawing(out)
    try:
        return analysis(cfg, out)
    except OSError as error:
        what = f"{error.filename or out}: {error.strerror or error}"
        raise CampaignFailed(f"{what}; make room or choose another --out") from error


PAGE = "docs/measurements/bench.md"


@common.command("ccatp bench --quick", "ccatp bench --json", "ccatp bench --markdown")
@common.WORLD_OPTIONS
@click.option("--quick", is_flag=True, help="A tenth of the repeats, missions of one panel.")
@click.option("--steps-only", is_flag=True, help="No missions.")
@click.option("--frames-only", is_flag=True, help="Missions only.")
@click.option(
    "--markdown", type=common.OutputFile(), is_flag=False, flag_value=PAGE, metavar="[FILE]",
    help=f"Write the tables to FILE, below them what stood there by hand; {PAGE} if not named.",
)  # fmt: skip
@common.JSON_OPTION
def bench(
    config_file: Path | None, settings: Mapping[str, object], quick: bool, steps_only: bool, frames_only: bool,
    markdown: Path | None, json_output: bool,
) -> int:  # fmt: skip
    """Time this project's parts against peers that compute the same, alternately, in one run."""
    import tempfile

    from ccatp.config.load import dump_config, load_config
    from ccatp.studies.bench import run_bench, tables, write_page

    cfg = load_config(config_file, settings)
    with tempfile.TemporaryDirectory(prefix="ccatp-bench-") as folder:
        exact = Path(folder) / "config.toml"
        exact.write_text(dump_config(cfg), encoding="utf-8")
        run_args = ("--config", str(exact))
        result = run_bench(cfg, quick=quick, run_args=run_args, frames=not steps_only, steps=not frames_only)
    if markdown is not None:
        write_page(markdown, result)
    common.print_result(result, tables(result).splitlines(), json_output)
    return 0
