"""Edge. Reads a run directory for a report: a run that is complete, goes on, was killed, resumed or is of a real robot.

What cannot be read is told and left out; only a directory that is no run at all, or a configuration that this program
cannot use, is refused. Nothing is written.
"""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from ccatp.aligning.deviations import Measured
from ccatp.config.loader import load_config
from ccatp.config.models import Config
from ccatp.config.radio_loader import is_radio_file
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.reporting.record import PlannedRow, RunRecord, Session, changed_keys
from ccatp.run_files.recorder import read_metadata, recordings
from ccatp.run_files.run_reader import CONFIG, TELEMETRY, RunReadError
from ccatp.run_files.session_reader import read_session
from ccatp.run_files.state_log import ReadLine, changes_of, read_log
from ccatp.run_files.survey_reader import STORE, read_truth
from ccatp.storage.store_reader import read_survey
from ccatp.storage.store_rows import StoreError, point_name

SUMMARY, LOG = "summary.json", "log.jsonl"


def read_record(run_dir: Path) -> RunRecord:
    """Everything that a report tells of a run.

    Raises:
        RunReadError: no such directory, no run in it, or none of a survey.
        ConfigError: its configuration cannot be used.
    """
    if is_beacon_run(run_dir):
        raise RunReadError(f"{run_dir}: a mission among beacons; this is for surveys, ccatp report takes both")
    cfg = load_config(run_dir / CONFIG)
    mirror = build_mirror(cfg.mirror)
    missing: list[str] = []
    warnings: list[str] = []
    log = list(read_log(run_dir / LOG, warnings))
    if not log:
        missing.append(f"{LOG}: what the processes said, and when the mission changed its state")
    sessions, is_simulation = _sessions(run_dir, mirror, log, missing, warnings)
    points, measured = _survey(run_dir, mirror, missing, warnings)
    injected, _ = read_truth(run_dir, warnings)
    return RunRecord(
        name=run_dir.resolve().name,
        cfg=cfg,
        config_text=(run_dir / CONFIG).read_text(encoding="utf-8", errors="replace"),
        changed=_changed(cfg),
        mirror=mirror,
        is_simulation=is_simulation,
        summary=read_summary(run_dir / SUMMARY, missing, warnings),
        sessions=sessions,
        points=points,
        measured=measured,
        injected=injected,
        log=tuple(line.shown for line in log if line.shown is not None),
        files=files_of(run_dir),
        missing=tuple(missing),
        warnings=tuple(warnings),
    )


def is_beacon_run(run_dir: Path) -> bool:
    """Whether a run is a mission among beacons.

    Raises:
        RunReadError: no such directory, or no run in it.
        ConfigError: its configuration cannot be read.
    """
    if not run_dir.is_dir():
        raise RunReadError(f"{run_dir}: no such directory; name the directory of a run")
    if not (run_dir / CONFIG).is_file():
        raise RunReadError(f"{run_dir}: no {CONFIG} there; name the directory of a run")
    return is_radio_file(run_dir / CONFIG)


def _changed(cfg: Config) -> dict[str, tuple[object, object]]:
    """Keys other than as shipped, but for mirror and world, which have names of their own."""
    own = {"mirror", "world"}
    ours, shipped = (one.model_dump(mode="json", exclude=own) for one in (cfg, load_config()))
    return changed_keys(ours, shipped)


def _sessions(
    run_dir: Path, mirror: Mirror, log: list[ReadLine], missing: list[str], warnings: list[str]
) -> tuple[tuple[Session, ...], bool | None]:
    paths = recordings(run_dir / TELEMETRY)
    if not paths:
        missing.append(f"{TELEMETRY}: path, estimates, arrivals and fixes over time")
        return (), None
    sessions, is_simulation = [], None
    for path, changes in zip(paths, changes_of(log, len(paths)), strict=True):
        try:
            is_simulation = {"true": True, "false": False}.get(read_metadata(path).get("simulation", ""), is_simulation)
            sessions.append(read_session(path, mirror, changes, warnings))
        except OSError as error:
            warnings.append(f"{path.name}: cannot be read: {error.strerror or error}")
    if log and not all(session.changes for session in sessions):
        missing.append("the frames of each change of state: the time budget is taken from the status, which is coarser")
    if is_simulation and not any(session.truth for session in sessions):
        missing.append("the simulated truth: errors are those that the laser saw")
    return tuple(sessions), is_simulation


def _survey(
    run_dir: Path, mirror: Mirror, missing: list[str], warnings: list[str]
) -> tuple[tuple[PlannedRow, ...] | None, tuple[Measured, ...]]:
    if not (run_dir / STORE).is_file():
        missing.append(f"{STORE}: points, their fixes, and how the panels lie")
        return None, ()
    try:
        stored = read_survey(run_dir / STORE, mirror.name)
    except StoreError as error:
        warnings.append(str(error).replace(f"{run_dir}/", ""))
        return None, ()
    warnings += [
        f"point {point_name(point)}: its stored fix is damaged and left out; measure it again"
        for point in stored.damaged
    ]
    points = tuple(PlannedRow(row.point, row.status, row.t_s) for row in stored.points)
    return points, tuple(Measured(one.point, one.fix) for one in stored.fixes)


def read_summary(path: Path, missing: list[str], warnings: list[str]) -> Mapping[str, Any] | None:
    """``summary.json``; None where there is none, or none that can be read, and a line that says so."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        missing.append(f"{path.name}: the run goes on, or was killed before its end")
        return None
    except (OSError, ValueError) as error:
        warnings.append(f"{path.name}: cannot be read: {error}")
        return None
    if not isinstance(found, dict):
        warnings.append(f"{path.name}: is no summary")
        return None
    return found


def files_of(run_dir: Path) -> dict[str, int]:
    """Names and sizes in bytes of what a run wrote."""
    return dict(_files(run_dir))


def _files(run_dir: Path) -> Iterator[tuple[str, int]]:
    for path in sorted(run_dir.iterdir()):
        # The report is no part of the run: it is the same when it is made again.
        if path.is_file() and not path.name.startswith(".") and path.suffix != ".html":
            yield path.name, path.stat().st_size
