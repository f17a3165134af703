"""Missions among beacons through the real processes, against the same missions in one process."""

import json
import sqlite3
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from ccatp.config.load import load_radio_config
from ccatp.config.package import configs_dir
from ccatp.records.recorder import iter_messages
from ccatp.studies.mote_navigation import rehearse_beacons
from tests.processes.conftest import Run

SHORT = {
    "zigbee": ("mission.laps=1",),
    "follow": ("mission.follow_s=15",),
    "cricket": ("cricket.ranging.repeats=4", "workspace.loops=false", "workspace.waypoints_m=[[2.5, 1.5]]"),
}


class BeaconRunProcess(Run):
    """``ccatp run --sim`` of a mission among beacons."""

    free_ports = ("--set", "sim.robot.port=0", "--set", "dashboard.enabled=false")


Begin = Callable[..., BeaconRunProcess]


@pytest.fixture
def begin(tmp_path: Path, runtime_dir: Path) -> Iterator[Begin]:
    runs: list[BeaconRunProcess] = []

    def start(system: str, *args: str) -> BeaconRunProcess:
        config = ("--config", str(configs_dir() / f"{system}.toml"))
        runs.append(BeaconRunProcess(tmp_path / "run", runtime_dir, *config, *args))
        return runs[-1]

    yield start
    for run in runs:
        run.end()


@pytest.mark.parametrize("system", SHORT)
def test_the_daemon_does_what_the_rehearsal_does(begin: Begin, system: str) -> None:
    settings = [part for setting in SHORT[system] for part in ("--set", setting)]
    run = begin(system, *settings, "--json")
    assert run.wait() == 0, run.stderr
    summary = json.loads(run.stdout)
    assert summary == run.summary
    expected = rehearse_beacons(load_radio_config(run.run_dir / "config.toml")).summary
    for told in (summary, expected):
        del told["wall"]
    assert summary == expected
    topics = {message.topic for message in iter_messages(run.run_dir / "telemetry.mcap")}
    assert {"beacon_track", "beacon_map", "beacon_truth", "beacon_places", "sensors", "mission"} <= topics
    assert (run.run_dir / "log.jsonl").stat().st_size


def test_an_operator_pauses_resumes_and_aborts(begin: Begin) -> None:
    run = begin("zigbee", "--set", "mission.laps=50", "--set", "mission.time_limit_s=1e5")
    run.until(lambda status: status["done"] >= 2)
    assert run.ask("pause")["status"]["state"] == "held"
    with sqlite3.connect(f"file:{run.run_dir / 'mission.sqlite'}?mode=ro", uri=True) as db:
        assert db.execute("SELECT count(*) FROM waypoint WHERE reached_s NOTNULL").fetchone()[0] >= 2
    db.close()
    assert run.ask("resume")["ok"]
    run.until(lambda status: status["state"] == "visiting")
    assert run.ask("abort")["ok"]
    assert run.wait() == 3, run.stderr
    assert run.summary["outcome"] == "aborted, at base"


def test_silence_of_all_radios_ends_held(begin: Begin, tmp_path: Path) -> None:
    config = tmp_path / "silent.toml"
    config.write_text(
        'system = "zigbee"\n[danger]\nhold_limit_s = 2.0\n[[sim.incidents]]\n'
        'type = "radio_loss"\nat_s = 10.0\nfor_s = 1000.0\nbeacons = []\n',
        encoding="utf-8",
    )
    run = begin("zigbee", "--config", str(config))
    assert run.wait() == 4, run.stderr
    assert "no radio is heard" in run.stderr
    assert run.summary["danger"] == {"radio": 1}


def test_what_a_mission_among_beacons_has_not_is_refused(begin: Begin) -> None:
    run = begin("zigbee", "--resume")
    assert run.wait() == 2
    assert "its map is not kept" in run.stderr
