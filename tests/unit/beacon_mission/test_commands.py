"""An operator's commands to a mission among beacons, and what it does without verdicts."""

import pytest

from ccatp.beacons.mission import DONE, HELD, VISITING
from ccatp.core import EventCode, Severity, Verdict
from ccatp.studies.mote_navigation import BeaconSilWorld
from tests.unit.beacon_mission.stories import beacon_config, play

FREE = Verdict(0, 0.0, EventCode.NORMAL, "", "", 0.0, 0.0, True, True, True)
DENIED = Verdict(0, 0.0, EventCode.NORMAL, "no radio", "radio", 8.0, 7.0, False, False, False, severity=Severity.HOLD)


@pytest.fixture
def stage() -> BeaconSilWorld:
    return play(BeaconSilWorld(beacon_config("zigbee")), until_s=10.0)


def test_pause_holds_until_resume(stage: BeaconSilWorld) -> None:
    assert stage.mission.pause("operator") is None
    play(stage, until_s=15.0)
    assert stage.mission.is_paused
    assert set(stage.found.speeds_m_s[101:]) == {0.0}
    assert stage.mission.resume() is None
    play(stage, until_s=16.0)
    assert stage.mission.state is VISITING


def test_abort_goes_to_the_start_also_out_of_a_pause(stage: BeaconSilWorld) -> None:
    stage.mission.pause("operator")
    assert stage.mission.abort("operator") is None
    assert play(stage).result().outcome == "aborted, at base"


def test_stop_ends_it_where_it_is(stage: BeaconSilWorld) -> None:
    assert stage.mission.stop() is None
    stage.frame()
    assert stage.mission.state is DONE
    assert stage.result().outcome == "stopped"


def test_what_is_over_takes_no_commands(stage: BeaconSilWorld) -> None:
    stage.mission.stop()
    over = "the mission is over"
    assert [stage.mission.pause(""), stage.mission.abort(""), stage.mission.stop()] == [over, over, over]


def test_resume_is_refused_while_the_cause_is_there(stage: BeaconSilWorld) -> None:
    assert stage.mission.resume() == "the mission is not held but visiting"
    assert not stage.mission.react(DENIED)
    assert stage.mission.state is HELD
    assert stage.mission.resume() == "the cause persists: no radio"
    assert stage.mission.react(FREE)


def test_without_a_verdict_nothing_moves(stage: BeaconSilWorld) -> None:
    assert not stage.mission.react(None)
    assert stage.mission.cause == "no fresh verdict from the danger loop"
    assert stage.mission.react(FREE)


def test_a_fault_waits_for_an_operator(stage: BeaconSilWorld) -> None:
    stage.mission.fault("lost")
    assert stage.mission.is_faulted
    assert not stage.mission.react(FREE)
    assert stage.mission.resume() is None
    assert stage.mission.react(FREE)
