"""What the alignment of a mirror is computed from: configuration, fixes, and the truth where it is known."""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from ccatp.config.load import load_config
from ccatp.config.models import Config
from ccatp.core import PanelId, PointId, Vector3
from ccatp.links.topics import BadMessage, Misalignment, unpack
from ccatp.mirror.panel_alignment import Measured
from ccatp.records.recorder import iter_messages, read_metadata, recordings
from ccatp.records.run_reader import CONFIG, TELEMETRY, RunReadError
from ccatp.records.store import read_survey
from ccatp.records.store_rows import StoreError, point_name

STORE = "mission.sqlite"
Injected = dict[PanelId, Vector3]


class Survey(NamedTuple):
    """A run's survey.

    Attributes:
        injected: piston (m), tip and tilt (rad) of the simulated panels; None on a real robot or where nothing tells.
    """

    cfg: Config
    planned: tuple[PointId, ...]
    measured: tuple[Measured, ...]
    injected: Injected | None
    is_simulation: bool | None
    warnings: tuple[str, ...]


def read_run(run_dir: Path, overrides: Mapping[str, object]) -> Survey:
    """Read the survey of a run directory; nothing in it is changed.

    Args:
        overrides: dotted keys of the configuration, stronger than the run's own.

    Raises:
        RunReadError: no such directory, or no run in it, or a database that cannot be read.
        ConfigError: its configuration cannot be used.
    """
    if not run_dir.is_dir():
        raise RunReadError(f"{run_dir}: no such directory; name the directory of a run")
    if not (run_dir / CONFIG).is_file():
        raise RunReadError(f"{run_dir}: no {CONFIG} there; name the directory of a run")
    cfg = load_config(run_dir / CONFIG, overrides)
    try:
        stored = read_survey(run_dir / STORE, cfg.mirror.name)
    except StoreError as error:
        raise RunReadError(str(error)) from error
    warnings = [
        f"point {point_name(point)}: its stored fix is damaged and left out; measure it again"
        for point in stored.damaged
    ]
    injected, is_simulation = read_truth(run_dir, warnings)
    return Survey(
        cfg=cfg,
        planned=tuple(row.point for row in stored.points),
        measured=tuple(Measured(one.point, one.fix) for one in stored.fixes),
        injected=injected,
        is_simulation=is_simulation,
        warnings=tuple(warnings),
    )


def read_truth(run_dir: Path, warnings: list[str]) -> tuple[Injected | None, bool | None]:
    """How the panels were simulated to lie, and whether they were; what cannot be read is told in ``warnings``."""
    found: list[Injected] = []
    is_simulation: bool | None = None
    for path in recordings(run_dir / TELEMETRY):
        try:
            is_simulation = read_metadata(path).get("simulation") == "true"
            injected = _injected(path) if is_simulation else None
        except OSError as error:
            warnings.append(f"{path}: cannot be read: {error.strerror or error}; the truth is not compared")
            continue
        if injected is not None:
            found.append(injected)
    if any(one != found[0] for one in found):
        warnings.append("the sessions of this run simulated differently misaligned panels; the truth is not compared")
        return None, is_simulation
    return (found[0] if found else None), is_simulation


def _injected(path: Path) -> Injected | None:
    for topic, _, payload in iter_messages(path):
        if topic == "truth":  # told after the misalignment: an older recording, which does not have it
            return None
        if topic == "misalignment":
            return _decoded(topic.encode() + b" " + payload)
    return None


def _decoded(frame: bytes) -> Injected | None:
    try:
        message = unpack(frame)[2]
    except BadMessage:
        return None
    if not isinstance(message, Misalignment):
        return None
    return {PanelId(row, col): (piston, tip, tilt) for row, col, piston, tip, tilt in message.panels}
