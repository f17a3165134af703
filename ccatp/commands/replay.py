"""Glue. The command ``ccatp replay``."""

import json
import os
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ccatp.commands.frame import JSON_OPTION, OutputFile, complain, example, overrides, settings_option
from ccatp.errors import CcatpError, ConfigError, ExitStatus

if TYPE_CHECKING:
    from ccatp.config.models import Config
    from ccatp.replaying.judging import Judged
    from ccatp.run_files.run_reader import Recording

# The sections of the configuration that a localizer is built from. Everything else has acted on the run already.
ACTING = ("localizer.", "robot.", "mirror.", "run.filter")
PROGRESS_S = 50.0


class ReplayError(CcatpError):
    """A run that cannot be replayed."""

    exit_status = ExitStatus.USAGE


@click.command(
    epilog=example(
        "ccatp replay runs/tonight",
        "ccatp replay runs/tonight --filter ukf --smooth",
        "ccatp replay runs/tonight --set localizer.full_state.fix_gate_nis=20 --out track.csv",
    )
)
@click.argument("run_dir", type=click.Path(path_type=Path))
@click.option("--filter", "filter_name", metavar="NAME", help="State estimator, if not that of the run: kf, ekf, ukf.")
@settings_option("A key of localizer, robot or mirror, as in localizer.full_state.fix_gate_nis=20.")
@click.option("--smooth", is_flag=True, help="Go back over the run with the smoother, too (not with kf).")
@click.option("--out", type=OutputFile(), help="Write the estimates of all frames (CSV).")
@JSON_OPTION
def replay(
    run_dir: Path, filter_name: str | None, settings: Mapping[str, object], smooth: bool, out: Path | None,
    json_output: bool,
) -> int:  # fmt: skip
    """Run an estimator again over the recorded samples of a run, as it was or with other settings."""
    # As in the run itself: matrices are small, and another number of threads may round differently.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from ccatp.replaying.judging import judge
    from ccatp.replaying.table import csv_lines, table_lines
    from ccatp.run_files.run_reader import open_run

    changes = overrides(settings, {"run.filter": filter_name})
    recordings = open_run(run_dir)
    configs = [_config(recording, changes, smooth) for recording in recordings]
    started = time.monotonic()
    parts = [_judged(recording, cfg, smooth) for recording, cfg in zip(recordings, configs, strict=True)]
    result = {
        "run_dir": str(run_dir),
        **_facts(recordings, configs, parts, changes),
        **judge(parts),
        "warnings": [warning for recording in recordings for warning in recording.warnings],
        "wall": {"time_s": round(time.monotonic() - started, 3)},
    }
    for warning in result["warnings"]:
        complain(f"warning: {warning}", 0)
    if out is not None:
        _write(out, csv_lines(parts))
    is_as_it_was = result["difference"]["reproduced"]
    may_differ = bool(changes or result["warnings"])
    lines = [*_head(result), *table_lines(result)]
    if is_as_it_was or may_differ:
        lines.append(f"the replay {'reproduces' if is_as_it_was else 'differs from'} the recorded estimates")
    for line in [json.dumps(result)] if json_output else lines:
        click.echo(line)
    if is_as_it_was or may_differ:
        return ExitStatus.COMPLETE
    why = "was the run made by another version, or on another CPU?"
    return complain(f"{run_dir}: the replay does not reproduce the recorded estimates: {why}", ExitStatus.REFUSED)


def _config(recording: "Recording", changes: Mapping[str, object], smooth: bool) -> "Config":
    from ccatp.replaying.player import has_smoother

    cfg = recording.config(changes)
    if idle := [key for key in changes if not key.startswith(ACTING)]:
        raise ConfigError(f"command line: {idle[0]}: has no effect on a replay; what has: localizer, robot, mirror")
    if smooth and not has_smoother(cfg):
        raise ConfigError(f"--smooth: the pose is no state of filter {cfg.run.filter}; choose --filter ekf or ukf")
    return cfg


def _judged(recording: "Recording", cfg: "Config", smooth: bool) -> "Judged":
    from ccatp.filters import FilterError
    from ccatp.mirror.errors import MirrorError
    from ccatp.mirror.mirror import build_mirror
    from ccatp.replaying.events import in_order
    from ccatp.replaying.judging import Judged
    from ccatp.replaying.player import replay as play

    mirror = build_mirror(cfg.mirror)
    try:
        replayed = play(cfg, mirror, in_order(recording.messages()), smooth=smooth, on_frame=_progress())
    except (FilterError, MirrorError) as error:
        raise ReplayError(f"{recording.path}: the estimator gave up: {error}; try other settings") from error
    if not len(replayed.trace.seq):
        why = f" ({recording.warnings[-1]})" if recording.warnings else ""
        raise ReplayError(f"{recording.path}: no sensors frames in it{why}")
    return Judged(replayed, recording.recorded(mirror), recording.truth(), recording.arrival_frames(), mirror)


def _facts(
    recordings: Sequence["Recording"], configs: Sequence["Config"], parts: Sequence["Judged"],
    changes: Mapping[str, object],
) -> dict[str, Any]:  # fmt: skip
    traces = [part.replayed.trace for part in parts]
    outcomes = [part.replayed for part in parts]
    first = next((outcome.first_difference for outcome in outcomes if outcome.first_difference), None)
    return {
        "mirror": configs[-1].mirror.name,
        "world": configs[-1].world.name if recordings[-1].is_simulation else None,
        "seed": configs[-1].run.seed,
        "recordings": len(recordings),
        "frames": sum(len(trace.seq) for trace in traces),
        "span_s": round(sum(float(trace.t_s[-1] - trace.t_s[0]) for trace in traces), 3),
        "filter": configs[-1].run.filter,
        "settings": dict(changes),
        "fixes": {
            "given": sum(outcome.fixes for outcome in outcomes),
            "refused": sum(outcome.refused for outcome in outcomes),
            "set_aside": sum(outcome.set_aside for outcome in outcomes),
            "first_difference": None if first is None else {"t_s": first[0], "said": first[1]},
        },
        "counts": _summed([outcome.counts for outcome in outcomes]),
    }


def _summed(counts: Iterable[Mapping[str, int]]) -> dict[str, int]:
    total: dict[str, int] = {}
    for one in counts:
        for name, number in one.items():
            total[name] = total.get(name, 0) + number
    return total


def _head(result: Mapping[str, Any]) -> list[str]:
    where = "real robot" if result["world"] is None else f"simulation, world {result['world']}, seed {result['seed']}"
    fixes = result["fixes"]
    per_frame_us = 1e6 * result["wall"]["time_s"] / result["frames"]
    changes = ", ".join(f"{key}={value}" for key, value in result["settings"].items()) or "as recorded"
    lines = [
        f"{result['run_dir']}: {result['mirror']}, {where}",
        f"{result['frames']} frames, {result['span_s']:.1f} s; filter {result['filter']}, settings: {changes}",
        f"{fixes['given']} fixes, {fixes['set_aside']} of them set aside in the run, {fixes['refused']} refused here; "
        f"{per_frame_us:.0f} us a frame",
    ]
    if (first := fixes["first_difference"]) is not None:
        what = f"is refused here: {first['said']}" if first["said"] else "is taken here and was refused in the run"
        lines.append(f"the fix of {first['t_s']:.2f} s {what}")
    return [*lines, ""]


def _progress() -> Callable[[float], None] | None:
    """Robot time on a terminal, now and then."""
    if not sys.stderr.isatty():
        return None
    told_s = float("-inf")

    def tell(t_s: float) -> None:
        nonlocal told_s
        if t_s - told_s >= PROGRESS_S:
            told_s = t_s
            click.echo(f"\rreplayed {t_s:.0f} s \r", nl=False, err=True)

    return tell


def _write(path: Path, lines: Iterable[str]) -> None:
    try:
        with path.open("w", encoding="utf-8") as file:
            file.writelines(line + "\n" for line in lines)
    except OSError as error:
        raise ReplayError(f"--out: cannot write {path}: {error.strerror or error}") from error
