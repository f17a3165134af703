"""``ccatp runs``: lists runs, their outcomes and the files in their directories."""

import json
import re
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import click

from ccatp.cli import common
from ccatp.errors import ConfigError, ExitStatus

# Files of a run directory and their descriptions.
FILES = {
    "summary.json": "the result",
    "report.html": "the report, for a browser",
    "mission.sqlite": "points and fixes",
    "telemetry.mcap": "recording, for ccatp replay, Foxglove and PlotJuggler",
    "log.jsonl": "log of all processes",
    "alarms.jsonl": "what happened to the alarms",
    "config.toml": "the exact configuration",
    "checkpoint": "state of a mission that can be resumed",
    "faults.toml": "faults that were injected",
    "origin.json": "whether it was simulated",
    "emergencies.json": "emergencies that are latched",
    "robot": "where the simulated robot stands",
}
_PART = re.compile(r"\.\d+\.mcap$")  # part of the recording, one for each session
# The line with the outcome of a run is among the last lines of its log.
_LAST_BYTES = 65_536


@click.group(
    cls=common.CommandGroup,
    epilog=common.example("ccatp runs list", "ccatp runs show runs/tonight", "ccatp runs rm --older-than 30"),
)
def runs() -> None:
    """List the runs in a folder, show one, and remove old ones."""


@runs.command("list", epilog=common.example("ccatp runs list", "ccatp runs list /var/lib/ccatp/runs --json"))
@click.argument("folder", type=common.PATH, default="runs")
@common.JSON_OPTION
def list_runs(folder: Path, json_output: bool) -> None:
    """List the runs in FOLDER, ./runs if not given, the oldest first."""
    if not folder.is_dir():
        raise ConfigError(f"{folder}: no such folder; name one that holds run directories")
    found = sorted((_facts(path.parent) for path in folder.glob("*/config.toml")), key=lambda run: run["began"])
    head = {"began": "began (UTC)", "state": "state", "points": "points", "size_mb": "MB", "what": "what", "run": "run"}
    lines = common.columns([[str(run[key]) for key in head] for run in (head, *found)])
    common.print_result({"runs": found}, lines if found else ["none"], json_output)


@runs.command("show", epilog=common.example("ccatp runs show runs/tonight"))
@click.argument("run_dir", type=common.PATH)
@common.JSON_OPTION
def show(run_dir: Path, json_output: bool) -> None:
    """Show how the run in RUN_DIR ended, and which files it left."""
    if not (run_dir / "config.toml").is_file():
        raise ConfigError(f"{run_dir}: no run directory (it has no config.toml); ccatp runs list shows them")
    facts = _facts(run_dir)
    files = {path.name: path.stat().st_size for path in sorted(run_dir.iterdir()) if path.is_file()}
    sizes = [
        f"{name:<24} {size / 1e6:10.3f} MB  {FILES.get(_PART.sub('.mcap', name), '')}".rstrip()
        for name, size in files.items()
        if not name.startswith(".") and not name.endswith(".new")  # temporary files of this program
    ]
    lines = [f"{name:<15} {value}" for name, value in facts.items() if value != ""]
    common.print_result({**facts, "files": files}, [*lines, "", *sizes], json_output)


@runs.command(
    "rm",
    epilog=common.example(
        "ccatp runs rm runs/20261126T033120Z-fyst-m1-s1", "ccatp runs rm --older-than 30 --keep 10 --yes"
    ),
)
@click.argument("run_dirs", metavar="[RUN_DIR]...", nargs=-1, type=common.PATH)
@click.option(
    "--older-than",
    "older_than_days",
    type=click.FloatRange(min=0.0),
    metavar="DAYS",
    help="The runs in --folder without a change for this many days.",
)
@click.option("--keep", type=click.IntRange(min=0), metavar="N", help="The runs in --folder, except the N newest ones.")
@click.option(
    "--folder", type=common.PATH, default="runs", show_default=True, help="Where --older-than and --keep look."
)
@click.option("--yes", is_flag=True, help="Do not ask.")
@click.option("--force", is_flag=True, help="Remove a named RUN_DIR also if it can be resumed.")
@common.JSON_OPTION
def remove_runs(
    run_dirs: tuple[Path, ...], older_than_days: float | None, keep: int | None, folder: Path, yes: bool, force: bool,
    json_output: bool,
) -> None:  # fmt: skip
    """Remove run directories: those named, or old ones.

    A run in progress is never removed, and one that can be resumed only if it is named with --force. Links, and folders
    that are no run, are refused.
    """
    from ccatp.daemon.supervision import run_removal as removal

    is_by_age = older_than_days is not None or keep is not None
    if bool(run_dirs) is is_by_age:
        raise click.UsageError("name run directories, or choose them by --older-than or --keep")
    if force and not run_dirs:
        raise click.UsageError("--force goes with named run directories")
    if run_dirs:
        refused = [f"{run_dir}: {why}" for run_dir in run_dirs if (why := removal.refusal(run_dir, force=force))]
        if refused:
            raise ConfigError(*refused, shows_all=True)  # nothing is removed
    elif not folder.is_dir():
        raise ConfigError(f"{folder}: no such folder; name one that holds run directories with --folder")
    chosen = run_dirs or removal.chosen_by_age(folder, older_than_days=older_than_days, keep=keep, now_s=time.time())
    sizes = {run_dir: removal.size_bytes(run_dir) for run_dir in chosen}
    total_mb = sum(sizes.values()) / 1e6
    if chosen and not yes:
        common.print_lines(f"{size / 1e6:10.1f} MB  {run_dir}" for run_dir, size in sizes.items())
        if not sys.stdin.isatty():
            raise ConfigError("nothing is removed: there is no terminal to ask; give --yes")
        click.confirm(f"Remove {_count(chosen)}, {total_mb:.1f} MB?", abort=True)
    for run_dir in chosen:
        removal.remove(run_dir, force=force)
    lines = [f"removed {_count(chosen)}, {total_mb:.1f} MB" if chosen else "no run is removed"]
    common.print_result({"removed": [str(run_dir) for run_dir in chosen], "mb": round(total_mb, 1)}, lines, json_output)


def _count(chosen: Sequence[Path]) -> str:
    return f"{len(chosen)} run{'s' * (len(chosen) != 1)}"


def _facts(run_dir: Path) -> dict[str, Any]:
    """The facts of one run; an unknown value is an empty text."""
    from ccatp.config.messages import parse_toml
    from ccatp.links.runtime_dir import RUN_LOCK, is_held
    from ccatp.survey.ending import read_ending

    events = list(_events(run_dir / "log.jsonl"))
    begun = next((event for event in events if event.get("event") == "run_started"), {})
    last: dict[str, Any] = next(
        (one for one in reversed(events) if one.get("event") in ("run_started", "run_finished")), {}
    )
    summary, origin = _read_json(run_dir / "summary.json"), _read_json(run_dir / "origin.json")
    ended, points = dict[str, Any](), dict[str, Any]()
    state = "running" if is_held(run_dir / RUN_LOCK) else "not finished"
    if last.get("event") == "run_finished" and state != "running":  # otherwise the summary is of an earlier session
        ended, points, ending = last, summary.get("points", {}), read_ending(summary)
        state = ExitStatus(last["status"]).name.lower() if ending is None else ending.what.replace("_", " ")
    try:
        system = parse_toml((run_dir / "config.toml").read_text(encoding="utf-8"), "").get("system", "")
    except (ConfigError, OSError, UnicodeDecodeError):
        system = ""
    where = {None: "", True: "simulated", False: "at a robot"}[origin.get("simulation")]
    what = [summary.get("mirror", begun.get("mirror", system)), summary.get("world", ""), where]
    return {
        "run": str(run_dir),
        "began": str(begun.get("timestamp", ""))[:19],
        "ended": str(ended.get("timestamp", ""))[:19],
        "state": state,
        "points": f"{points['measured']}/{points['total']}" if "measured" in points else "",
        "what": ", ".join(str(part) for part in what if part),
        "seed": begun.get("seed", ""),
        "size_mb": round(sum(path.stat().st_size for path in run_dir.iterdir() if path.is_file()) / 1e6, 1),
    }


def _read_json(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(path.read_bytes())
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def _events(path: Path) -> Iterator[dict[str, Any]]:
    """The first lines of a log and its last ones."""
    try:
        with path.open("rb") as file:
            head = file.read(_LAST_BYTES)
            file.seek(max(len(head), path.stat().st_size - _LAST_BYTES))
            lines = (head + file.read()).splitlines()
    except OSError:
        return
    for line in lines:
        try:
            event = json.loads(line)
        except ValueError:  # cut off
            continue
        if isinstance(event, dict):
            yield event
