"""Random faults that pass by: whatever a mission makes of them, the robot does not fall, and every fault was real."""

import os

import pytest

from tests.faults.campaign import plan_of, single, survey

MISSIONS = int(os.environ.get("CCATP_FAULT_PLANS", "40"))
# Of missions whose faults all pass by, this share has to be completed.
LEAST_COMPLETE = 0.99


def test_plans_are_of_their_seed() -> None:
    assert plan_of(3) == plan_of(3)
    assert plan_of(3) != plan_of(4)


@pytest.mark.parametrize("seed", [19, 45])
def test_a_slip_in_the_calibration_drive_does_not_mislead_for_good(seed: int) -> None:
    # The body slips in a turn; what the filter learns of it, wheel base and gyroscope, would be wrong ever after.
    ending = survey(seed, plan_of(seed))
    assert any(record.signal == "body" and record.changed for record in ending.injected)
    assert ending.result.outcome == "complete", ending.line
    assert ending.result.summary["points"]["measured"] == ending.result.summary["points"]["total"]


def test_a_rim_on_the_map_of_a_robot_that_finds_itself_is_no_edge() -> None:
    # An encoder at its rail turns the estimate by a radian: looks at the map show a rim, until the heading is found.
    ending = survey(189, plan_of(189))
    assert any(record.signal == "encoder_left" and record.changed for record in ending.injected)
    assert (ending.result.outcome, ending.result.summary["points"]["measured"]) == ("complete", 9), ending.line


@pytest.mark.slow
def test_nobody_falls_and_what_passes_by_is_survived() -> None:
    incomplete = []
    for seed in range(MISSIONS):
        ending = survey(seed, plan_of(seed))
        assert ending.result.summary["danger"]["falls"] == 0, ending.line
        assert ending.result.outcome in {"complete", "stopped", "aborted, at base"}, ending.line
        time_s = ending.result.summary["mission_time_s"]
        for record in ending.injected:
            assert record.at_s is not None
            # A second before the end a sensor of 20 Hz, too, has been read.
            assert record.samples > 0 or record.at_s > time_s - 1.0, (record, ending.line)
        if ending.result.outcome != "complete":
            incomplete.append(ending.line)
    assert len(incomplete) <= max(1, (1.0 - LEAST_COMPLETE) * MISSIONS), "\n".join(incomplete)


@pytest.mark.slow
def test_a_fault_long_after_the_mission_changes_nothing() -> None:
    without = survey(5, single('signal = "imu_wz"\ntype = "off"\nat_s = 9000.0'))
    with_one = survey(5, single('signal = "soc"\ntype = "stuck"\nat_s = 9000.0'))
    assert without.result.summary == with_one.result.summary
    assert without.injected[0].samples == 0
