"""Run directories as ``ccatp align`` reads them, made from what a test measured."""

from collections.abc import Iterable, Mapping
from pathlib import Path

import msgspec

from ccatp.config.load import dump_config
from ccatp.config.models import Config
from ccatp.core import DeckPose, PanelId, PointId
from ccatp.links.topics import TOPICS, Misalignment, schema_of
from ccatp.mirror.misalignment import PanelMisalignment
from ccatp.mirror.panel_alignment import Measured
from ccatp.records.recorder import Recorder
from ccatp.records.store import MissionStore, StoredPoint

HERE = DeckPose(0.0, 0.0, 0.0)


def recorder_in(run_dir: Path, metadata: Mapping[str, str] | None = None, *, is_simulation: bool = True) -> Recorder:
    """A recorder of all topics."""
    topics = [(topic.name, schema_of(topic.name)) for topic in TOPICS if topic.recorded]
    return Recorder(run_dir / "telemetry.mcap", topics, is_simulation=is_simulation, metadata=metadata)


def make_run(
    run_dir: Path,
    cfg: Config,
    planned: Iterable[PointId],
    measured: Iterable[Measured],
    truth: Mapping[PanelId, PanelMisalignment] | None,
) -> Path:
    """A run directory: configuration, database, and a recording where the truth is known."""
    run_dir.mkdir(exist_ok=True)
    (run_dir / "config.toml").write_text(dump_config(cfg))
    points = [StoredPoint(point, 0.0, 0.0) for point in planned]
    with MissionStore.create(
        run_dir / "mission.sqlite", mirror=cfg.mirror.name, seed=cfg.run.seed, config_toml="", points=points
    ) as store:
        for done in [store.record_fix(one.point, one.fix, HERE) for one in measured]:
            done.result()
    if truth is not None:
        record_truth(run_dir, truth)
    return run_dir


def record_truth(run_dir: Path, truth: Mapping[PanelId, PanelMisalignment], *, is_simulation: bool = True) -> None:
    """One more recording in a run directory that holds how the panels lie, and a batch of truth after it."""
    recorder = recorder_in(run_dir, is_simulation=is_simulation)
    panels = [(*panel, m.piston_m, m.tip_rad, m.tilt_rad) for panel, m in truth.items()]
    recorder.write("misalignment", 0.0, msgspec.json.encode(Misalignment(seq=0, t_s=0.0, panels=panels)))
    recorder.write("truth", 1.0, b'{"seq":0,"t_s":0.0,"rows":[]}')
    recorder.close()
