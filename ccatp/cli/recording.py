"""``ccatp recording info``, ``repair`` and ``export``."""

import json
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ccatp.cli import common
from ccatp.errors import ConfigError

if TYPE_CHECKING:
    from ccatp.config.models import Config
    from ccatp.mirror.mirror import Mirror
    from ccatp.records.recording_repair import RecordingFacts
    from ccatp.records.run_reader import Recording


@click.group(
    cls=common.CommandGroup,
    epilog=common.example(
        "ccatp recording info runs/tonight", "ccatp recording export runs/tonight --ros2 tonight_bag"
    ),
)
def recording() -> None:
    """Show what recordings hold, repair damaged ones, and write them for other tools."""


@recording.command(
    epilog=common.example(
        "ccatp recording info runs/tonight", "ccatp recording info runs/tonight/telemetry.mcap --json"
    )
)
@click.argument("path", metavar="FILE|RUN_DIR", type=common.PATH)
@common.json_option("As JSON on standard output, nothing else there.")
def info(path: Path, json_output: bool) -> int:
    """Show what a recording holds, and whether every checksum in it is right.

    The exit status is 1 if a recording was cut off or is damaged; ccatp recording repair saves what is intact. A
    recording that a run still writes has no index yet; this is not damage.
    """
    from ccatp.records.recording_repair import read_facts, recording_files

    found = [read_facts(file) for file in recording_files(path)]
    if json_output:
        click.echo(json.dumps({"recordings": [facts.as_json() for facts in found]}))
    else:
        for facts in found:
            _print_facts(facts)
    return int(not all(facts.is_in_order for facts in found))


@recording.command(
    epilog=common.example(
        "ccatp recording repair runs/tonight", "ccatp recording repair telemetry.mcap --out saved.mcap"
    )
)
@click.argument("path", metavar="FILE|RUN_DIR", type=common.PATH)
@click.option("--out", type=common.OutputFile(), help="The new file; FILE.recovered.mcap if not given.")
@common.json_option("As JSON on standard output, nothing else there.")
def repair(path: Path, out: Path | None, json_output: bool) -> int:
    """Save what is intact of a recording that was cut off or damaged, as a new file with an index.

    The old file stays as it is. Of a run directory the newest recording is taken.
    """
    from ccatp.records.recording_repair import recording_files, recover

    file = recording_files(path)[-1]
    saved = recover(file, out or file.with_name(f"{file.stem}.recovered{file.suffix}"))
    lost = saved.condition.lost_bytes
    if json_output:
        facts = {"file": str(saved.path), "messages": saved.messages, "end_s": saved.end_s, "lost_bytes": lost}
        click.echo(json.dumps({**facts, "was_complete": saved.condition.is_complete}))
        return 0
    until = "" if saved.end_s is None else f" up to {saved.end_s:.2f} s"
    state = "was complete" if saved.condition.is_complete else f"{lost} of {saved.condition.size_bytes} bytes are lost"
    click.echo(f"{saved.path}: {saved.messages} messages{until}; {file} {state}")
    return 0


@recording.command(
    epilog=common.example(
        "ccatp recording export runs/tonight --tum estimate.tum --truth truth.tum",
        "evo_ape tum truth.tum estimate.tum",
        "ccatp recording export runs/tonight --ros2 tonight_bag",
    )
)
@click.argument("path", metavar="FILE|RUN_DIR", type=common.PATH)
@click.option("--tum", "tum_file", type=common.OutputFile(), help="File for the estimates, a TUM trajectory.")
@click.option("--truth", "truth_file", type=common.OutputFile(), help="File for the simulated truth, a TUM trajectory.")
@click.option(
    "--ros2", "bag_dir", type=common.OutputFolder(), help="New directory for a ROS 2 bag (MCAP; extra ccatp[ros])."
)
def export(path: Path, tum_file: Path | None, truth_file: Path | None, bag_dir: Path | None) -> None:
    """Write a recorded survey for other tools.

    A TUM trajectory is the path for evo and others: deck frame, m, and mission time, which is the robot's clock until
    it restarts or steps. A ROS 2 bag has every sample as a message of its own, for ROS, Foxglove and PlotJuggler: frame
    map (the deck), SI units, UTC. Of a run that was resumed the newest recording with frames is taken.
    """
    from ccatp.mirror.mirror import build_mirror
    from ccatp.records.recorder import iter_messages
    from ccatp.records.run_reader import format_tum, open_recordings

    if not (tum_file or truth_file or bag_dir):
        raise click.UsageError("nothing to write; give --tum, --truth or --ros2")
    newest = open_recordings(path)[-1]
    if not any(message.topic == "sensors" for message in iter_messages(newest.path)):
        raise ConfigError(f"{newest.path}: no sensors frames in it, so there is nothing to export")
    cfg = newest.config({})
    mirror = build_mirror(cfg.mirror)
    if bag_dir is not None:
        counts = _write_bag(bag_dir, newest, cfg, mirror)
        click.echo(f"{bag_dir}: {', '.join(f'{topic} {count}' for topic, count in counts.items())}")
    if tum_file or truth_file:
        if bag_dir is None:
            for _ in newest.messages():
                pass
        truth = newest.truth()
        if truth_file is not None and truth is None:
            raise ConfigError(f"--truth: {newest.path} is of a real robot and holds no truth; leave it out")
        for option, file, trace in (("--tum", tum_file, newest.recorded(mirror)), ("--truth", truth_file, truth)):
            if file is not None and trace is not None:
                common.write_lines(option, file, format_tum(trace).splitlines())
                click.echo(f"{file}: {len(trace.seq)} poses")
    common.warn((*newest.notes, *newest.warnings))


def _write_bag(folder: Path, recording: "Recording", cfg: "Config", mirror: "Mirror") -> dict[str, int]:
    from shutil import rmtree

    from ccatp.filters.base import FilterError
    from ccatp.mirror.surface import MirrorError

    if folder.exists():
        raise ConfigError(f"--ros2: {folder} exists already; name a new directory")
    try:
        from ccatp.studies.ros_bag import write_bag

        return write_bag(folder, recording, cfg, mirror)
    except ModuleNotFoundError as error:
        raise ConfigError("--ros2 needs rosbags; install it with: pip install ccatp[ros]") from error
    except (FilterError, MirrorError) as error:
        raise ConfigError(f"--ros2: {recording.path}: the estimator gave up in the replay: {error}") from error
    except OSError as error:
        rmtree(folder, ignore_errors=True)
        raise ConfigError(f"--ros2: cannot write {folder}: {error.strerror or error}") from error


def _print_facts(facts: "RecordingFacts") -> None:
    condition, span = facts.condition, facts.span_s
    click.echo(f"{facts.path}: {facts.state}")
    for begin, end in () if facts.is_in_order else condition.lost:
        click.echo(f"  bytes {begin} to {end} are lost")
    known = {k: v for record in facts.metadata.values() for k, v in record.items() if k != "config"}
    if known:
        click.echo("  " + ", ".join(f"{key} {value}" for key, value in sorted(known.items())))
    if span is not None:
        rate = facts.bytes_per_hour
        per_hour = "" if rate is None else f", {rate / 1e6:.1f} MB an hour"
        clock = "mission time" if facts.mission_s else "the robot's clock"
        utc = f" of {clock}, {' to '.join(facts.utc)}" if facts.utc else ""
        click.echo(f"  {span[0]:.2f} to {span[1]:.2f} s{utc}, {condition.size_bytes / 1e6:.2f} MB{per_hour}")
    common.print_lines(f"  {note}" for note in facts.notes)
    click.echo(f"  {facts.messages} messages in {condition.chunks} chunks")
    rows = [("topic", "schema", "messages", "per s", "kB")]
    for name, topic in sorted((name, topic) for name, topic in facts.topics.items() if topic.messages):
        start_s, end_s = facts.mission_s or (topic.start_s or 0.0, topic.end_s or 0.0)
        length_s = end_s - start_s
        per_s = f"{(topic.messages - 1) / length_s:.2f}" if topic.messages > 1 and length_s > 0.0 else "-"
        rows.append((name, topic.schema, str(topic.messages), per_s, f"{topic.payload_bytes / 1e3:.1f}"))
    common.print_lines(f"  {line}" for line in common.columns(rows, left=2))
    if empty := sum(not topic.messages for topic in facts.topics.values()):
        click.echo(f"  {empty} topic{'s' if empty > 1 else ''} without messages")
    if facts.is_in_order:
        return
    for fault in facts.faults:
        click.echo(f"  {fault}")
    click.echo(f"  save what is intact with: ccatp recording repair {facts.path}")
