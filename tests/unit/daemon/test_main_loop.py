"""What the main loop publishes as the end of the run."""

import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from enum import StrEnum
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import msgspec
import pytest
import zmq

from ccatp.beacons.modes import BeaconMode
from ccatp.conditions import text_of
from ccatp.config.load import load_config
from ccatp.core import NO_CAUSE
from ccatp.daemon.loops.main_loop import MainLoop
from ccatp.daemon.loops.mission_runner import MissionRunner
from ccatp.daemon.loops.standstill import STANDS_REPORT_S
from ccatp.daemon.operator.terminal import status_rows
from ccatp.daemon.supervision.process import Endpoints, ProcessArgs
from ccatp.errors import ConfigError, ExitStatus
from ccatp.links.topics import MissionStatus
from ccatp.survey.engagement import Engagement, Kind, Phase
from ccatp.survey.events import Interrupted, Mode, waits_for


@contextmanager
def main_loop(folder: Path, runner: SimpleNamespace) -> Iterator[MainLoop]:
    args = ProcessArgs(load_config(), folder, Endpoints(folder), None, is_realtime=False, is_resuming=False)
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    made = MainLoop(args, context, lambda _: cast(MissionRunner, runner))
    with closing(made.publisher), closing(made.peer), closing(made._alarms):
        yield made
    context.destroy(linger=0)


@pytest.fixture
def loop(tmp_path: Path) -> Iterator[MainLoop]:
    with main_loop(tmp_path, standing(Mode.IDLE, [])) as made:
        yield made


def test_a_run_that_ended_publishes_its_status(loop: MainLoop) -> None:
    assert loop.status().exit_status == -1
    loop.finish(ExitStatus.HELD)
    assert loop.status().exit_status == ExitStatus.HELD
    assert dict(status_rows(msgspec.to_builtins(loop.status())))["summary state"] == "enabled"


def test_the_status_shows_the_first_bad_line_while_bad_lines_are_counted(loop: MainLoop) -> None:
    assert "bad lines" not in dict(status_rows(msgspec.to_builtins(loop.status())))
    loop.session.link.counts["bad_lines"], loop.session.link.first_bad_line = 3, "imu: a number out of range"
    shown = dict(status_rows(msgspec.to_builtins(loop.status())))["bad lines"]
    what_to_do = "'ccatp conformance' checks the firmware"
    assert shown == f"3 from the robot, the first: imu: a number out of range; {what_to_do}"


def test_a_process_that_failed_publishes_no_end_of_the_run(loop: MainLoop) -> None:
    # Otherwise the run would end before the supervisor has seen the status of the process, or restarted it.
    loop._fail(ConfigError("the configuration is not of this robot"))
    assert loop.loop.over.is_set()
    assert loop.status().exit_status == -1


class Standing(Phase, frozen=True, tag=True):
    at: Mode | BeaconMode

    kind = Kind.WORK

    @property
    def mode(self) -> StrEnum:
        return self.at


def standing(mode: Mode | BeaconMode, said: list[str]) -> SimpleNamespace:
    """A runner whose robot stands in a mode, with nothing wrong."""
    telemetry = SimpleNamespace(
        flush=lambda _: None, send=lambda *_: None, seq=-1, notify_operator=lambda _, text: said.append(text)
    )
    return SimpleNamespace(
        telemetry=telemetry,
        mission=SimpleNamespace(state=Engagement(Standing(mode)), after=lambda _: None),
        causes=(),
        wait_cause=NO_CAUSE,
        is_at_rest=True,
        is_busy=False,
        since_s=0.0,
        on_drive=lambda *_: None,
        status=lambda: MissionStatus(seq=0, t_s=0.0, state=str(mode)),
    )


@pytest.mark.parametrize("mode", [*Mode, *BeaconMode])
def test_a_robot_that_stands_with_nothing_wrong_says_what_it_waits_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mode: Mode | BeaconMode
) -> None:
    said: list[str] = []
    now_s = 1000.0
    monkeypatch.setattr(time, "monotonic", lambda: now_s)
    with main_loop(tmp_path, standing(mode, said)) as loop:
        loop.heartbeat.phase = "joined"
        for _ in range(5):
            now_s += 0.3 * STANDS_REPORT_S
            loop.heartbeat.frame_s = now_s
            loop.on_heartbeat()
    assert said == [f"the robot has been stationary for 36 s: {mode}, and nothing is wrong: {waits_for(mode)}"]
    assert waits_for(mode)


def test_the_first_row_of_the_status_says_whose_turn_it_is(loop: MainLoop) -> None:
    shown = status_rows(msgspec.to_builtins(loop.status()))
    assert shown[0] == ("now", "about to continue. Next: the robot continues by itself")


def test_no_number_stands_still_while_frames_are_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now_s, begun_s = 1000.0, 1000.0
    monkeypatch.setattr(time, "monotonic", lambda: now_s)
    runner = standing(Mode.HELD, [])
    met: list[Interrupted] = []
    runner.mission.handle = met.append
    with main_loop(tmp_path, runner) as loop:
        loop.heartbeat.frame_s = begun_s
        lasted = []
        for age_s in (0.16, 4.0):
            now_s = begun_s + age_s
            loop.on_silence(age_s)
            status = msgspec.structs.replace(loop.status(), cause=text_of(met[-1].cause))
            lasted.append(dict(status_rows(msgspec.to_builtins(status)))["for"])
    assert [text_of(one.cause) for one in met] == ["no sensors frame for more than 0.15 s"] * 2
    assert lasted == ["0:00", "0:04"]
