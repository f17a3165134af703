"""Run directories of missions among beacons, made of messages whose figures are known."""

import json
from pathlib import Path
from typing import Any

import msgspec

from ccatp.config.beacon_models import RadioConfig
from ccatp.config.load import dump_config, load_radio_config
from ccatp.links.topics import (
    BeaconArrival,
    BeaconMapMessage,
    BeaconPlaces,
    BeaconTrack,
    BeaconTruth,
    Message,
    MissionStatus,
    schema_of,
)
from ccatp.records.recorder import Recorder

FRAMES, PERIOD_S = 61, 0.1
SIGMA_M, OFF_M = 0.02, 0.03  # of the estimate; the truth lies so far to the right of it
ELLIPSE = (SIGMA_M**2, 0.0, SIGMA_M**2)
PLACES = {"beacon1": (0.0, 0.0), "beacon2": (3.0, 3.0)}
TOPICS = (
    "beacon_track", "beacon_truth", "beacon_map", "beacon_arrival", "beacon_places", "mission"
)  # fmt: skip


def beacon_config(system: str = "zigbee") -> RadioConfig:
    return load_radio_config(None, {"system": system, "mission.laps": 1, "run.seed": 5})


def place(frame: int) -> tuple[float, float]:
    """Where the robot believes to be."""
    return 0.8 + 0.02 * frame, 0.8


def beacon_map(frame: int, cfg: RadioConfig) -> BeaconMapMessage:
    """The map after a frame: beacon1 is 0.1 m off, beacon2 is right; each map adds 2 readings of NIS 3."""
    beacons = {"beacon1": (0.1, 0.0, 0.01, 0.0, 0.0025), "beacon2": (3.0, 3.0, 0.01, 0.002, 0.01)}
    target = None
    if cfg.follow.is_active:
        target = (place(frame)[0] + 1.0, 0.8, 0.01, 0.0, 0.01)
        beacons["target"] = target
    told = frame // 5
    return BeaconMapMessage(
        seq=frame, t_s=PERIOD_S * frame, system=cfg.system, pose=(*place(frame), 0.0),
        pose_ellipse=(*place(frame), *ELLIPSE), beacons=beacons, target=target, obstacles=[(1.0, 2.0)],
        waypoints=[] if cfg.follow.is_active else list(cfg.workspace.waypoints_m), next_waypoint=1,
        distances=[1.5, 0.9], nis_sum=3.0 * told, nis_size=2 * told, refused=1, notes={},
    )  # fmt: skip


def track_row(frame: int) -> tuple[float, ...]:
    variance = SIGMA_M**2
    return (
        frame, PERIOD_S * frame, *place(frame), 0.0, variance, 0.0, variance, 0.0, 0.0, 1e-4, place(frame)[0], 0.9
    )  # fmt: skip


def truth_row(frame: int, *, has_target: bool = False) -> tuple[float | None, ...]:
    x, y = place(frame)
    target = (x + 1.0, y) if has_target else (None, None)
    return frame, PERIOD_S * frame, x, y - OFF_M, 0.0, *target, None


def status(outcome: str = "complete") -> MissionStatus:
    return MissionStatus(seq=60, t_s=6.0, state="done", done=1, total=4, elapsed_s=6.0, outcome=outcome, exit_status=0)


def record_beacons(run_dir: Path, cfg: RadioConfig | None = None, *, is_sim: bool = True, ends: bool = True) -> Path:
    """A run directory; without an end as after ``kill -9``."""
    cfg = cfg or beacon_config()
    run_dir.mkdir(exist_ok=True)
    (run_dir / "config.toml").write_text(dump_config(cfg))
    recorder = Recorder(
        run_dir / "telemetry.mcap",
        [(name, schema_of(name)) for name in TOPICS],
        is_simulation=is_sim,
        metadata={"system": cfg.system, "ccatp": "9.9"},
    )

    def write(topic: str, message: Message) -> None:
        recorder.write(topic, message.t_s, msgspec.json.encode(message))

    rows: Any = [track_row(frame) for frame in range(FRAMES)]
    if is_sim:
        write("beacon_places", BeaconPlaces(seq=0, t_s=0.0, places=PLACES))
        true: Any = [truth_row(frame, has_target=cfg.follow.is_active) for frame in range(FRAMES)]
        write("beacon_truth", BeaconTruth(seq=60, t_s=6.0, rows=true))
    write("beacon_track", BeaconTrack(seq=30, t_s=3.0, rows=rows[:31]))
    write("beacon_track", BeaconTrack(seq=60, t_s=6.0, rows=rows[30:]))  # a frame that is told twice
    for frame in range(0, FRAMES, 5):
        write("beacon_map", beacon_map(frame, cfg))
    if not cfg.follow.is_active:
        arrived = BeaconArrival(
            seq=10, t_s=1.0, waypoint=0, lap=0, place=cfg.workspace.waypoints_m[0], estimate=(*place(10), *ELLIPSE)
        )
        write("beacon_arrival", arrived)
    write("mission", status() if ends else msgspec.structs.replace(status(), state="visiting", outcome=""))
    recorder.close()
    (run_dir / "log.jsonl").write_text(
        '{"process":"supervisor","event":"run","level":"info","wall":"2026-11-22T05:00:00Z"}\n'
        '{"process":"main","event":"held: <b>near</b>","level":"warning","wall":"2026-11-22T05:00:01Z","t_s":0.7}\n'
    )
    if ends:
        (run_dir / "summary.json").write_text(
            json.dumps({"outcome": "complete", "cause": "", "danger": {"obstacle": 1}, "target": None})
        )
    return run_dir
