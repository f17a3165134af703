"""Missions among beacons through the real processes, against the same missions in one process."""

import json
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from ccatp.config.load import load_radio_config
from ccatp.config.package import configs_dir
from ccatp.records.recorder import iter_messages
from ccatp.studies.mote_navigation import rehearse_beacons
from tests.support.runs import Run

# A lap, a waypoint, a few seconds: what differs between daemon and rehearsal differs from the first frame on.
SHORT = {
    "zigbee": ("mission.laps=1",),
    "follow": ("mission.follow_s=6",),
    "cricket": ("cricket.ranging.repeats=4", "workspace.loops=false", "workspace.waypoints_m=[[2.5, 1.5]]"),
}
LONGER = {"follow": ("mission.follow_s=15",)}


class BeaconRun(Run):
    """`ccatp run --sim` of a mission among beacons."""

    free_ports = ("--set", "sim.robot.port=0", "--set", "dashboard.enabled=false")


Begin = Callable[..., BeaconRun]


@pytest.fixture
def begin(tmp_path: Path, runtime_dir: Path) -> Iterator[Begin]:
    with ExitStack() as stack:

        def start(system: str, *args: str) -> BeaconRun:
            config = ("--config", str(configs_dir() / f"{system}.toml"))
            return stack.enter_context(BeaconRun(tmp_path / "run", runtime_dir, *config, *args))

        yield start


@pytest.mark.parametrize(
    ("system", "settings"),
    [*SHORT.items(), *(pytest.param(*item, marks=pytest.mark.slow, id=f"longer {item[0]}") for item in LONGER.items())],
)
def test_the_daemon_does_what_the_rehearsal_does(begin: Begin, system: str, settings: tuple[str, ...]) -> None:
    run = begin(system, *(part for setting in settings for part in ("--set", setting)), "--json")
    assert run.wait() == 0, run.stderr
    summary = json.loads(run.stdout)
    assert summary == run.summary
    expected = rehearse_beacons(load_radio_config(run.run_dir / "config.toml")).summary
    assert {**summary, "wall": None} == {**expected, "wall": None}
    topics = {message.topic for message in iter_messages(run.run_dir / "telemetry.mcap")}
    assert {"beacon_track", "beacon_map", "beacon_truth", "beacon_places", "sensors", "mission"} <= topics
    assert (run.run_dir / "log.jsonl").stat().st_size


def test_an_operator_pauses_resumes_and_aborts(begin: Begin) -> None:
    run = begin("zigbee", "--set", "mission.laps=50", "--set", "mission.time_limit_s=1e5")
    run.until(lambda status: status["done"] >= 1)
    assert run.ask("pause")["status"]["state"] == "held"
    assert run.query("SELECT count(*) FROM waypoint WHERE reached_s NOTNULL")[0][0] >= 1
    assert run.ask("resume")["ok"]
    run.until_state("visiting")
    assert run.ask("abort")["ok"]
    assert run.wait() == 3, run.stderr
    assert run.summary["outcome"] == "aborted, at base"
